"""Navigation by planned footsteps: compiled functions of one simulation."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from trl_suite.actuation.action_map import Drive, in_units
from trl_suite.bodies.body import MAX_JOINT_SPEED, BodyData, Travel, write_distance
from trl_suite.bodies.reference import CONTROL_TIMESTEP, Clock, observe_phase, tick
from trl_suite.bodies.spatial import has_diverged, measure, observe_body
from trl_suite.bodies.state import FLAG, REAL, WHOLE
from trl_suite.tasks.common.footstep_plan import FootstepPlan, observe_plan, update_stance
from trl_suite.tasks.common.goals import (
    SPEED_REWARD,
    GoalData,
    dribble,
    observe_goal,
    speed_reward,
    store_start,
    store_trace,
    test_goal,
)
from trl_suite.tasks.rewards import FALL_THRESHOLD, Outcome, Term, conclude, give, sample_fall
from trl_suite.terrain.spatial import windows as spatial_ground
from trl_suite.util.compiled import compiled

UPRIGHT = 0.2  # constant reward of a step without a fall
NAVIGATION_TERMS = (
    Term(
        'speed',
        1 - UPRIGHT,
        f'{SPEED_REWARD}, v: speed of the centre of mass towards the goal, m/s',
    ),
    Term('upright', UPRIGHT, '1'),
)
SAMPLE_FRAMES = 3  # control steps between two samples: 0.1 s


class PlanningState(NamedTuple):
    """State of the task in addition to plan and goal, (n, ...).

    Attributes:
      lasted: number of control steps so far in this step.
      duration: duration of the last step, s.
      down: decaying average of samples with a fall link on the ground.
      over: whether the step is over.
      controller: index of the footstep controller of this step.
    """

    lasted: np.ndarray = WHOLE
    duration: np.ndarray = REAL
    down: np.ndarray = REAL
    over: np.ndarray = FLAG
    controller: np.ndarray = WHOLE


class ControllerData(NamedTuple):
    """What the footstep controller observes: columns of the blocks, and observations (n, size)."""

    columns: Any
    observation: np.ndarray


class PlanningData(NamedTuple):
    """Data for the compiled functions of navigation by planned footsteps.

    Attributes:
      period: that of two footsteps, s.
      controller: the observation of the footstep controller.
      columns: first columns of the blocks of the observation; -1: not observed.
      terms: the reward terms of a walker's goal; with a ball, those of `aims` are used.
      by_plan: whether a step is a footstep, not a control step.
      plan_map: the map from actions to plans, in m and rad.
      controllers: number of footstep controllers.
    """

    body: BodyData
    outcome: Outcome
    clock: Clock
    travel: Travel
    period: float
    controller: ControllerData
    plan: FootstepPlan
    aims: GoalData
    state: PlanningState
    columns: Any
    terms: Any
    by_plan: bool
    plan_map: Drive
    controllers: int


# A step: `begin_steps`; then for every control step the action of the footstep controller, physics and
# `finish_control_steps`; then `score_all`, the next goals if some are needed, `finish_all`.


@compiled
def lay_plan(i: int, action: np.ndarray, data: PlanningData) -> None:
    """Sets the plan from the action, relative to the root and its heading, if a footstep begins.

    After the plan, an action has a number for each of several controllers; the largest selects one, of equal
    ones the first.
    """
    plan, measurement, ground = data.plan, data.body.measurement, data.body.ground
    if not (data.by_plan or plan.landed[i] or data.clock.steps[i] == 0):
        return
    heading = measurement.heading[i]
    cosine, sine = math.cos(heading), math.sin(heading)
    for which in range(2):
        ahead = in_units(i, 2 * which, action, data.plan_map)
        left = in_units(i, 2 * which + 1, action, data.plan_map)
        x = measurement.root[i, 0] + (cosine * ahead - sine * left)
        y = measurement.root[i, 1] + (sine * ahead + cosine * left)
        plan.landing[i, which, 0], plan.landing[i, which, 1] = x, y
        plan.landing[i, which, 2] = spatial_ground.height(i, x, y, ground)
    plan.heading[i] = heading + in_units(i, 4, action, data.plan_map)
    best = 0
    for k in range(1, data.controllers):
        if in_units(i, 5 + k, action, data.plan_map) > in_units(i, 5 + best, action, data.plan_map):
            best = k
    data.state.controller[i] = best


@compiled
def observe_for_controller(i: int, data: PlanningData) -> None:
    """Writes the observation of the footstep controller, as in `SpatialFootsteps`."""
    body, columns, observation = data.body, data.controller.columns, data.controller.observation
    observe_body(i, columns, body, observation)
    observe_phase(i, columns, data.clock, observation)
    observe_plan(i, columns, body.measurement, data.plan, observation)


@compiled
def finish_control_step(i: int, data: PlanningData) -> bool:
    """Finishes a control step within a step: clock, divergence, measurement, falls, landings.

    Returns:
      Whether the step continues; the observation of the footstep controller is then written.
    """
    body, state, outcome, plan = data.body, data.state, data.outcome, data.plan
    tick(i, data.period, data.clock)
    state.lasted[i] += 1
    data.outcome.diverged[i] = has_diverged(i, MAX_JOINT_SPEED, body)
    if data.outcome.diverged[i]:
        outcome.failed[i] = state.over[i] = True
        return False
    count, measurement = data.clock.steps[i], body.measurement
    measure(i, body)
    write_distance(i, False, measurement, data.travel)
    if count % SAMPLE_FRAMES == 0:
        sample_fall(i, measurement.fallen[i], state.down)
    outcome.failed[i] = state.down[i] > FALL_THRESHOLD
    if update_stance(i, data.clock.phase[i], measurement, plan):
        plan.landed[i] = True
    store_trace(i, count, measurement, data.aims.goals)
    state.over[i] = plan.landed[i] or outcome.failed[i] or not data.by_plan
    if not state.over[i]:
        observe_for_controller(i, data)
    return not state.over[i]


@compiled
def score_step(i: int, data: PlanningData) -> bool:
    """Writes the reward terms and tests goal and ball; returns whether one must be redrawn."""
    body, aims, state, outcome = data.body, data.aims, data.state, data.outcome
    measurement, place, begin = body.measurement, aims.goals.place, aims.goals.walker
    seconds = CONTROL_TIMESTEP * state.lasted[i]
    state.duration[i] = seconds
    aims.goals.wanted[i] = aims.ball.wanted[i] = False
    if outcome.diverged[i]:
        return False
    if aims.with_ball:
        aims.goals.speed[i] = dribble(i, seconds, body.physics, measurement, aims, outcome)
    else:
        x, y = place[i, 0] - begin[i, 0], place[i, 1] - begin[i, 1]
        distance = math.hypot(x, y)
        moved_x = measurement.com[i, 0] - begin[i, 0]
        moved_y = measurement.com[i, 1] - begin[i, 1]
        speed = (moved_x * x + moved_y * y) / max(distance, 1e-9) / seconds
        near = distance < aims.near
        worth = 1.0 if near else speed_reward(speed, aims.target_speed)
        give(i, worth, data.terms.speed, outcome)
        give(i, 1.0, data.terms.upright, outcome)
        aims.goals.speed[i] = speed
    return not outcome.failed[i] and test_goal(i, data.clock.steps[i], measurement, aims)


@compiled
def observe(i: int, data: PlanningData) -> None:
    """Writes the observation."""
    body, measurement, columns = data.body, data.body.measurement, data.columns
    observation = data.outcome.observation
    observe_body(i, columns, body, observation)
    observe_goal(i, columns, body.physics, measurement, data.aims, observation)
    if columns.low_level >= 0:
        observe_for_controller(i, data)
        for k in range(data.controller.observation.shape[1]):
            observation[i, columns.low_level + k] = data.controller.observation[i, k]


# Loops over simulations; they take packs.


@compiled
def begin_steps(env_ids: np.ndarray, action: np.ndarray, data: PlanningData) -> None:
    """Sets plans where footsteps begin, and writes the footstep controller's observations."""
    body, state = data.body, data.state
    for i in env_ids:
        measure(i, body)  # a restored state has no measurement
        lay_plan(i, action, data)
        state.lasted[i] = 0
        store_start(i, body.physics, body.measurement, data.aims)
        data.plan.landed[i] = False
        observe_for_controller(i, data)


