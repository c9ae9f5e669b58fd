"""Tracking planned footsteps: compiled functions of one simulation."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from trl_suite.bodies.body import write_distance
from trl_suite.bodies.reference import feature, moment, observe_phase
from trl_suite.bodies.state import FLAG, PLACE, POINT, REAL, WHOLE
from trl_suite.tasks.common.footstep_plan import FootstepPlan, observe_plan, update_stance
from trl_suite.tasks.common.goals import observe_place
from trl_suite.tasks.rewards import (
    HEADING_WEIGHT,
    STEP_TERMS,
    Term,
    com_error,
    conclude,
    facing,
    give,
    motion_errors,
    score,
    wrapped,
)
from trl_suite.tasks.tracking import TrackingData, proceed, publish
from trl_suite.util.compiled import compiled

HEADING = Term(
    'heading',
    HEADING_WEIGHT,
    '((1 + cos error) / 2)^4, error: angle between heading and planned heading',
)
PLANAR_HEADING = Term(
    'heading', HEADING_WEIGHT, '1 while the trunk points forwards, 0 while it points backwards'
)
TERMS, PLANAR_TERMS = (*STEP_TERMS, HEADING), (*STEP_TERMS, PLANAR_HEADING)


class FootstepState(NamedTuple):
    """State of the task in addition to the plan, (n, ...).

    Attributes:
      length, width: length and width of the current steps, m.
      track: track of the reference, see `Reference`.
      turned: rotation of the reference about z, rad.
      shift: position of the origin of its track, (n, 2) m.
      goal: position of the goal, (n, 3) m.
      excused: control step of an episode until which landing errors do not count.
      staying: number of further footsteps for which the walker is to stay where it is.
      missed: whether the landing error was too large in the last step.
    """

    length: np.ndarray = REAL
    width: np.ndarray = REAL
    track: np.ndarray = WHOLE
    turned: np.ndarray = REAL
    shift: np.ndarray = POINT
    goal: np.ndarray = PLACE
    excused: np.ndarray = WHOLE
    staying: np.ndarray = WHOLE
    missed: np.ndarray = FLAG


class FootstepData(NamedTuple):
    """Data for the compiled functions of footsteps.

    Attributes:
      tracking: data of every tracking task; the period is that of two steps.
      turns: whether the character turns; a planar one can only point backwards.
      pose_scale, footstep_scales, heading_scale: factors of errors in the reward.
      largest_miss: landing error above which the episode fails, m.
    """

    tracking: TrackingData
    plan: FootstepPlan
    state: FootstepState
    turns: bool
    pose_scale: float
    footstep_scales: np.ndarray
    heading_scale: float
    largest_miss: float


# A step of simulation i, after the body was measured: `land`, the next plan if stance switches,
# `finish`.


@compiled
def land(i: int, data: FootstepData) -> bool:
    """Advances the clock and detects landings; returns whether a new plan is needed."""
    plan, state, tracking = data.plan, data.state, data.tracking
    plan.landed[i] = state.missed[i] = False
    if not proceed(i, tracking):
        return False
    clock = tracking.clock
    plan.landed[i] = update_stance(i, clock.phase[i], tracking.measurement, plan)
    if plan.landed[i] and plan.landing_error[i] > data.largest_miss:
        state.missed[i] = clock.steps[i] > state.excused[i]
    return plan.landed[i]


@compiled
def finish(i: int, data: FootstepData) -> None:
    """Computes reward, failure and observation, unless the physics has diverged."""
    outcome = data.tracking.outcome
    if not outcome.diverged[i]:
        compare(i, data)
        conclude(i, data.tracking.measurement.fallen[i] or data.state.missed[i], outcome)
        observe(i, data)


@compiled
def compare(i: int, data: FootstepData) -> None:
    """Writes the reward terms, from errors to the reference and to the plan."""
    plan, state, comparison = data.plan, data.state, data.tracking.comparison
    measurement, tracks = data.tracking.measurement, comparison.tracks
    share = 2 * data.tracking.clock.phase[i] % 1  # of the single step
    row, fraction = moment(share, state.track[i], tracks)
    pose, velocity, height = motion_errors(i, row, fraction, comparison, measurement)
    # The reference was aligned with the heading of the character at the switch of stance.
    com = com_error(i, row, fraction, state.turned[i], comparison, measurement)

    swing, late = 1 - plan.stance[i], share > 0.5
    feet = step = 0.0
    for foot in range(2):
        for k in range(3):
            # In the second half, x and y of the swing foot are compared with the plan instead.
            if not (late and foot == swing and k < 2):
                column = comparison.columns.effectors + 3 * foot + k
                off = measurement.features[i, column] - feature(row, fraction, column, tracks)
                feet += off * off
    if late:
        column = comparison.columns.effectors + 3 * swing + 2  # height of the swing foot
        for k in range(3):
            off = plan.landing[i, 0, k] - measurement.feet[i, swing, k]
            if k == 2:
                off += feature(row, fraction, column, tracks)
            step += off * off
    terms, outcome = comparison.terms, data.tracking.outcome
    score(i, data.pose_scale * pose, terms.pose, outcome)
    score(i, velocity, terms.velocity, outcome)
    score(i, com, terms.com, outcome)
    score(i, height, terms.root, outcome)
    end = 0.0
    for scale in data.footstep_scales:
        score(i, feet + scale * step, terms.end_effector, outcome)
        end += outcome.reward_terms[i, terms.end_effector.column]
    outcome.reward_terms[i, terms.end_effector.column] = end / len(data.footstep_scales)
    off = abs(wrapped(plan.heading[i] - measurement.heading[i]))
    if not data.turns and measurement.cosine[i] < 0.0:
        off = math.pi
    give(i, facing(min(data.heading_scale * off, math.pi)), terms.heading, outcome)


@compiled
def observe(i: int, data: FootstepData) -> None:
    """Writes the blocks after those of the body: phase, contact and plan, and the goal."""
    tracking = data.tracking
    columns, full, measurement = tracking.shown.columns, tracking.shown.full, tracking.measurement
    observe_phase(i, columns, tracking.clock, full)
    observe_plan(i, columns, measurement, data.plan, full)
    if columns.goal >= 0:
        x = data.state.goal[i, 0] - measurement.root[i, 0]
        y = data.state.goal[i, 1] - measurement.root[i, 1]
        observe_place(i, columns.goal, x, y, measurement, full)
    publish(i, tracking.shown, tracking.outcome)


# Loops over simulations; they take packs.


@compiled
def land_all(env_ids: np.ndarray, data: FootstepData) -> int:
    """Detects landings, and finishes other steps; returns how many simulations need a new plan."""
    switched = 0
    for i in env_ids:
        if land(i, data):
            switched += 1
        else:
            finish(i, data)
    return switched


@compiled
def finish_all(env_ids: np.ndarray, data: FootstepData) -> None:
    """Finishes steps."""
    for i in env_ids:
        finish(i, data)


@compiled
def align_all(env_ids: np.ndarray, tracks: np.ndarray, data: FootstepData) -> None:
    """Aligns tracks of the reference (m,) with position and heading of the characters."""
    tracking, state = data.tracking, data.state
    table, columns = tracking.comparison.tracks, tracking.comparison.columns
    for k in range(len(env_ids)):
        i = env_ids[k]
        state.track[i] = tracks[k]
        row, fraction = moment(2 * tracking.clock.phase[i] % 1, tracks[k], table)
        turned = tracking.measurement.heading[i] - feature(row, fraction, columns.heading, table)
        x = feature(row, fraction, columns.root, table)
        y = feature(row, fraction, columns.root + 1, table)
        cosine, sine = math.cos(turned), math.sin(turned)
        state.turned[i] = turned
        state.shift[i, 0] = tracking.measurement.root[i, 0] - (cosine * x - sine * y)
        state.shift[i, 1] = tracking.measurement.root[i, 1] - (sine * x + cosine * y)


@compiled
def observe_all(env_ids: np.ndarray, data: FootstepData) -> None:
    """Writes distances, reward terms of the current state, and observations."""
    for i in env_ids:
        write_distance(i, data.tracking.along, data.tracking.measurement, data.tracking.travel)
        compare(i, data)
        observe(i, data)
