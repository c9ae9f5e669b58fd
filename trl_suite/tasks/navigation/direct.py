"""Navigation from goal to goal without hierarchy: one policy controls the joints at 30 Hz.

Source: the 'Hard' environments of the original, and its imitation scenario with a goal, for which
they were intended.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection
from typing import Any, NamedTuple

import numpy as np

from trl_suite.arenas import SpatialArena
from trl_suite.bodies.blocks import Block
from trl_suite.bodies.body import write_distance
from trl_suite.bodies.reference import CONTROL_TIMESTEP, moment, observe_phase
from trl_suite.bodies.spatial import SpatialState
from trl_suite.characters import Character
from trl_suite.engine import World
from trl_suite.motion import Clip, FootstepLibrary
from trl_suite.tasks.common.control import SpatialConfig, terrain_maps
from trl_suite.tasks.common.goals import (
    BALL,
    BALL_GOAL,
    GOAL,
    SPEED,
    Ball,
    GoalData,
    GoalTask,
    dribble,
    observe_goal,
    soccer_terms,
    store_start,
    store_trace,
    test_goal,
)
from trl_suite.tasks.footsteps.planner import Plans
from trl_suite.tasks.footsteps.task import SpatialFootsteps, SpatialFootstepsConfig
from trl_suite.tasks.rewards import (
    Term,
    com_error,
    conclude,
    effector_error,
    facing,
    give,
    motion_errors,
    score,
    score_tracking,
    tracking_terms,
    wrapped,
)
from trl_suite.tasks.tracking import TrackingData, TrackingTask, proceed, publish
from trl_suite.util.compiled import compiled
from trl_suite.util.options import Range, option

REWARDS = ('goal', 'original')
GOAL_REACHED = 0.5  # m; horizontal distance of the root within which a goal is reached
NEAR = 3.0  # m; distance from the goal within which com and heading have no error
HIDDEN_LENGTH = 0.4  # m; step length of the plan of the reward 'original'
BALL_SHARE = 0.5  # share of the reward for dribbling, with a ball


def direct_terms(share: float, where: str) -> tuple[Term, ...]:
    """Returns the terms of imitation on the way to a goal or a ball, whose weights sum to `share`.

    Source: the original's scenario with a goal. The clip's velocity is rotated towards `where`.
    """
    return (
        *tracking_terms(
            'the centre of mass', 'mean', pose=(share * 0.5 / 1.15, 2.0),
            velocity=(share * 0.05 / 1.15, 0.005), end_effector=(share * 0.15 / 1.15, 40.0),
            com=(share * 0.2 / 1.15, 10.0), root=(share * 0.1 / 1.15, 10.0),
        ),
        Term(
            'heading', share * 0.05 / 1.15,
            f'((1 + cos error) / 2)^4, error: angle between the heading and the direction of the {where}',
        ),
        Term(
            'proximity', share * 0.1 / 1.15, f'distance to the {where}, in units of {NEAR:g} m', 4.0, '1',
        ),
    )  # fmt: skip


class DirectData(NamedTuple):
    """Data for the compiled functions of direct navigation.

    Attributes:
      tracking: data of every tracking task; the period is that of the clip.
      physics: state of the physics.
    """

    tracking: TrackingData
    physics: SpatialState
    aims: GoalData


# A step, after bodies were measured: `advance_all`, the next goals if some are needed, `finish_all`.


@compiled
def compare(i: int, data: DirectData) -> None:
    """Writes the reward terms: imitation while walking to the goal, or to the ball."""
    tracking, comparison = data.tracking, data.tracking.comparison
    measurement = tracking.measurement
    row, fraction = moment(tracking.clock.phase[i], 0, comparison.tracks)
    if data.aims.with_ball:
        qpos, first = data.physics.qpos, data.aims.qpos
        x, y = qpos[i, first], qpos[i, first + 1]
    else:
        x, y = data.aims.goals.place[i, 0], data.aims.goals.place[i, 1]
    x, y = x - measurement.root[i, 0], y - measurement.root[i, 1]
    squared = x * x + y * y
    distance, direction = math.sqrt(squared), math.atan2(y, x)
    near = distance < NEAR
    com = 0.0 if near else com_error(i, row, fraction, direction, comparison, measurement)
    off = 0.0 if near else wrapped(direction - measurement.heading[i])
    pose, velocity, height = motion_errors(i, row, fraction, comparison, measurement)
    end_effector = effector_error(i, row, fraction, comparison, measurement)
    terms, outcome = comparison.terms, tracking.outcome
    score_tracking(i, pose, velocity, end_effector, com, height, terms, outcome)
    give(i, facing(off), terms.heading, outcome)
    score(i, squared / (NEAR * NEAR), terms.proximity, outcome)
    if not data.aims.with_ball:
        along = measurement.com_velocity[i, 0] * x + measurement.com_velocity[i, 1] * y
        data.aims.goals.speed[i] = along / max(distance, 1e-9)


@compiled
def observe(i: int, data: DirectData) -> None:
    """Writes the blocks after those of the body: phase, goal and ball."""
    tracking = data.tracking
    columns, full, measurement = tracking.shown.columns, tracking.shown.full, tracking.measurement
    observe_phase(i, columns, tracking.clock, full)
    observe_goal(i, columns, data.physics, measurement, data.aims, full)
    publish(i, tracking.shown, tracking.outcome)


# Loops over simulations; they take packs.


@compiled
def advance_all(env_ids: np.ndarray, data: DirectData) -> int:
    """Tests goals and balls; returns in how many simulations one must be redrawn."""
    wanted, aims, tracking = 0, data.aims, data.tracking
    measurement, steps = tracking.measurement, tracking.clock.steps
    for i in env_ids:
        aims.goals.wanted[i] = aims.ball.wanted[i] = False
        if proceed(i, tracking):
            store_trace(i, steps[i], measurement, aims.goals)
            if aims.with_ball:
                aims.goals.speed[i] = dribble(
                    i, CONTROL_TIMESTEP, data.physics, measurement, aims, tracking.outcome
                )
            wanted += test_goal(i, steps[i], measurement, aims)
    return wanted


@compiled
def finish_all(env_ids: np.ndarray, data: DirectData) -> None:
    """Finishes steps: computes reward, failure and observation."""
    for i in env_ids:
        tracking = data.tracking
        if not tracking.outcome.diverged[i]:
            store_start(i, data.physics, tracking.measurement, data.aims)
            compare(i, data)
            conclude(i, tracking.measurement.fallen[i], tracking.outcome)
            observe(i, data)


@compiled
def observe_all(env_ids: np.ndarray, data: DirectData) -> None:
    """Writes distances, where a step begins, reward terms of the current state, and observations."""
    for i in env_ids:
        tracking = data.tracking
        write_distance(i, tracking.along, tracking.measurement, tracking.travel)
        store_start(i, data.physics, tracking.measurement, data.aims)
        compare(i, data)
        observe(i, data)


@dataclasses.dataclass(frozen=True, kw_only=True)
class DirectConfig(SpatialConfig):
    """Options of `DirectNavigation`."""

    terrain_observation: str | Collection[str] = terrain_maps('height')
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


class DirectNavigation(GoalTask, TrackingTask):
    """A spatial character imitates a clip while it walks, or dribbles a ball, from goal to goal.

    The reward is that of imitation, with the clip's velocity rotated towards the goal, and
    additional terms for heading towards the goal and for proximity (`direct_terms`). With a
    ball, half of the reward has these terms, with the ball as the goal, and half is for dribbling
    (`goals.soccer_terms`).
    """

    CONFIG: Any = DirectConfig
    finish_all, observe_all = finish_all, observe_all

    def __init__(
        self,
        character: Character,
        arena: SpatialArena,
        clip: Clip,
        config: DirectConfig | None = None,
        ball: Ball | None = None,
        *,
        actuation_model: str = 'position',
    ) -> None:
        """Composes the task; see `TrackingTask`. `ball`: a ball of the arena, for dribbling."""
        self.ball = ball
        self.terms = direct_terms(1.0, 'goal')
        if ball:
            self.terms = *direct_terms(1 - BALL_SHARE, 'ball'), *soccer_terms(BALL_SHARE)
        super().__init__(character, arena, clip, config, actuation_model=actuation_model)
        reached = self.config.goal_reached
        self.goal_reached = GOAL_REACHED if reached is None else float(reached)

    def _further_blocks(self, character: Character, config: Any) -> tuple[Block, ...]:
        return BALL_GOAL if self.ball else GOAL, BALL.observed_if(self.ball is not None)

    def _bind_body(self, world: World) -> DirectData:
        tracking, aims = super()._bind_body(world), self._bind_goals(world, SPEED)
        return DirectData(tracking, self.body.data.physics, aims)

    def _placed(self, env_ids: np.ndarray) -> None:
        self._begin_goals(env_ids)

    def finish_step(self, env_ids: np.ndarray) -> None:
        self.body.measure(env_ids, stepped=True)
        if advance_all(env_ids, self._pack):
            self._redraw_goals(env_ids)
        self.finish_all(env_ids, self._pack)


def hidden_plan(
    character: Character,
    arena: SpatialArena,
    steps: FootstepLibrary,
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
        SpatialFootstepsConfig(plans=Plans(length=Range(HIDDEN_LENGTH, HIDDEN_LENGTH)), hidden_plan=True, **common),
        actuation_model=actuation_model,
    )  # fmt: skip
