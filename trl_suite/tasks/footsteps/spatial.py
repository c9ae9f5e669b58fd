"""Walking along planned footsteps in three dimensions: the low-level footstep controllers.

Source: the step scenario of the original; 'DeepLoco: dynamic locomotion skills using hierarchical
deep reinforcement learning' (Peng, Berseth, Yin, van de Panne 2017).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from trl_suite.arenas import SpatialArena
from trl_suite.characters import Character
from trl_suite.engine import World
from trl_suite.kinematics.spatial import SpatialMeasurement
from trl_suite.kinematics.spatial_reference import SpatialReference
from trl_suite.motion import FootstepLibrary, quaternion, step_features
from trl_suite.tasks.common.comparison import comparison
from trl_suite.tasks.common.first_step import pose_of_step, straight_step, typical_poses
from trl_suite.tasks.common.footstep_plan import (
    CONTACT,
    LEFT,
    PLAN,
    RIGHT,
    check_two_feet,
    footstep_plan,
    plan_markers,
)
from trl_suite.tasks.common.goals import GOAL, GOAL_COLOUR, flag
from trl_suite.tasks.common.plans import (
    FOOTSTEP_SCALE,
    MAX_LANDING_ERROR,
    Plans,
    Pushes,
)
from trl_suite.tasks.footsteps.spatial_plans import Planner
from trl_suite.tasks.footsteps.spatial_rules import (
    TERMS,
    FootstepData,
    FootstepState,
    finish_all,
    land_all,
    observe_all,
)
from trl_suite.tasks.spatial_task import MirroredConfig, TrackingTask
from trl_suite.tasks.task import CONTROL_TIMESTEP, Marker
from trl_suite.util.compiled import packed
from trl_suite.util.options import option


@dataclasses.dataclass(frozen=True, kw_only=True)
class SpatialFootstepsConfig(MirroredConfig):
    """Options of `SpatialFootsteps`."""

    plans: Plans = option(None, 'how footstep plans are drawn: a mapping of fields of Plans')
    goal: bool = option(False, 'plans lead to goals on the terrain, one after the other')
    pushes: Pushes | None = option(
        None, 'forces on the torso: a mapping of fields of Pushes; by default there are none'
    )
    max_landing_error: float | None = option(None, MAX_LANDING_ERROR, unit='m', above=0)
    grace_period: float = option(
        0.0, 'time after a push or a sharp turn in which landing errors do not end the episode', unit='s',
        at_least=0,
    )  # fmt: skip
    footstep_scale: float | Sequence[float] = option(
        1.0, f'{FOOTSTEP_SCALE}; with several values, the term is the mean over them', at_least=0
    )
    heading_scale: float = option(
        1.0, 'factor of the error of the heading in the reward', at_least=0
    )
    hidden_plan: bool = option(
        False,
        'observe bearing and distance of a fixed goal instead of contact and plan, although the reward '
        "depends on the plan, as in the original's 'Hard' environments",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.hidden_plan and self.mirrored:
            raise ValueError('hidden_plan and mirrored cannot be combined; pass only one of them')


class SpatialFootsteps(TrackingTask):
    """A spatial biped tracks a plan of footsteps, two steps per cycle of its clock.

    With the option `mirrored`, observations and actions are reflected in left stance; the phase is
    then that of the single step, and the plan has only the landing places that are not 0.
    """

    terms = TERMS
    ABOUT = 'root'

    CONFIG: Any = SpatialFootstepsConfig

    def __init__(
        self,
        character: Character,
        arena: SpatialArena,
        steps: FootstepLibrary,
        config: SpatialFootstepsConfig = SpatialFootstepsConfig(),
        *,
        actuation_model: str = 'position',
    ) -> None:
        """Composes the task.

        Args:
          character: a spatial biped without actuators; it is attached to the arena.
          arena: the arena with its terrain.
          steps: library of single steps of this character; the clock has the period of two steps.
          config: the options; with action_offset 'clip', action 0 is the mean pose of a straight
            step.
          actuation_model: one of `trl_suite.actuation.ACTUATIONS`.

        Raises:
          ValueError: incompatible options, or steps that do not fit the character.
        """
        check_two_feet(character.spec)
        self._footstep_scales = np.atleast_1d(config.footstep_scale).astype(float)
        self._heading_scale = float(config.heading_scale)
        self.plans, self.pushes = config.plans, config.pushes
        self.steps = steps
        self.goal_given, self.hidden_plan = config.goal, config.hidden_plan
        # The original has a limit of 1 m that has no effect.
        self.max_landing_error = config.max_landing_error
        self._grace_steps = round(config.grace_period / CONTROL_TIMESTEP)
        # Episodes start from the straight step whose length is nearest to the planned one.
        self._first = straight_step(steps, float(np.mean(self.plans.length)))
        super().__init__(
            character, arena, steps, typical_poses(steps, self._first), config,
            period=2 * steps.duration, actuation_model=actuation_model,
            extras=(CONTACT, PLAN, GOAL.observed_if(config.hidden_plan)),
            hidden=('contact', 'plan') if config.hidden_plan else (),
        )  # fmt: skip

    def bind(self, world: World) -> None:
        view, n = self._bind_view(world), world.n
        self.reference = SpatialReference.of_steps(self.steps, self.figure.body, world.models[0])
        self.plan = footstep_plan(n)
        self.state = FootstepState(
            np.zeros(n), np.zeros(n), np.zeros(n, int), np.zeros(n), np.zeros((n, 2)),
            np.zeros((n, 3)), np.zeros((n, 3)), np.zeros(n, int), np.zeros(n, int), np.zeros(n, int),
            np.zeros(n, bool),
        )  # fmt: skip
        self.saved = (*self.saved, self.plan, self.state)
        self.info_arrays |= {
            name: getattr(self.plan, name) for name in ('landed', 'landing_error', 'heading_error')
        }
        self._planner = Planner(
            self.plans, self.arena, self.plan, self.state, self.clock, self._random,
            goals=self.goal_given, grace_steps=self._grace_steps,
        )  # fmt: skip
        limit = self.max_landing_error
        data = FootstepData(
            body=self.figure.data,
            outcome=self.outcome,
            given=view,
            clock=self.clock,
            travel=self.travel,
            period=self.period,
            comparison=comparison(self.character, self.reference, self.terms),
            plan=self.plan,
            state=self.state,
            footstep_scales=self._footstep_scales,
            heading_scale=self._heading_scale,
            largest_miss=np.inf if limit is None else float(limit),
        )
        self._pack = packed(data)
        self._torso = int(world.body_ids([self.character.bodies[1].full_identifier])[0])

    # Short names for the plan.

    @property
    def stance(self) -> np.ndarray:
        """Stance foot, `RIGHT` or `LEFT`, (n,)."""
        return self.plan.stance

    @property
    def landing(self) -> np.ndarray:
        """Landing places of the swing foot, then of the stance foot, (n, 2, 3) m."""
        return self.plan.landing

    @property
    def heading(self) -> np.ndarray:
        """Planned heading, (n,) rad."""
        return self.plan.heading

    @property
    def goal(self) -> np.ndarray:
        """Position of the goal, (n, 3) m."""
        return self.state.goal

    @property
    def step_phase(self) -> np.ndarray:
        """Share of the single step that has passed, (n,)."""
        twice = 2 * self.phase
        return twice - np.floor(twice)

    # Episodes.

    def _start(
        self, env_ids: np.ndarray, random_states: Sequence[np.random.RandomState]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        spawns = self._begin_grounds(env_ids, random_states)
        self.plan.stance[env_ids] = self.phase[env_ids] >= 0.5
        return *pose_of_step(self.steps, self._first, self.phase[env_ids]), spawns

    def _begun_on_ground(self, env_ids: np.ndarray) -> None:
        measurement, plan, state = self.figure.measure(env_ids), self.plan, self.state
        plan.landing_error[env_ids] = plan.heading_error[env_ids] = 0.0
        plan.landed[env_ids] = state.missed[env_ids] = False
        state.push_end[env_ids] = state.excused[env_ids] = 0
        if self.pushes:
            for i in env_ids.tolist():
                state.push_begin[i] = self._steps_within(i, self.pushes.interval)
        self._planner.begin(env_ids, self.travel.origin[env_ids], measurement)
        self._put_reference(env_ids, measurement, np.full(len(env_ids), self._first))
        if self.hidden_plan:
            for i in env_ids.tolist():
                place = self.travel.origin[i, :2]
                state.goal[i] = self.arena.goal(i, self._random[i], place, 'near')

    def _steps_within(self, i: int, seconds: tuple[float, float]) -> int:
        return round(self._random[i].uniform(*seconds) / self.control_timestep)

    # A step.

    def apply_action(self, action: np.ndarray, env_ids: np.ndarray) -> None:
        super().apply_action(action, env_ids)
        if self.pushes:
            self._push(env_ids, self.pushes)

    def _push(self, env_ids: np.ndarray, pushes: Pushes) -> None:
        """Draws pushes that begin, and applies the forces."""
        state, count = self.state, self.clock.steps
        for i in env_ids[count[env_ids] >= state.push_begin[env_ids]].tolist():
            angle = self._random[i].uniform(-np.pi, np.pi)
            force = self._random[i].uniform(*pushes.force)
            state.push[i] = force * np.cos(angle), force * np.sin(angle), 0.0
            state.push_end[i] = count[i] + self._steps_within(i, pushes.duration)
            state.push_begin[i] = state.push_end[i] + self._steps_within(i, pushes.interval)
            state.excused[i] = state.push_end[i] + self._grace_steps
        pushing = (count[env_ids] < state.push_end[env_ids])[:, None]
        self.world.xfrc_applied[env_ids, self._torso, :3] = state.push[env_ids] * pushing

    def finish_step(self, env_ids: np.ndarray) -> None:
        if land_all(env_ids, self._pack):
            switched = env_ids[self.plan.landed[env_ids]]
            measurement = self.figure.measurement
            self._planner.replan(switched, measurement)
            self._put_reference(switched, measurement, self._choose(switched, measurement))
        finish_all(env_ids, self._pack)

    def observe(self, env_ids: np.ndarray | None = None) -> None:
        observe_all(self.world.all_ids if env_ids is None else env_ids, self._pack)

    def _choose(self, env_ids: np.ndarray, measurement: SpatialMeasurement) -> np.ndarray:
        """Returns the steps of the library that are nearest to the plans of some simulations."""
        feet = measurement.feet[env_ids]
        query = step_features(
            measurement.root[env_ids, :2], measurement.heading[env_ids], feet[:, RIGHT, :2], feet[:, LEFT, :2],
            self.landing[env_ids, 0, :2], self.heading[env_ids], self.stance[env_ids] == RIGHT,
        )  # fmt: skip
        return self.steps.select(query)

    def _put_reference(
        self, env_ids: np.ndarray, measurement: SpatialMeasurement, chosen: np.ndarray
    ) -> None:
        """Aligns the chosen steps with position and heading of the characters."""
        self.state.track[env_ids] = chosen + len(self.steps) * (self.stance[env_ids] == LEFT)
        columns = self.reference.columns
        now = self.reference.features(self.step_phase[env_ids], self.state.track[env_ids])
        turned = measurement.heading[env_ids] - now[:, columns['heading'].start]
        self.state.turned[env_ids] = turned
        self.state.shift[env_ids] = measurement.root[env_ids, :2] - quaternion.rotate_xy(
            now[:, columns['root']], turned
        )

    # Rendering.

    def markers(self, env_id: int) -> list[Marker]:
        """Returns markers of the landing places, the planned heading and the goal."""
        root = self.world.xpos[env_id, self.figure.links[0]]
        shown = plan_markers(env_id, root, self.plan)
        if self.goal_given:
            shown.append(Marker('cylinder', self.goal[env_id], (0.15, 0.2, 0.0), GOAL_COLOUR))
        if self.hidden_plan:
            shown.append(flag(self.goal[env_id]))
        return shown

    def reference_pose(self, env_id: int) -> np.ndarray:
        """Returns the pose of the aligned reference: root, then joints."""
        state = self.state
        mirrored, index = divmod(int(state.track[env_id]), len(self.steps))
        time = self.step_phase[env_id] * self.steps.duration
        pose = self.steps.pose(index, time, bool(mirrored))
        turned = state.turned[env_id]
        pose[:2] = state.shift[env_id] + quaternion.rotate_xy(pose[:2], turned)
        pose[3:7] = quaternion.multiply(quaternion.about_z(turned), pose[3:7])
        env_ids = np.array([env_id])
        pose[2] += self.arena.height(pose[None, :1], pose[None, 1:2], env_ids)[0, 0]
        return pose
