"""Navigation by planned footsteps: compiled functions of one simulation."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from trl_suite.kinematics.blocks import HEIGHTS, Block, Reflection
from trl_suite.kinematics.spatial import polar
from trl_suite.kinematics.spatial_figure import LINES
from trl_suite.tasks.components.ball import (
    BallRules,
    dribble,
    observe_ball,
    remember,
)
from trl_suite.tasks.components.footstep_plan import (
    FootstepPlan,
    observe_plan,
    update_stance,
)
from trl_suite.tasks.components.goals import Goals
from trl_suite.tasks.components.observation import write_body, write_terrain
from trl_suite.tasks.components.spatial_rules import (
    CONTROL_TIMESTEP,
    SpatialRules,
    breaks_down,
    measure,
    observe_body,
    tick,
)
from trl_suite.tasks.components.trace import Trace, follow
from trl_suite.tasks.task import conclude
from trl_suite.tasks.terms import Term, give
from trl_suite.terrain.spatial import windows as spatial_ground
from trl_suite.terrain.spatial.windows import SAMPLES
from trl_suite.util.compiled import compiled, compiled_loop

CONTROLLER = 'PD_Biped3D_LLC_General_Step-v0'  # its shipped policy is the default controller
MAPS = ('height', 'velocity')
GOAL_REACHED = 1.0  # m; default
SPEED_SHARPNESS = 1.5
UPRIGHT = 0.2  # constant reward of a step without a fall
NAVIGATION_TERMS = (
    Term(
        'speed', 1 - UPRIGHT,
        f'exp(-{SPEED_SHARPNESS:g} min(0, v - target speed)^2), v: speed of the centre of mass towards the '
        'goal, m/s',
    ),
    Term('upright', UPRIGHT, '1'),
)  # fmt: skip
SURFACE = Block(
    'surface', 2 * SAMPLES**2, 'm/s',
    'velocity of the ground relative to that under the root, on 32 lines from left to right (5.5 m to '
    'each side), each with 32 points from 1 m behind to 10 m ahead: first all components ahead, then all '
    'components to the right',
    HEIGHTS._replace(bias=(0.0, 0.0, 0.0)),
    Reflection(
        np.append(LINES, SAMPLES**2 + LINES), np.repeat([1.0, -1.0], SAMPLES**2)
    ),
)  # fmt: skip
CONTACT_DECAY, CONTACT_GAIN, FALL_THRESHOLD = (
    0.9,
    1 / 11,
    0.25,
)  # of the decaying average of samples with a fall link on the ground
SAMPLE_FRAMES = 3  # control steps between two samples: 0.1 s
FARTHEST_GOAL = 100.0  # m; upper bound of the option goal_distance
LONGEST = 60  # limit of control steps per step; the clock switches stance long before


class PlanningState(NamedTuple):
    """State of the task in addition to plan and goal, (n, ...).

    Attributes:
      lasted: number of control steps in the last step.
      duration: duration of the last step, s.
      begin: position of the centre of mass at its beginning, (n, 3) m.
      down: decaying average of samples with a fall link on the ground.
      speed: mean speed of walker or ball towards the goal in the last step, m/s.
      action: clipped action, (n, k).
      over: whether the step is over.
    """

    lasted: np.ndarray
    duration: np.ndarray
    begin: np.ndarray
    down: np.ndarray
    speed: np.ndarray
    action: np.ndarray
    over: np.ndarray


class PlanningRules(NamedTuple):
    """Data for the compiled functions of navigation by planned footsteps.

    The full observation of `common` is the observation of the footstep controller.

    Attributes:
      low_columns: first columns of the blocks contact and plan in the full observation.
      columns: first columns of the blocks of the observation; -1: not observed.
      terms: the reward terms of a goal.
      by_plan: whether a step is a footstep, not a control step.
      plan_offset, plan_scale: offset and scale of actions.
      target_speed, goal_reached: see `HierarchicalConfig`, m/s and m.
      with_ball: whether the goal is that of a ball.
    """

    common: SpatialRules
    plan: FootstepPlan
    goals: Goals
    state: PlanningState
    trace: Trace
    low_columns: Any
    columns: Any
    terms: Any
    by_plan: bool
    plan_offset: np.ndarray
    plan_scale: np.ndarray
    target_speed: float
    goal_reached: float
    with_ball: bool
    ball: BallRules


# A step of simulation i: `begin_step`; then for every control step the action of the footstep
# controller, physics and `finish_control_step`; then `score`, the next goal if one is needed,
# `finish`.


@compiled
def begin_step(i: int, rules: PlanningRules) -> None:
    """Sets the plan if a footstep begins, and writes the footstep controller's observation."""
    common, state = rules.common, rules.state
    measure(i, common)
    lay_plan(i, rules)
    state.lasted[i] = 0
    for k in range(3):
        state.begin[i, k] = common.measurement.com[i, k]
    if rules.with_ball:
        remember(i, common.physics, common.measurement, rules.ball)
    rules.plan.landed[i] = False
    observe_low(i, rules)


