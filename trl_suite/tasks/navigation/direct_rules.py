"""Direct navigation: compiled functions of one simulation."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from trl_suite.kinematics.spatial import SpatialBodyData, breaks_down, polar
from trl_suite.kinematics.spatial_reference import moment
from trl_suite.tasks.components.ball import BallRules, dribble, observe_ball, remember
from trl_suite.tasks.components.comparison import (
    Comparison,
    com_error,
    effector_error,
    motion_errors,
)
from trl_suite.tasks.components.goals import Goals
from trl_suite.tasks.components.rewards import tracking_terms
from trl_suite.tasks.components.spatial_rules import (
    Clock,
    Travel,
    View,
    look_and_travel,
    observe_body,
    observe_phase,
    publish,
    tick,
)
from trl_suite.tasks.components.trace import Trace, follow
from trl_suite.tasks.task import CONTROL_TIMESTEP, Outcome, conclude
from trl_suite.tasks.terms import Term, facing, give, score, wrapped
from trl_suite.util.compiled import compiled, compiled_loop

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

    speed: np.ndarray


class DirectData(NamedTuple):
    """Data for the compiled functions of direct navigation.

    Attributes:
      period: that of the clip, s.
      goal_reached: distance of the root within which the goal is reached, m.
      with_ball: whether the goal is that of a ball.
    """

    body: SpatialBodyData
    outcome: Outcome
    seen: View
    clock: Clock
    travel: Travel
    period: float
    comparison: Comparison
    goals: Goals
    progress: Progress
    trace: Trace
    goal_reached: float
    with_ball: bool
    ball: BallRules


# A step of simulation i: `advance`, the next goal if one is needed, `finish`.


@compiled
def advance(i: int, data: DirectData) -> bool:
    """Measures the body and tests goal and ball; returns whether one of them must be redrawn."""
    body, goals, state = data.body, data.goals, data.ball.state
    tick(i, data.period, data.clock)
    goals.wanted[i] = state.wanted[i] = False
    data.outcome.diverged[i] = breaks_down(i, body)
    if data.outcome.diverged[i]:
        return False
    look_and_travel(i, body, data.travel)
    count, measurement = data.clock.steps[i], body.measurement
    follow(i, count, measurement.com, data.trace)
    if data.with_ball:
        dribble(
            i, CONTROL_TIMESTEP, goals.place, body.physics, measurement, data.ball, data.outcome
        )
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
    body = data.body
    if data.outcome.diverged[i]:  # keeps the last finite observation
        conclude(i, True, data.outcome)
        return
    if data.with_ball:
        remember(i, body.physics, body.measurement, data.ball)
    compare(i, data)
    conclude(i, body.measurement.fallen[i], data.outcome)
    observe(i, data)


@compiled
def compare(i: int, data: DirectData) -> None:
    """Writes the reward terms: imitation while walking to the goal, or to the ball."""
    body, comparison, measurement = data.body, data.comparison, data.body.measurement
    row, fraction = moment(data.clock.phase[i], 0, comparison.tracks)
    if data.with_ball:
        qpos, first = body.physics.qpos, data.ball.qpos
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
    terms, outcome = comparison.terms, data.outcome
    score(i, pose, terms.pose, outcome)
    score(i, velocity, terms.velocity, outcome)
    score(i, end_effector, terms.end_effector, outcome)
    score(i, com, terms.com, outcome)
    score(i, height, terms.root, outcome)
    give(i, facing(off), terms.heading, outcome)
    score(i, squared / (NEAR * NEAR), terms.proximity, outcome)
    along = measurement.com_velocity[i, 0] * x + measurement.com_velocity[i, 1] * y
    data.progress.speed[i] = along / max(distance, 1e-9)


@compiled
def observe(i: int, data: DirectData) -> None:
    """Writes the observation."""
    body, columns, full = data.body, data.seen.columns, data.seen.full
    measurement, place = body.measurement, data.goals.place
    observe_body(i, columns, body, full)
    observe_phase(i, columns, data.clock, full)
    if data.with_ball:
        observe_ball(i, columns, place, body.physics, measurement, data.ball, full)
    else:
        x, y = place[i, 0] - measurement.root[i, 0], place[i, 1] - measurement.root[i, 1]
        full[i, columns.goal], full[i, columns.goal + 1] = polar(i, x, y, measurement)
    publish(i, data.seen, data.outcome)


# Loops over simulations; they take packs.


@compiled_loop
def advance_all(env_ids: np.ndarray, data: DirectData) -> int:
    """Tests goals and balls; returns in how many simulations one must be redrawn."""
    wanted = 0
    for i in env_ids:
        wanted += advance(i, data)
    return wanted


@compiled_loop
def finish_all(env_ids: np.ndarray, data: DirectData) -> None:
    """Finishes steps."""
    for i in env_ids:
        finish(i, data)


@compiled_loop
def observe_all(env_ids: np.ndarray, fresh: bool, data: DirectData) -> None:
    """Measures, writes reward terms for the current state, and observes.

    If `fresh`, episodes have just begun, and positions of ball and body are stored.
    """
    for i in env_ids:
        look_and_travel(i, data.body, data.travel)
        if fresh and data.with_ball:
            remember(i, data.body.physics, data.body.measurement, data.ball)
        compare(i, data)
        observe(i, data)
