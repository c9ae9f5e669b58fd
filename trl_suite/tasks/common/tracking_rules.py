"""What tasks that track a reference motion share: clock, distance, mirrored view, observation."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from trl_suite.bodies.blocks import CLOCK, Block, Reflection
from trl_suite.bodies.body import Measurement, polar
from trl_suite.bodies.state import PLACE, REAL, WHOLE
from trl_suite.tasks.common.rewards import Comparison
from trl_suite.tasks.task import CONTROL_TIMESTEP, PHASE_BINS
from trl_suite.tasks.terms import Outcome
from trl_suite.util.compiled import compiled, compiled_inline

DIGITS = 1e9  # the clock is rounded to 1 / DIGITS of a cycle


class Clock(NamedTuple):
    """Phase of each simulation in the cycle of its reference motion, (n,).

    Attributes:
      start: phase at the start of the episode.
      steps: control steps since the start.
      cycles: time in periods of the motion: the phase, not wrapped.
      phase: phase in [0, 1).
    """

    start: np.ndarray = REAL
    steps: np.ndarray = WHOLE
    cycles: np.ndarray = REAL
    phase: np.ndarray = REAL


class Travel(NamedTuple):
    """Start and distance travelled of each body.

    Attributes:
      origin: x, y (m) and heading (rad) at the start, (n, 3).
      distance: distance of the root from the start, (n,) m.
    """

    origin: np.ndarray = PLACE
    distance: np.ndarray = REAL


class View(NamedTuple):
    """The full observation, and what of it is observed, with optional mirroring in left stance.

    Attributes:
      full: the full observation, (n, size).
      columns: first columns of its blocks; -1: absent.
      mirrored: whether observations and actions are reflected in left stance.
      source, sign: a reflected full observation is `full[source] * sign`, (size,).
      kept: columns of the full observation that are observed, (k,); all of them if it is empty.
      given_phase: column of the phase in the observation.
      action_source, action_sign: a reflected action is `action[source] * sign`.
      action: actions after reflection, (n, k); scratch.
    """

    full: np.ndarray
    columns: Any
    mirrored: bool
    source: np.ndarray
    sign: np.ndarray
    kept: np.ndarray
    given_phase: int
    action_source: np.ndarray
    action_sign: np.ndarray
    action: np.ndarray


class TrackingData(NamedTuple):
    """Data for the compiled functions of tasks that track a reference motion.

    Attributes:
      measurement: of the bodies, which write their own blocks to `given.full`.
      diverged: whether the physics has diverged in the last step, (n,).
      period: that of the motion, s.
      along: whether the distance travelled is along +x, not in any horizontal direction.
    """

    measurement: Measurement
    diverged: np.ndarray
    outcome: Outcome
    given: View
    clock: Clock
    travel: Travel
    period: float
    along: bool
    comparison: Comparison


# Parts of a step of simulation i.


@compiled
def proceed(i: int, data: TrackingData) -> bool:
    """Advances clock and distance; returns False if the physics has diverged."""
    tick(i, data.period, data.clock)
    data.outcome.diverged[i] = data.diverged[i]
    if data.diverged[i]:
        return False
    go(i, data.along, data.measurement, data.travel)
    return True


@compiled
def tick(i: int, period: float, clock: Clock) -> None:
    """Advances a clock of this period, s, by a control step."""
    clock.steps[i] += 1
    cycles = clock.start[i] + clock.steps[i] * (CONTROL_TIMESTEP / period)
    # Rounded, so that rounding errors of the sum do not delay the switch of stance at half a cycle.
    clock.cycles[i] = np.rint(cycles * DIGITS) / DIGITS
    clock.phase[i] = clock.cycles[i] - np.floor(clock.cycles[i])


@compiled
def go(i: int, along: bool, measurement: Measurement, travel: Travel) -> None:
    """Writes the distance of the root from the start, along +x or in any horizontal direction."""
    x = measurement.root[i, 0] - travel.origin[i, 0]
    y = measurement.root[i, 1] - travel.origin[i, 1]
    travel.distance[i] = x if along else np.sqrt(x * x + y * y)


@compiled
def observe_phase(i: int, columns: Any, clock: Clock, observation: np.ndarray) -> None:
    """Writes the block `PHASE`."""
    if columns.phase >= 0:
        phase = clock.phase[i]
        observation[i, columns.phase] = phase
        for k in range(PHASE_BINS):
            observation[i, columns.phase + 1 + k] = np.floor(phase * PHASE_BINS) == k


# Its phase is that of the cycle; a mirrored observation has that of the step.
PHASE = Block(
    'phase',
    1 + PHASE_BINS,
    '1',
    'phase of the cycle in [0, 1); then the one-hot of its quarter',
    CLOCK,
    Reflection(
        np.append(0, 1 + np.roll(np.arange(PHASE_BINS), PHASE_BINS // 2)), np.ones(1 + PHASE_BINS)
    ),
    kept=tuple(range(1 + PHASE_BINS // 2)),
    kept_meaning='phase of the step in [0, 1); then the one-hot of its half',
)


@compiled
def observe_place(
    i: int, column: int, x: float, y: float, measurement: Measurement, observation: np.ndarray
) -> None:
    """Writes bearing and distance of a place x, y m from the root, in world axes."""
    bearing, distance = polar(i, x, y, measurement)
    observation[i, column], observation[i, column + 1] = bearing, distance


@compiled_inline
def in_left_stance(i: int, view: View) -> bool:
    """Returns whether observation and action are reflected."""
    return view.mirrored and view.full[i, view.columns.phase] >= 0.5


@compiled
def publish(i: int, view: View, outcome: Outcome) -> None:
    """Writes the observation from the full observation."""
    full, observation, left = view.full, outcome.observation, in_left_stance(i, view)
    for k in range(len(view.kept)):
        column = view.kept[k]
        if left:
            observation[i, k] = full[i, view.source[column]] * view.sign[column]
        else:
            observation[i, k] = full[i, column]
    if view.mirrored:  # the phase of the single step
        phase = full[i, view.columns.phase]
        observation[i, view.given_phase] = 2 * (phase - 0.5 if left else phase)


@compiled
def reflect_all(env_ids: np.ndarray, action: np.ndarray, view: View) -> None:
    """Writes `view.action`: actions, which are reflected in left stance. Takes a pack."""
    for i in env_ids:
        left = in_left_stance(i, view)
        for k in range(view.action.shape[1]):
            if left:
                view.action[i, k] = action[i, view.action_source[k]] * view.action_sign[k]
            else:
                view.action[i, k] = action[i, k]