@compiled
def lay_plan(i: int, rules: PlanningRules) -> None:
    """Sets the plan from the action, relative to the root and its heading, if a footstep begins."""
    plan, measurement, ground = rules.plan, rules.common.measurement, rules.common.ground
    if not (rules.by_plan or plan.landed[i] or rules.common.clock.steps[i] == 0):
        return
    heading = measurement.heading[i]
    cosine, sine = math.cos(heading), math.sin(heading)
    for which in range(2):
        ahead, left = meant(i, 2 * which, rules), meant(i, 2 * which + 1, rules)
        x = measurement.root[i, 0] + (cosine * ahead - sine * left)
        y = measurement.root[i, 1] + (sine * ahead + cosine * left)
        plan.landing[i, which, 0], plan.landing[i, which, 1] = x, y
        plan.landing[i, which, 2] = spatial_ground.height(i, x, y, ground)
    plan.heading[i] = heading + meant(i, 4, rules)


@compiled
def meant(i: int, k: int, rules: PlanningRules) -> float:
    """Returns number k of the action in physical units, m or rad."""
    return rules.state.action[i, k] * rules.plan_scale[k] + rules.plan_offset[k]


@compiled
def observe_low(i: int, rules: PlanningRules) -> None:
    """Writes the observation of the footstep controller."""
    common = rules.common
    observe_body(i, common)
    observe_plan(i, rules.low_columns, common.measurement, rules.plan, common.full)


@compiled
def finish_control_step(i: int, rules: PlanningRules) -> bool:
    """Finishes a control step within a step: clock, divergence, measurement, falls, landings.

    Returns:
      Whether the step continues; the observation of the footstep controller is then written.
    """
    common, state, outcome = rules.common, rules.state, rules.common.outcome
    tick(i, common)
    state.lasted[i] += 1
    if breaks_down(i, common):
        outcome.failed[i] = state.over[i] = True
        return False
    measure(i, common)
    count, measurement = common.clock.steps[i], common.measurement
    if count % SAMPLE_FRAMES == 0:
        state.down[i] *= CONTACT_DECAY
        state.down[i] += CONTACT_GAIN * measurement.fallen[i]
    outcome.failed[i] = state.down[i] > FALL_THRESHOLD
    if update_stance(i, common.clock.phase[i], measurement, rules.plan):
        rules.plan.landed[i] = True
    follow(i, count, measurement.com, rules.trace)
    state.over[i] = (
        rules.plan.landed[i] or outcome.failed[i] or state.lasted[i] >= LONGEST
        or not rules.by_plan
    )  # fmt: skip
    if not state.over[i]:
        observe_low(i, rules)
    return not state.over[i]


