"""The rules of following planned footsteps in three dimensions, as compiled functions."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from trl_suite.kinematics.spatial import polar
from trl_suite.kinematics.spatial_reference import feature, moment
from trl_suite.tasks.components import rewards
from trl_suite.tasks.components.comparison import (
    Comparison,
    com_error,
    height_error,
    pose_error,
    rate_error,
    term,
)
from trl_suite.tasks.components.footstep_plan import (
    FootstepPlan,
    observe_plan,
    update_stance,
)
from trl_suite.tasks.components.spatial_rules import (
    SpatialRules,
    breaks_down,
    measure,
    observe_body,
    publish,
    tick,
)
from trl_suite.tasks.task import conclude
from trl_suite.util.compiled import compiled, compiled_loop

NEAR_GOAL = 0.1  # m; nearer a goal gives no direction
GOAL_REACHED = 1.0  # m; a goal is drawn anew there
TYPICAL_POSES = 31  # of a step, whose mean is the middle of position control
HIDDEN = ('contact', 'plan')  # blocks of a hidden plan

POSE, VELOCITY, END_EFFECTOR, COM, ROOT, HEADING = range(len(rewards.STEP_TERMS))


class FootstepState(NamedTuple):
    """What the task knows beside the plan, (n, ...).

    Attributes:
      length, width: of the current steps, m.
      track: of the reference.
      turned: by which the reference is turned, rad.
      shift: where the origin of its track is, (n, 2) m.
      goal: (n, 3) m.
      push: force on the torso, (n, 3) N.
      push_end, push_begin: control steps of an episode at which the push ends and the next begins.
      excused: control step of an episode until which no foot misses.
      missed: whether a foot landed too far from its place in the last step.
    """

    length: np.ndarray
    width: np.ndarray
    track: np.ndarray
    turned: np.ndarray
    shift: np.ndarray
    goal: np.ndarray
    push: np.ndarray
    push_end: np.ndarray
    push_begin: np.ndarray
    excused: np.ndarray
    missed: np.ndarray


class FootstepRules(NamedTuple):
    """All that the rules of footsteps work on.

    Attributes:
      contact, plan_block: where these blocks begin in the full observation.
      goal_block: where the goal is seen; -1: it is not.
      footstep_scales, heading_scale: of errors in the reward.
      largest_miss: of a foot that lands, m.
    """

    common: SpatialRules
    comparison: Comparison
    plan: FootstepPlan
    state: FootstepState
    contact: int
    plan_block: int
    goal_block: int
    footstep_scales: np.ndarray
    heading_scale: float
    largest_miss: float


# A step of simulation i: `land`, the next plan where stance switches, `finish`.


@compiled
def land(i: int, rules: FootstepRules) -> bool:
    """Measures the body and looks at what has landed; returns whether it wants another plan."""
    common, plan, state = rules.common, rules.plan, rules.state
    tick(i, common)
    plan.landed[i] = state.missed[i] = False
    if breaks_down(i, common):
        return False
    measure(i, common)
    plan.landed[i] = update_stance(i, common.clock.phase[i], common.found, plan)
    if plan.landed[i] and plan.landing_error[i] > rules.largest_miss:
        state.missed[i] = common.clock.steps[i] > state.excused[i]
    return plan.landed[i]


@compiled
def finish(i: int, rules: FootstepRules) -> None:
    """Reward, failure and observation."""
    outcome = rules.common.outcome
    if outcome.diverged[i]:  # the last finite observation stands
        conclude(i, True, outcome)
        return
    compare(i, rules)
    conclude(i, rules.common.found.fallen[i] or rules.state.missed[i], outcome)
    observe(i, rules)


@compiled
def step_phase(phase: float) -> float:
    """Share of the single step that has passed, of the phase of two."""
    return 2 * phase - np.floor(2 * phase)


@compiled
def compare(i: int, rules: FootstepRules) -> None:
    """Writes the reward terms: the reference's pose and motion, and where and how feet land."""
    common, plan, by = rules.common, rules.plan, rules.comparison
    found, terms, state = common.found, common.outcome.reward_terms, rules.state
    share = step_phase(common.clock.phase[i])
    row, rest = moment(share, state.track[i], by.tracks)
    terms[i, POSE] = term(POSE, pose_error(i, row, rest, by, found), by)
    terms[i, VELOCITY] = term(VELOCITY, rate_error(i, row, rest, by, found), by)
    # The reference heads where the character did when it was put there.
    terms[i, COM] = term(COM, com_error(i, row, rest, state.turned[i], by, found), by)
    terms[i, ROOT] = term(ROOT, height_error(i, row, rest, by, found), by)

    swing, late = 1 - plan.stance[i], share > 0.5
    feet = step = 0.0
    for foot in range(2):
        for k in range(3):
            # In the second half the plan takes the place of the reference.
            if not (late and foot == swing and k < 2):
                column = by.effectors + 3 * foot + k
                off = found.features[i, column] - feature(row, rest, column, by.tracks)
                feet += off * off
    if late:
        for k in range(3):
            off = plan.landing[i, 0, k] - found.feet[i, swing, k]
            if k == 2:
                off += feature(row, rest, by.effectors + 3 * swing + 2, by.tracks)
            step += off * off
    end = 0.0
    for scale in rules.footstep_scales:
        end += term(END_EFFECTOR, feet + scale * step, by)
    terms[i, END_EFFECTOR] = end / len(rules.footstep_scales)
    off = abs(rewards.wrapped(plan.heading[i] - found.heading[i]))
    facing = rewards.facing(min(rules.heading_scale * off, math.pi))
    terms[i, HEADING] = by.term_weights[HEADING] * facing


@compiled
def observe(i: int, rules: FootstepRules) -> None:
    """Writes the observation."""
    common, found = rules.common, rules.common.found
    observe_body(i, common)
    observe_plan(i, rules.contact, rules.plan_block, found, rules.plan, common.full)
    if rules.goal_block >= 0:
        x = rules.state.goal[i, 0] - found.root[i, 0]
        y = rules.state.goal[i, 1] - found.root[i, 1]
        bearing, distance = polar(i, x, y, found)
        common.full[i, rules.goal_block] = bearing
        common.full[i, rules.goal_block + 1] = distance
    publish(i, common)


# Loops over simulations; they take packs.


@compiled_loop
def land_all(env_ids: np.ndarray, rules: FootstepRules) -> int:
    """Looks at what has landed; returns how many want another plan."""
    switched = 0
    for i in env_ids:
        switched += land(i, rules)
    return switched


@compiled_loop
def finish_all(env_ids: np.ndarray, rules: FootstepRules) -> None:
    """Finishes steps."""
    for i in env_ids:
        finish(i, rules)


@compiled_loop
def observe_all(env_ids: np.ndarray, rules: FootstepRules) -> None:
    """Observes, and compares as if a step had been taken."""
    for i in env_ids:
        measure(i, rules.common)
        compare(i, rules)
        observe(i, rules)
