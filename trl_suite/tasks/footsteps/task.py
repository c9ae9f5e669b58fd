"""Walking along planned footsteps, in the plane or in space: the low-level footstep controllers.

Source: the step scenario of the original, with its configurations for planar and spatial bipeds;
'DeepLoco: dynamic locomotion skills using hierarchical deep reinforcement learning' (Peng, Berseth, Yin,
van de Panne 2017).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from trl_suite.bodies.blocks import Block
from trl_suite.bodies.body import Measurement
from trl_suite.bodies.reference import CONTROL_TIMESTEP, Reference
from trl_suite.bodies.state import allocated
from trl_suite.characters import CHARACTERS, Character, CharacterSpec
from trl_suite.engine import World
from trl_suite.motion import FootstepLibrary, load_steps, quaternion, step_features, steps_names
from trl_suite.tasks.common.control import MirroredConfig, PlanarConfig
from trl_suite.tasks.common.footstep_plan import (
    CONTACT,
    LEFT,
    PLAN,
    RIGHT,
    FootstepPlan,
    check_two_feet,
    plan_markers,
    straight_step,
)
from trl_suite.tasks.common.goals import GOAL, GOAL_COLOUR, flag
from trl_suite.tasks.footsteps.planner import (
    FOOTSTEP_SCALE,
    MAX_LANDING_ERROR,
    Plans,
    PlanTask,
    StraightPlans,
)
from trl_suite.tasks.footsteps.rules import (
    PLANAR_TERMS,
    TERMS,
    FootstepData,
    FootstepState,
    align_all,
    finish_all,
    land_all,
    observe_all,
)
from trl_suite.tasks.task import Marker
from trl_suite.tasks.variation.pushes import PushConfig, Pushes
from trl_suite.util.errors import check_known
from trl_suite.util.options import Range, option

PUSHES = {'force': (50.0, 150.0), 'duration': (0.2, 0.4), 'interval': (1.0, 2.0)}  # defaults


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlanarFootstepsConfig(PlanarConfig):
    """Options of `PlanarFootsteps`."""

    plans: StraightPlans = option(
        None,
        'how footstep plans are drawn: a mapping of fields of StraightPlans, instead of that of the '
        'environment',
    )
    max_landing_error: float | None = option(None, MAX_LANDING_ERROR, unit='m', above=0)
    footstep_scale: float = option(1.0, FOOTSTEP_SCALE, at_least=0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SpatialFootstepsConfig(MirroredConfig):
    """Options of `SpatialFootsteps`."""

    plans: Plans = option(
        None,
        'how footstep plans are drawn: a mapping of fields of Plans, instead of that of the environment',
    )
    goal: bool = option(False, 'plans lead to goals on the terrain, one after the other')
    pushes: PushConfig | None = option(
        None,
        'pushes of the torso, or of another body, if given: a mapping of options of push, as in '
        f'randomize, with the defaults {PUSHES}',
    )
    max_landing_error: float | None = option(None, MAX_LANDING_ERROR, unit='m', above=0)
    grace_period: float = option(
        0.0,
        'time after a push or a sharp turn in which max_landing_error does not end the episode',
        unit='s',
        at_least=0,
        at_most=1000,
    )
    footstep_scale: float | Sequence[float] = option(
        1.0, f'{FOOTSTEP_SCALE}; with several values, the term is the mean over them', at_least=0
    )
    pose_scale: float = option(1.0, 'factor of the error of the pose in the reward', at_least=0)
    heading_scale: float = option(
        1.0, 'factor of the error of the heading in the reward', at_least=0
    )
    style: str | None = option(
        None,
        "way of walking, such as 'high_knees': the reference is the step library mocap/NAME_STYLE_steps.npz, "
        'NAME that of the library without style, whose mean pose remains action 0',
    )
    hidden_plan: bool = option(
        False,
        'observe bearing and distance of a fixed goal instead of contact and plan, although the reward '
        "depends on the plan, as in the original's 'Hard' environments",
    )

    def __post_init__(self) -> None:
        if isinstance(self.pushes, Mapping):
            replaced = {'force': None} if 'speed' in self.pushes else {}
            self._set('pushes', {**PUSHES, **replaced, **self.pushes})
        super().__post_init__()
        if self.grace_period and self.max_landing_error is None:
            raise ValueError(
                f'grace_period is {self.grace_period:g}; it has no effect without max_landing_error'
            )
        for name in ('mirrored', 'goal'):  # with a hidden plan there is always a goal
            if self.hidden_plan and getattr(self, name):
                raise ValueError(
                    f'hidden_plan and {name} cannot be combined; pass only one of them'
                )


class Footsteps(PlanTask):
    """A biped tracks a plan of footsteps, two steps per cycle of its clock.

    Attributes:
      plans: how they are drawn.
    """

    ABOUT_COM = False
    finish_all, observe_all = finish_all, observe_all
    plans: Any  # Plans or StraightPlans
    hidden_plan = False

    def _bind_body(self, world: World) -> FootstepData:
        tracking, n, config = super()._bind_body(world), world.n, self.config
        self.plan, self.state = allocated(FootstepPlan, n), allocated(FootstepState, n)
        self.saved = (*self.saved, self.plan, self.state)
        self.info_arrays |= {
            name: getattr(self.plan, name) for name in ('landed', 'landing_error', 'heading_error')
        }
        limit = config.max_landing_error
        return FootstepData(
            tracking=tracking,
            plan=self.plan,
            state=self.state,
            turns=self._spatial,
            pose_scale=float(getattr(config, 'pose_scale', 1.0)),
            footstep_scales=np.atleast_1d(config.footstep_scale).astype(float),
            heading_scale=float(getattr(config, 'heading_scale', 1.0)),
            largest_miss=np.inf if limit is None else float(limit),
        )

    @property
    def step_phase(self) -> np.ndarray:
        """Share of the single step that has passed, (n,)."""
        return 2 * self.phase % 1

    # Episodes.

    def _placed(self, env_ids: np.ndarray) -> None:
        plan, state = self.plan, self.state
        self.body.measure(env_ids)
        plan.stance[env_ids] = self.phase[env_ids] >= 0.5
        plan.landing_error[env_ids] = plan.heading_error[env_ids] = 0.0
        plan.landed[env_ids] = state.missed[env_ids] = False
        state.excused[env_ids] = state.staying[env_ids] = 0
        for i in env_ids.tolist():
            self._begin_plan(i)
        align_all(env_ids, self._first_tracks(env_ids), self._pack)

    def _first_tracks(self, env_ids: np.ndarray) -> np.ndarray:
        """Returns the tracks of the reference at the start of episodes, (m,); here one per stance."""
        return self.plan.stance[env_ids]

    def _choose(self, env_ids: np.ndarray, measurement: Measurement) -> np.ndarray:
        """Returns the tracks of the reference that are nearest to the plans, (m,); here one per stance."""
        return self.plan.stance[env_ids]

    # A step.

    def finish_step(self, env_ids: np.ndarray) -> None:
        measurement = self.body.measure(env_ids, stepped=True)
        if land_all(env_ids, self._pack):
            switched = env_ids[self.plan.landed[env_ids]]
            for i in switched.tolist():
                self._replan(i)
            align_all(switched, self._choose(switched, measurement), self._pack)
            self.finish_all(switched, self._pack)


class SpatialFootsteps(Footsteps):
    """A spatial biped tracks a plan of footsteps, with a library of single steps of this character.

    Episodes start from the straight step that can follow itself; of several, the one whose length is
    nearest to the planned one.

    With the option `mirrored`, observations and actions are reflected in left stance; the phase is
    then that of the single step, and the plan has only the landing places that are not 0.
    """

    terms = TERMS
    CONFIG: Any = SpatialFootstepsConfig

    def __init__(self, character: Character, *args: Any, **kwargs: Any) -> None:
        """Composes the task; the arguments are those of `TrackingTask`."""
        super().__init__(character, *args, **kwargs)
        if self.config.style is not None:
            self.motion = self.steps = styled(self.steps, self.config.style)
            self._first = straight_step(self.steps, self.length)
        if self.steps.left_poses is not None:  # one side of the walk differs from the other
            if self.mirrored:
                raise ValueError(
                    f'mirrored: the steps {self.steps.name!r} in left stance are not mirror images of those in '
                    'right stance'
                )
            self.mirror = None
        pushes = self.config.pushes
        if pushes is not None:
            links = character.spec.links
            body = pushes.body or ('torso' if 'torso' in links else links[0])
            self.add(Pushes(dataclasses.replace(pushes, body=body)))

    def _further_blocks(self, character: Character, config: Any) -> tuple[Block, ...]:
        check_two_feet(character.spec)
        self.plans = self._drawn_plans = config.plans
        self.goal_given, self.hidden_plan = config.goal, config.hidden_plan
        self.hidden = ('contact', 'plan') if config.hidden_plan else ()
        self._grace_steps = round(config.grace_period / CONTROL_TIMESTEP)
        self.length = float(np.mean(self.plans.length))
        return CONTACT, PLAN, GOAL.observed_if(config.hidden_plan)

    @property
    def goal(self) -> np.ndarray:
        """Position of the goal, (n, 3) m."""
        return self.state.goal

    # Episodes.

    def _placed(self, env_ids: np.ndarray) -> None:
        super()._placed(env_ids)
        if self.hidden_plan:
            for i in env_ids.tolist():
                place = self.travel.origin[i, :2]
                self.state.goal[i] = self.arena.goal(i, self._random[i], place, 'near')

    def _first_tracks(self, env_ids: np.ndarray) -> np.ndarray:
        return self._first + len(self.steps) * (self.plan.stance[env_ids] == LEFT)

    # A step.

    def apply_action(self, action: np.ndarray, env_ids: np.ndarray) -> None:
        super().apply_action(action, env_ids)
        pushes = self.world.engine.pushes
        if pushes is not None:  # landing errors do not count during these, and the grace after them
            begin, end = pushes.state.begin[env_ids], pushes.state.end[env_ids]
            due = begin < self.world.time[env_ids, None] + self.control_timestep
            until = np.rint(np.where(due, end, 0.0).max(1) / self.control_timestep)
            pushed = due.any(1)
            self.state.excused[env_ids[pushed]] = until[pushed] + self._grace_steps

    def _choose(self, env_ids: np.ndarray, measurement: Measurement) -> np.ndarray:
        feet = measurement.feet[env_ids]
        query = step_features(
            measurement.root[env_ids, :2],
            measurement.heading[env_ids],
            feet[:, RIGHT, :2],
            feet[:, LEFT, :2],
            self.plan.landing[env_ids, 0, :2],
            self.plan.heading[env_ids],
            self.plan.stance[env_ids] == RIGHT,
        )
        return self.steps.select(query) + len(self.steps) * (self.plan.stance[env_ids] == LEFT)

    # Rendering.

    def markers(self, env_id: int) -> list[Marker]:
        """Returns markers of the landing places, the planned heading and the goal."""
        root = self.world.xpos[env_id, self.body.links[0]]
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
        return self._on_ground(env_id, pose)


class PlanarFootsteps(Footsteps):
    """A planar biped tracks a plan of footsteps; the reference of a step is one half of a clip.

    The clip has two steps, with right stance first.
    """

    terms = PLANAR_TERMS
    CONFIG: Any = PlanarFootstepsConfig
    clip_parts = 2

    def _further_blocks(self, character: Character, config: Any) -> tuple[Block, ...]:
        check_feet(character.spec)
        self.plans, nothing = config.plans, Range(0.0, 0.0)
        given = {'length': self.plans.length, 'change': self.plans.change}
        self._drawn_plans = Plans(**given, width=nothing, turn=0.0, sharp=0.0)
        return CONTACT, PLAN, GOAL.observed_if(False)

    def _make_reference(self) -> Reference:
        reference = super()._make_reference()
        shares, columns = np.arange(32) / 32, reference.columns['effectors']
        halves = [reference.features(shares, np.full(32, half))[:, columns] for half in (0, 1)]
        # Right above left foot, by halves.
        higher = [(feet[:, 2] - feet[:, 5]).mean() for feet in halves]
        if not higher[0] < 0 < higher[1]:
            raise ValueError(
                f'clip {self.clip.name!r}: expected the right foot on the ground in the first half of '
                'the cycle, and the left foot in the second; if the left foot is first, pass '
                'clip.mirrored()'
            )
        return reference

    def markers(self, env_id: int) -> list[Marker]:
        """Returns markers of the landing places."""
        return plan_markers(env_id, np.zeros(3), self.plan)[:2]

    def reference_pose(self, env_id: int) -> np.ndarray:
        """Returns the reference pose, aligned with x at the last switch: x, z, pitch, joints."""
        time = (self.state.track[env_id] + self.step_phase[env_id]) / 2 * self.period
        pose = self.clip.pose(time)
        pose[0] += self.state.shift[env_id, 0]
        return self._on_ground(env_id, pose)


def styled(steps: FootstepLibrary, style: str) -> FootstepLibrary:
    """Returns the shipped library of steps in a style.

    Raises:
      ValueError: there is none for these steps; the message has the closest.
    """
    prefix = f'{steps.name}_'
    named = {name for name in steps_names() if name.startswith(prefix)}
    known = {name.removeprefix(prefix) for name in named - {*CHARACTERS}}
    check_known(f'style of {steps.name!r}', known, style)
    found = load_steps(prefix + style)
    if not np.isclose(found.duration, steps.duration):
        raise ValueError(
            f'style {style!r} has steps of {found.duration:g} s; expected {steps.duration:g} s, as those of '
            f'{steps.name!r}'
        )
    return found


def check_feet(character: CharacterSpec) -> None:
    """Checks that a character has a right and a left foot, and no others.

    Raises:
      ValueError: the character has no such pair of end effectors.
    """
    if character.end_effectors not in character.mirror:
        raise ValueError(
            f'character {character.name!r} has '
            f'{", ".join(character.end_effectors) or "nothing"} as end effectors; expected a right and a left '
            'foot, as biped2d_full has'
        )