@compiled
def score(i: int, rules: PlanningRules) -> bool:
    """Writes the reward terms and tests goal and ball; returns whether one must be redrawn."""
    common, goals, state, ball = rules.common, rules.goals, rules.state, rules.ball.state
    measurement, outcome = common.measurement, common.outcome
    seconds = CONTROL_TIMESTEP * state.lasted[i]
    state.duration[i] = seconds
    goals.wanted[i] = ball.wanted[i] = False
    if common.outcome.diverged[i]:
        return False
    if rules.with_ball:
        state.speed[i] = dribble(
            i, seconds, goals.place, common.physics, measurement, rules.ball, outcome
        )
    else:
        x, y = goals.place[i, 0] - state.begin[i, 0], goals.place[i, 1] - state.begin[i, 1]
        distance = math.hypot(x, y)
        moved_x, moved_y = (
            measurement.com[i, 0] - state.begin[i, 0],
            measurement.com[i, 1] - state.begin[i, 1],
        )
        speed = (moved_x * x + moved_y * y) / max(distance, 1e-9) / seconds
        lack = min(speed - rules.target_speed, 0.0)
        full = distance < rules.goal_reached
        worth = 1.0 if full else math.exp(-SPEED_SHARPNESS * (lack * lack))
        give(i, worth, rules.terms.speed, outcome)
        give(i, 1.0, rules.terms.upright, outcome)
        state.speed[i] = speed
    if common.outcome.failed[i]:
        return False
    count = common.clock.steps[i]
    late = count >= goals.due[i]
    if rules.with_ball:  # a ball's goal is not redrawn when it is reached
        goals.reached[i] += ball.at_goal[i]
        ball.wanted[i], goals.wanted[i] = count >= ball.due[i], late
    else:
        x, y = (
            goals.place[i, 0] - measurement.root[i, 0],
            goals.place[i, 1] - measurement.root[i, 1],
        )
        reached = math.hypot(x, y) < rules.goal_reached
        goals.reached[i] += reached
        goals.wanted[i] = reached or late
    return goals.wanted[i] or ball.wanted[i]


@compiled
def finish(i: int, rules: PlanningRules) -> None:
    """Computes reward and observation."""
    outcome = rules.common.outcome
    conclude(i, outcome.failed[i], outcome)
    if not outcome.diverged[i]:  # otherwise keeps the last finite observation
        observe(i, rules)


@compiled
def observe(i: int, rules: PlanningRules) -> None:
    """Writes the observation."""
    common, measurement, columns = rules.common, rules.common.measurement, rules.columns
    observation = common.outcome.observation
    write_terrain(i, columns.terrain, common.ground, measurement, observation)
    if columns.surface >= 0:
        block = observation[i, columns.surface : columns.surface + 2 * SAMPLES * SAMPLES]
        x, y = measurement.root[i, 0], measurement.root[i, 1]
        spatial_ground.velocity_map(i, x, y, measurement.heading[i], common.ground, block)
    write_body(i, columns.pose, columns.velocity, measurement, observation)
    place = rules.goals.place
    if rules.with_ball:
        observe_ball(i, columns, place, common.physics, measurement, rules.ball, observation)
    else:
        x, y = place[i, 0] - measurement.root[i, 0], place[i, 1] - measurement.root[i, 1]
        bearing, distance = polar(i, x, y, measurement)
        observation[i, columns.goal], observation[i, columns.goal + 1] = bearing, distance
    if columns.low_level >= 0:
        observe_low(i, rules)
        for k in range(common.full.shape[1]):
            observation[i, columns.low_level + k] = common.full[i, k]


# Loops over simulations; they take packs.


@compiled_loop
def take_all(env_ids: np.ndarray, action: np.ndarray, rules: PlanningRules) -> None:
    """Stores clipped actions."""
    for i in env_ids:
        for k in range(action.shape[1]):
            rules.state.action[i, k] = min(max(action[i, k], -1.0), 1.0)


@compiled_loop
def begin_steps(env_ids: np.ndarray, rules: PlanningRules) -> None:
    """Begins steps."""
    for i in env_ids:
        begin_step(i, rules)


@compiled_loop
def show_plans(env_ids: np.ndarray, rules: PlanningRules) -> None:
    """Sets plans as `begin_steps` would, and writes observations."""
    for i in env_ids:
        measure(i, rules.common)
        lay_plan(i, rules)
        observe(i, rules)


@compiled_loop
def finish_control_steps(env_ids: np.ndarray, rules: PlanningRules) -> int:
    """Finishes a control step; returns how many steps continue."""
    going = 0
    for i in env_ids:
        going += finish_control_step(i, rules)
    return going


@compiled_loop
def score_all(env_ids: np.ndarray, rules: PlanningRules) -> int:
    """Writes reward terms; returns in how many simulations goal or ball must be redrawn."""
    wanted = 0
    for i in env_ids:
        wanted += score(i, rules)
    return wanted


@compiled_loop
def finish_all(env_ids: np.ndarray, rules: PlanningRules) -> None:
    """Finishes steps."""
    for i in env_ids:
        finish(i, rules)


@compiled_loop
def observe_all(env_ids: np.ndarray, rules: PlanningRules) -> None:
    """Observes."""
    for i in env_ids:
        measure(i, rules.common)
        observe(i, rules)