@compiled
def show_plans(env_ids: np.ndarray, action: np.ndarray, data: PlanningData) -> None:
    """Sets plans as `begin_steps` would, and writes observations."""
    for i in env_ids:
        measure(i, data.body)
        lay_plan(i, action, data)
        observe_for_controller(i, data)
        observe(i, data)


@compiled
def finish_control_steps(env_ids: np.ndarray, data: PlanningData) -> int:
    """Finishes a control step; returns how many steps continue."""
    going = 0
    for i in env_ids:
        going += finish_control_step(i, data)
    return going


@compiled
def score_all(env_ids: np.ndarray, data: PlanningData) -> int:
    """Writes reward terms; returns in how many simulations goal or ball must be redrawn."""
    wanted = 0
    for i in env_ids:
        wanted += score_step(i, data)
    return wanted


@compiled
def finish_all(env_ids: np.ndarray, data: PlanningData) -> None:
    """Computes rewards and observations."""
    for i in env_ids:
        conclude(i, data.outcome.failed[i], data.outcome)
        if not data.outcome.diverged[i]:  # otherwise keeps the last finite observation
            observe(i, data)


@compiled
def observe_all(env_ids: np.ndarray, data: PlanningData) -> None:
    """Writes distances and observations, after bodies were measured."""
    for i in env_ids:
        write_distance(i, False, data.body.measurement, data.travel)
        observe(i, data)
