"""Navigation from goal to goal without hierarchy: one policy controls the joints at 30 Hz.

Source: the 'Hard' environments of the original, and its imitation scenario with a goal, for which
they were intended.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np

from trl_suite.arenas import SpatialArena
from trl_suite.characters import Character
from trl_suite.engine import World
from trl_suite.kinematics.spatial_reference import SpatialReference
from trl_suite.motion import Clip, Steps
from trl_suite.tasks.components.ball import (
    BALL,
    BALL_GOAL,
    SPEED,
    Ball,
    goal_disc,
    no_ball,
    soccer_terms,
)
from trl_suite.tasks.components.comparison import comparison
from trl_suite.tasks.components.goal_drawer import GoalDrawer
from trl_suite.tasks.components.goals import GOAL, flag, goals
from trl_suite.tasks.components.spatial_rules import HEIGHT_MAP
from trl_suite.tasks.components.trace import trace, trace_markers
from trl_suite.tasks.footsteps.spatial import SpatialFootsteps, SpatialFootstepsConfig
from trl_suite.tasks.imitation.spatial import check_cycle, clip_action, cycle_poses, pose_of_clip
from trl_suite.tasks.navigation.direct_rules import (
    BALL_SHARE,
    GOAL_REACHED,
    HIDDEN_LENGTH,
    REWARDS,
    DirectData,
    Progress,
    advance_all,
    direct_terms,
    finish_all,
    observe_all,
)
from trl_suite.tasks.spatial_task import SpatialConfig, TrackingTask
from trl_suite.tasks.task import Marker
from trl_suite.util.compiled import packed
from trl_suite.util.options import option


@dataclasses.dataclass(frozen=True, kw_only=True)
class DirectConfig(SpatialConfig):
    """Options of `DirectNavigation`."""

    terrain_observation: str | Collection[str] = option('height', HEIGHT_MAP, choices=('height',))
    goal_reached: float | None = option(
        None,
        f'distance within which a goal is reached, or a ball is at its goal; by default {GOAL_REACHED:g}',
        unit='m', above=0,
    )  # fmt: skip


@dataclasses.dataclass(frozen=True, kw_only=True)
class DirectNavigationConfig(DirectConfig):
    """Options of direct navigation without a ball, for either of its rewards."""

    reward: str = option(
        'goal',
        f"'goal': reward for approaching the goal; 'original': reward for tracking footsteps of {HIDDEN_LENGTH:g} m "
        'that are not observed, with a fixed goal',
        choices=REWARDS,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.reward == 'original' and self.goal_reached is not None:
            raise ValueError("goal_reached is an option of the reward 'goal', not of 'original'")


class DirectNavigation(TrackingTask):
    """A spatial character imitates a clip while it walks, or dribbles a ball, from goal to goal.

    The reward is that of imitation, with the clip's velocity rotated towards the goal, and
    additional terms for heading towards the goal and for proximity (`direct_terms`). With a
    ball, half of the reward has these terms, with the ball as the goal, and half is for dribbling
    (`ball.soccer_terms`).
    """

    CONFIG: Any = DirectConfig

    def __init__(
        self,
        character: Character,
        arena: SpatialArena,
        clip: Clip,
        config: DirectConfig = DirectConfig(),
        ball: Ball | None = None,
        *,
        actuation_model: str = 'position',
    ) -> None:
        """Composes the task.

        Args:
          character: a spatial character without actuators; it is attached to the arena.
          arena: the arena with its terrain.
          clip: a looping clip for this character, with a free root.
          config: the options.
          ball: a ball of the arena, for dribbling.
          actuation_model: one of `trl_suite.actuation.ACTUATIONS`.

        Raises:
          ValueError: incompatible options, or a clip that does not fit the character.
        """
        check_cycle(clip)
        self.clip, self.ball = clip, ball
        self.terms = direct_terms(1.0, 'goal')
        if ball:
            self.terms = *direct_terms(1 - BALL_SHARE, 'ball'), *soccer_terms(BALL_SHARE)
        reached = config.goal_reached
        self.goal_reached = GOAL_REACHED if reached is None else float(reached)
        self._goal_drawer = GoalDrawer(arena, ball, 'near')
        super().__init__(
            character, arena, clip, cycle_poses(clip), config, period=clip.duration,
            actuation_model=actuation_model,
            extras=(BALL_GOAL if ball else GOAL, BALL.observed_if(ball is not None)),
        )  # fmt: skip

    def bind(self, world: World) -> None:
        view, n = self._bind_view(world), world.n
        self.reference = SpatialReference.of_clip(self.clip, self.figure.body, world.models[0])
        self.goals, self.progress, self.trace = goals(n), Progress(np.zeros(n)), trace(n)
        self.saved = (*self.saved, self.goals, self.progress, self.trace)
        self.info_arrays |= {'goals_reached': self.goals.reached, 'speed': self.progress.speed}
        self._goal_drawer.bind(world, self.goals, self.clock, self._random)
        balls = no_ball(n)
        if self.ball:
            self.ball.bind(world)
            balls = self.ball.rules(SPEED, self.goal_reached, self.terms)
            self.saved = (*self.saved, self.ball.state)
            self.info_arrays['at_goal'] = self.ball.state.at_goal
        data = DirectData(
            body=self.figure.data,
            outcome=self.outcome,
            seen=view,
            clock=self.clock,
            travel=self.travel,
            period=self.period,
            comparison=comparison(self.character, self.reference, self.terms),
            goals=self.goals,
            progress=self.progress,
            trace=self.trace,
            goal_reached=self.goal_reached,
            with_ball=self.ball is not None,
            ball=balls,
        )
        self._pack = packed(data)

    @property
    def goal(self) -> np.ndarray:
        """Goal of the walker, or of the ball, (n, 3) m."""
        return self.goals.place

    # Episodes.

    def _start(
        self, env_ids: np.ndarray, random_states: Sequence[np.random.RandomState]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        spawns = self._begin_grounds(env_ids, random_states)
        return *pose_of_clip(self.clip, self.clock.start[env_ids]), spawns

    def _begun_on_ground(self, env_ids: np.ndarray) -> None:
        self.goals.reached[env_ids] = 0
        self.trace.places[env_ids] = np.nan
        for i in env_ids.tolist():
            self._goal_drawer.begin(i, self.travel.origin[i, :2])
        if self.ball:
            self.ball.state.at_goal[env_ids] = False
            self.world.forward(env_ids)
        observe_all(env_ids, True, self._pack)

    # A step.

    def finish_step(self, env_ids: np.ndarray) -> None:
        if advance_all(env_ids, self._pack):
            self._goal_drawer.redraw(env_ids, self.figure.measurement.root[:, :2])
        finish_all(env_ids, self._pack)

    def observe(self, env_ids: np.ndarray | None = None) -> None:
        observe_all(self.world.all_ids if env_ids is None else env_ids, False, self._pack)

    def clip_action(self, env_id: int) -> np.ndarray:
        """Returns the action that moves the joints along the clip, in open loop."""
        return clip_action(self, self.clip, env_id)

    def markers(self, env_id: int) -> list[Marker]:
        """Returns markers of past positions of the centre of mass, and of the goal."""
        goal = self.goal[env_id]
        there = goal_disc(goal, self.goal_reached) if self.ball else flag(goal)
        return [*trace_markers(env_id, self.trace), there]


def hidden_plan(
    character: Character,
    arena: SpatialArena,
    steps: Steps,
    config: DirectConfig,
    actuation_model: str,
) -> SpatialFootsteps:
    """Makes the task for the reward 'original': footsteps with a hidden plan.

    In the original the plan begins at the world's origin, which is mostly far away; here it begins
    at the start position.
    """
    common = {
        field.name: getattr(config, field.name) for field in dataclasses.fields(SpatialConfig)
    }
    return SpatialFootsteps(
        character, arena, steps,
        SpatialFootstepsConfig(plans={'length': (HIDDEN_LENGTH,) * 2}, hidden_plan=True, **common),
        actuation_model=actuation_model,
    )  # fmt: skip
