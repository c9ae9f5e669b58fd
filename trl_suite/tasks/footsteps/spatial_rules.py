"""Tracking planned footsteps in three dimensions: compiled functions."""

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

POSE, VELOCITY, END_EFFECTOR, COM, ROOT, HEADING = range(len(rewards.STEP_TERMS))


class FootstepState(NamedTuple):
    """State of the task in addition to the plan, (n, ...).

    Attributes:
      length, width: length and width of the current steps, m.
      track: track of the reference, see `SpatialReference`.
      turned: rotation of the reference about z, rad.
      shift: position of the origin of its track, (n, 2) m.
      goal: position of the goal, (n, 3) m.
      push: force on the torso, (n, 3) N.
      push_end, push_begin: control steps of an episode at which the push ends and the next begins.
      excused: control step of an episode until which landing errors do not count.
      missed: whether the landing error was too large in the last step.
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
    """Data for the compiled functions of footsteps.

    Attributes:
      contact, plan_block: first columns of these blocks in the full observation.
      goal_block: first column of the block goal; -1: not observed.
      footstep_scales, heading_scale: factors of errors in the reward.
      largest_miss: landing error above which the episode fails, m.
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


# A step of simulation i: `land`, the next plan if stance switches, `finish`.


@compiled
def land(i: int, rules: FootstepRules) -> bool:
    """Advances the clock, measures, and detects landings; returns whether a new plan is needed."""
    common, plan, state = rules.common, rules.plan, rules.state
    tick(i, common)
    plan.landed[i] = state.missed[i] = False
    if breaks_down(i, common):
        return False
    measure(i, common)
    plan.landed[i] = update_stance(i, common.clock.phase[i], common.measurement, plan)
    if plan.landed[i] and plan.landing_error[i] > rules.largest_miss:
        state.missed[i] = common.clock.steps[i] > state.excused[i]
    return plan.landed[i]


@compiled
def finish(i: int, rules: FootstepRules) -> None:
    """Computes reward, failure and observation."""
    outcome = rules.common.outcome
    if outcome.diverged[i]:  # keeps the last finite observation
        conclude(i, True, outcome)
        return
    compare(i, rules)
    conclude(i, rules.common.measurement.fallen[i] or rules.state.missed[i], outcome)
    observe(i, rules)


@compiled
def step_phase(phase: float) -> float:
    """Returns the phase of the single step from the phase of the cycle of two."""
    return 2 * phase - np.floor(2 * phase)


@compiled
def compare(i: int, rules: FootstepRules) -> None:
    """Writes the reward terms, from errors to the reference and to the plan."""
    common, plan, comparison = rules.common, rules.plan, rules.comparison
    measurement, terms, state = common.measurement, common.outcome.reward_terms, rules.state
    share = step_phase(common.clock.phase[i])
    row, fraction = moment(share, state.track[i], comparison.tracks)
    terms[i, POSE] = term(POSE, pose_error(i, row, fraction, comparison, measurement), comparison)
    terms[i, VELOCITY] = term(
        VELOCITY, rate_error(i, row, fraction, comparison, measurement), comparison
    )
    # The reference was aligned with the heading of the character at the switch of stance.
    terms[i, COM] = term(
        COM, com_error(i, row, fraction, state.turned[i], comparison, measurement), comparison
    )
    terms[i, ROOT] = term(ROOT, height_error(i, row, fraction, comparison, measurement), comparison)

    swing, late = 1 - plan.stance[i], share > 0.5
    feet = step = 0.0
    for foot in range(2):
        for k in range(3):
            # In the second half, x and y of the swing foot are compared with the plan instead.
            if not (late and foot == swing and k < 2):
                column = comparison.effectors + 3 * foot + k
                off = measurement.features[i, column] - feature(
                    row, fraction, column, comparison.tracks
                )
                feet += off * off
    if late:
        for k in range(3):
            off = plan.landing[i, 0, k] - measurement.feet[i, swing, k]
            if k == 2:
                off += feature(
                    row, fraction, comparison.effectors + 3 * swing + 2, comparison.tracks
                )
            step += off * off
    end = 0.0
    for scale in rules.footstep_scales:
        end += term(END_EFFECTOR, feet + scale * step, comparison)
    terms[i, END_EFFECTOR] = end / len(rules.footstep_scales)
    off = abs(rewards.wrapped(plan.heading[i] - measurement.heading[i]))
    facing = rewards.facing(min(rules.heading_scale * off, math.pi))
    terms[i, HEADING] = comparison.term_weights[HEADING] * facing


@compiled
def observe(i: int, rules: FootstepRules) -> None:
    """Writes the observation."""
    common, measurement = rules.common, rules.common.measurement
    observe_body(i, common)
    observe_plan(i, rules.contact, rules.plan_block, measurement, rules.plan, common.full)
    if rules.goal_block >= 0:
        x = rules.state.goal[i, 0] - measurement.root[i, 0]
        y = rules.state.goal[i, 1] - measurement.root[i, 1]
        bearing, distance = polar(i, x, y, measurement)
        common.full[i, rules.goal_block] = bearing
        common.full[i, rules.goal_block + 1] = distance
    publish(i, common)


# Loops over simulations; they take packs.


@compiled_loop
def land_all(env_ids: np.ndarray, rules: FootstepRules) -> int:
    """Detects landings; returns how many simulations need a new plan."""
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
    """Measures, writes reward terms for the current state, and observes."""
    for i in env_ids:
        measure(i, rules.common)
        compare(i, rules)
        observe(i, rules)
