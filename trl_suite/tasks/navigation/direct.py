"""Navigation from goal to goal without hierarchy: one policy controls the joints at 30 Hz.

Source: the 'Hard' environments of the original, and its imitation scenario with a goal, for which
they were intended.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

import numpy as np

from trl_suite.arenas import SpatialArena
from trl_suite.bodies.body import go
from trl_suite.bodies.reference import CONTROL_TIMESTEP, Reference, moment, observe_phase
from trl_suite.bodies.spatial import SpatialState
from trl_suite.bodies.state import REAL, allocated
from trl_suite.characters import Character
from trl_suite.engine import World
from trl_suite.motion import Clip, FootstepLibrary
from trl_suite.tasks.common.ball import (
    BALL,
    BALL_GOAL,
    SPEED,
    Ball,
    BallData,
    dribble,
    goal_disc,
    no_ball,
    observe_ball,
    remember,
    soccer_terms,
)
from trl_suite.tasks.common.control import HEIGHT_MAP, SpatialConfig, check_cycle, cycle_poses
from trl_suite.tasks.common.goals import (
    GOAL,
    GoalDrawer,
    Goals,
    Trace,
    flag,
    follow,
    observe_place,
    trace,
    trace_markers,
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
from trl_suite.tasks.task import Marker
from trl_suite.tasks.tracking import TrackingData, TrackingTask, proceed, publish
from trl_suite.util.compiled import compiled, packed
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


class Progress(NamedTuple):
    """Speed of each walker's centre of mass towards its goal, (n,) m/s."""

    speed: np.ndarray = REAL


class DirectData(NamedTuple):
    """Data for the compiled functions of direct navigation.

    Attributes:
      tracking: data of every tracking task; the period is that of the clip.
      physics: state of the physics.
      goal_reached: distance of the root within which the goal is reached, m.
      with_ball: whether the goal is that of a ball.
    """

    tracking: TrackingData
    physics: SpatialState
    goals: Goals
    progress: Progress
    trace: Trace
    goal_reached: float
    with_ball: bool
    ball: BallData


# A step of simulation i, after the body was measured: `advance`, the next goal if one is needed,
# `finish`.


@compiled
def advance(i: int, data: DirectData) -> bool:
    """Tests goal and ball; returns whether one of them must be redrawn."""
    tracking, goals, state = data.tracking, data.goals, data.ball.state
    goals.wanted[i] = state.wanted[i] = False
    if not proceed(i, tracking):
        return False
    count, measurement = tracking.clock.steps[i], tracking.measurement
    follow(i, count, measurement.com, data.trace)
    if data.with_ball:
        seconds, ball, outcome = CONTROL_TIMESTEP, data.ball, tracking.outcome
        dribble(i, seconds, goals.place, data.physics, measurement, ball, outcome)
        reached = state.at_goal[i]
        state.wanted[i] = count >= state.due[i]
        goals.wanted[i] = count >= goals.due[i]  # a ball's goal is not redrawn when it is reached
    else:
        x = goals.place[i, 0] - measurement.root[i, 0]
        y = goals.place[i, 1] - measurement.root[i, 1]
        reached = x * x + y * y < data.goal_reached * data.goal_reached
        goals.wanted[i] = reached or count >= goals.due[i]
    goals.reached[i] += reached
    return goals.wanted[i] or state.wanted[i]


@compiled
def finish(i: int, data: DirectData) -> None:
    """Computes reward, failure and observation."""
    tracking = data.tracking
    if tracking.outcome.diverged[i]:  # keeps the last finite observation
        conclude(i, True, tracking.outcome)
        return
    if data.with_ball:
        remember(i, data.physics, tracking.measurement, data.ball)
    compare(i, data)
    conclude(i, tracking.measurement.fallen[i], tracking.outcome)
    observe(i, data)


@compiled
def compare(i: int, data: DirectData) -> None:
    """Writes the reward terms: imitation while walking to the goal, or to the ball."""
    tracking, comparison = data.tracking, data.tracking.comparison
    measurement = tracking.measurement
    row, fraction = moment(tracking.clock.phase[i], 0, comparison.tracks)
    if data.with_ball:
        qpos, first = data.physics.qpos, data.ball.qpos
        x, y = qpos[i, first], qpos[i, first + 1]
    else:
        x, y = data.goals.place[i, 0], data.goals.place[i, 1]
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
    along = measurement.com_velocity[i, 0] * x + measurement.com_velocity[i, 1] * y
    data.progress.speed[i] = along / max(distance, 1e-9)


