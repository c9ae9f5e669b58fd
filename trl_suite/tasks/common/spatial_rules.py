"""Compiled functions that all tasks of a 3D walker share: clock, actions, ground, observation."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from trl_suite.kinematics.blocks import CLOCK, Block, Reflection
from trl_suite.kinematics.spatial import SpatialBodyData, look
from trl_suite.tasks.task import CONTROL_TIMESTEP, PHASE_BINS
from trl_suite.tasks.terms import Outcome
from trl_suite.terrain.spatial import windows as spatial_ground
from trl_suite.terrain.spatial.windows import SAMPLES
from trl_suite.util.compiled import compiled, compiled_inline

TERRAIN_MAPS = "observed maps of the terrain: 'height', 'velocity', both, or () for none"
HEIGHT_MAP = "observed map of the terrain: 'height', or () for none"
ACTION_SCALE = 1.0  # rad per unit action about the mean pose of the motion
_DIGITS = 1e9  # the clock is rounded to 1 / _DIGITS of a cycle


class Clock(NamedTuple):
    """Phase of each simulation in the cycle of its reference motion, (n,).

    Attributes:
      start: phase at the start of the episode.
      steps: control steps since the start.
      cycles: time in periods of the motion: the phase, not wrapped.
      phase: phase in [0, 1).
    """

    start: np.ndarray
    steps: np.ndarray
    cycles: np.ndarray
    phase: np.ndarray


class Travel(NamedTuple):
    """Start and distance travelled of each body.

    Attributes:
      origin: x, y (m) and heading (rad) at the start, (n, 3).
      distance: horizontal distance of the root from the start, (n,) m; in imitation along +x.
    """

    origin: np.ndarray
    distance: np.ndarray


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


# Parts of a step of simulation i.


@compiled
def tick(i: int, period: float, clock: Clock) -> None:
    """Advances a clock of this period, s, by a control step."""
    clock.steps[i] += 1
    cycles = clock.start[i] + clock.steps[i] * (CONTROL_TIMESTEP / period)
    # Rounded, so that rounding errors of the sum do not delay the switch of stance at half a cycle.
    clock.cycles[i] = np.rint(cycles * _DIGITS) / _DIGITS
    clock.phase[i] = clock.cycles[i] - np.floor(clock.cycles[i])


@compiled
def look_and_travel(i: int, body: SpatialBodyData, travel: Travel) -> None:
    """Measures the body and its distance from the start."""
    look(i, body)
    x = body.measurement.root[i, 0] - travel.origin[i, 0]
    y = body.measurement.root[i, 1] - travel.origin[i, 1]
    travel.distance[i] = np.sqrt(x * x + y * y)


@compiled
def observe_body(i: int, columns: Any, body: SpatialBodyData, observation: np.ndarray) -> None:
    """Writes the blocks terrain, pose and velocity; see `spatial_figure.body_blocks`."""
    measurement = body.measurement
    if columns.terrain >= 0:
        block = observation[i, columns.terrain : columns.terrain + SAMPLES * SAMPLES]
        x, y = measurement.root[i, 0], measurement.root[i, 1]
        spatial_ground.height_map(i, x, y, measurement.heading[i], body.ground, block)
    for k in range(measurement.pose.shape[1]):
        observation[i, columns.pose + k] = measurement.pose[i, k]
    for k in range(measurement.velocity.shape[1]):
        observation[i, columns.velocity + k] = measurement.velocity[i, k]


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
    'phase', 1 + PHASE_BINS, '1', 'phase of the cycle in [0, 1); then the one-hot of its quarter', CLOCK,
    Reflection(
        np.append(0, 1 + np.roll(np.arange(PHASE_BINS), PHASE_BINS // 2)), np.ones(1 + PHASE_BINS)
    ),
    kept=tuple(range(1 + PHASE_BINS // 2)),
    kept_meaning='phase of the step in [0, 1); then the one-hot of its half',
)  # fmt: skip


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