@compiled
def observe(i: int, data: DirectData) -> None:
    """Writes the blocks after those of the body: phase, goal and ball."""
    tracking, place = data.tracking, data.goals.place
    columns, full, measurement = tracking.given.columns, tracking.given.full, tracking.measurement
    observe_phase(i, columns, tracking.clock, full)
    if data.with_ball:
        observe_ball(i, columns, place, data.physics, measurement, data.ball, full)
    else:
        x, y = place[i, 0] - measurement.root[i, 0], place[i, 1] - measurement.root[i, 1]
        observe_place(i, columns.goal, x, y, measurement, full)
    publish(i, tracking.given, tracking.outcome)


# Loops over simulations; they take packs.


@compiled
def advance_all(env_ids: np.ndarray, data: DirectData) -> int:
    """Tests goals and balls; returns in how many simulations one must be redrawn."""
    wanted = 0
    for i in env_ids:
        wanted += advance(i, data)
    return wanted


@compiled
def finish_all(env_ids: np.ndarray, data: DirectData) -> None:
    """Finishes steps."""
    for i in env_ids:
        finish(i, data)


@compiled
def observe_all(env_ids: np.ndarray, fresh: bool, data: DirectData) -> None:
    """Writes distances, reward terms of the current state, and observations.

    If `fresh`, episodes have just begun, and positions of ball and body are stored.
    """
    for i in env_ids:
        tracking = data.tracking
        go(i, tracking.along, tracking.measurement, tracking.travel)
        if fresh and data.with_ball:
            remember(i, data.physics, tracking.measurement, data.ball)
        compare(i, data)
        observe(i, data)


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
            character,
            arena,
            clip,
            cycle_poses(clip),
            config,
            period=clip.duration,
            actuation_model=actuation_model,
            extras=(BALL_GOAL if ball else GOAL, BALL.observed_if(ball is not None)),
        )

    def bind(self, world: World) -> None:
        tracking, n = self._bind_tracking(world), world.n
        self.goals, self.progress, self.trace = (
            allocated(Goals, n),
            allocated(Progress, n),
            trace(n),
        )
        self.saved = (*self.saved, self.goals, self.progress, self.trace)
        self.info_arrays |= {'goals_reached': self.goals.reached, 'speed': self.progress.speed}
        self._goal_drawer.bind(world, self.goals, self.clock.steps, self._random)
        balls = no_ball(n)
        if self.ball:
            self.ball.bind(world)
            balls = self.ball.rules(SPEED, self.goal_reached, self.terms)
            self.saved = (*self.saved, self.ball.state)
            self.info_arrays['at_goal'] = self.ball.state.at_goal
        data = DirectData(
            tracking=tracking,
            physics=self.figure.data.physics,
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

    def _track(self) -> Reference:
        return Reference.of_clip(self.clip, self.figure, self.world.models[0])

    def _start(
        self, env_ids: np.ndarray, random_states: Sequence[np.random.RandomState]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self._clip_start(env_ids, self._begin_grounds(env_ids, random_states))

    def _begun_on_ground(self, env_ids: np.ndarray) -> None:
        self.goals.reached[env_ids] = 0
        self.trace.places[env_ids] = np.nan
        for i in env_ids.tolist():
            self._goal_drawer.begin(i, self.travel.origin[i, :2])
        if self.ball:
            self.ball.state.at_goal[env_ids] = False
            self.world.forward(env_ids)
        self.figure.measure(env_ids)
        observe_all(env_ids, True, self._pack)

    # A step.

    def finish_step(self, env_ids: np.ndarray) -> None:
        measurement = self.figure.measure(env_ids, stepped=True)
        if advance_all(env_ids, self._pack):
            self._goal_drawer.redraw(env_ids, measurement.root[:, :2])
        finish_all(env_ids, self._pack)

    def observe(self, env_ids: np.ndarray | None = None) -> None:
        env_ids = self.world.all_ids if env_ids is None else env_ids
        self.figure.measure(env_ids)
        observe_all(env_ids, False, self._pack)

    def markers(self, env_id: int) -> list[Marker]:
        """Returns markers of past positions of the centre of mass, and of the goal."""
        goal = self.goal[env_id]
        there = goal_disc(goal, self.goal_reached) if self.ball else flag(goal)
        return [*trace_markers(env_id, self.trace), there]


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
