"""Compiled functions that all tasks of a 3D walker share: clock, actions, ground, observation."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from trl_suite.actuation.action_map import Drive, drive
from trl_suite.engine import native
from trl_suite.kinematics.blocks import CLOCK, Block, Reflection
from trl_suite.kinematics.spatial import (
    SpatialBody,
    SpatialMeasurement,
    SpatialState,
    is_lost,
)
from trl_suite.kinematics.spatial import measure as measure_body
from trl_suite.tasks.components.observation import write_body, write_terrain
from trl_suite.tasks.task import (
    MAX_JOINT_SPEED,
    Outcome,
    too_fast,
)
from trl_suite.terrain.spatial import windows as spatial_ground
from trl_suite.terrain.spatial.windows import SpatialWindows
from trl_suite.util.compiled import compiled, compiled_loop

CONTROL_TIMESTEP = 1 / 30  # s
TERRAIN_MAPS = "observed maps of the terrain: 'height', 'velocity', both, or () for none"
HEIGHT_MAP = "observed map of the terrain: 'height', or () for none"
SUBSTEPS = 10  # physics at 300 Hz: trained policies score the same as at 600 Hz, less below 180 Hz
ACTION_SCALE = 1.0  # rad per unit action about the mean pose of the motion
PHASE_BINS = 4
ACTION_OFFSETS = ('clip', 'posture', 'original')  # of position control
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
    """Start and distance travelled of each walker.

    Attributes:
      origin: x, y (m) and heading (rad) at the start, (n, 3).
      distance: horizontal distance of the root from the start, (n,) m; in imitation along +x.
    """

    origin: np.ndarray
    distance: np.ndarray


class View(NamedTuple):
    """How observation and action are derived from the full observation, with optional mirroring.

    Attributes:
      mirrored: whether observations and actions are reflected in left stance.
      source, sign: a reflected full observation is `full[source] * sign`, (size,).
      phase: column of the phase in the full observation.
      kept: columns of the full observation that are observed, (k,); all of them if it is empty.
      given_phase: column of the phase in the observation.
      action_index, action_sign: a reflected action is `action[index] * sign`.
    """

    mirrored: bool
    source: np.ndarray
    sign: np.ndarray
    phase: int
    kept: np.ndarray
    given_phase: int
    action_index: np.ndarray
    action_sign: np.ndarray


class SpatialRules(NamedTuple):
    """Data for the compiled functions of all these tasks.

    Attributes:
      ctrl: controls of the physics, (n, ...).
      period: period of the reference motion, s.
      columns: first columns of the blocks that `observe_body` writes, in the full observation; -1:
        absent.
      full: the full observation, (n, size).
      action: actions after reflection, (n, k); scratch.
      leaving: whether the walker has left its ground window, which must then be moved, (n,).
    """

    engine: native.Engine
    body: SpatialBody
    physics: SpatialState
    ground: SpatialWindows
    drive: Drive
    ctrl: np.ndarray
    period: float
    columns: Any
    given: View
    clock: Clock
    travel: Travel
    measurement: SpatialMeasurement
    full: np.ndarray
    action: np.ndarray
    leaving: np.ndarray
    outcome: Outcome


# Parts of a step of simulation i.


@compiled
def act(i: int, action: np.ndarray, rules: SpatialRules) -> bool:
    """Writes controls and drives moving boxes; returns whether the ground window must be moved.

    It is moved before the physics steps, so that images rendered afterwards are up to date.
    """
    given = rules.given
    left = given.mirrored and rules.full[i, given.phase] >= 0.5
    for k in range(rules.action.shape[1]):
        if left:
            rules.action[i, k] = action[i, given.action_index[k]] * given.action_sign[k]
        else:
            rules.action[i, k] = action[i, k]
    drive(i, rules.action, rules.drive, rules.ctrl)
    return prepare_ground(i, rules)


@compiled
def prepare_ground(i: int, rules: SpatialRules) -> bool:
    """Drives moving boxes before a control step, unless the ground window must be moved.

    Returns:
      Whether the ground window must be moved, which drives the boxes as well.
    """
    root = rules.body.links[0]
    x, y = rules.physics.xpos[i, root, 0], rules.physics.xpos[i, root, 1]
    rules.leaving[i] = spatial_ground.has_left(i, x, y, rules.ground)
    if not rules.leaving[i] and spatial_ground.keep_moving(
        i, x, y, rules.physics.qpos, rules.physics.qvel, rules.ground
    ):
        native.forward(i, rules.engine)
    return rules.leaving[i]


@compiled
def tick(i: int, rules: SpatialRules) -> None:
    """Advances the clock by a control step."""
    rules.clock.steps[i] += 1
    read_clock(i, rules)


@compiled
def read_clock(i: int, rules: SpatialRules) -> None:
    """Computes the phase."""
    clock = rules.clock
    cycles = clock.start[i] + clock.steps[i] * (CONTROL_TIMESTEP / rules.period)
    # Rounded, so that rounding errors of the sum do not delay the switch of stance at half a cycle.
    clock.cycles[i] = np.rint(cycles * _DIGITS) / _DIGITS
    clock.phase[i] = clock.cycles[i] - np.floor(clock.cycles[i])


@compiled
def breaks_down(i: int, rules: SpatialRules) -> bool:
    """Returns whether a simulation diverged or left its ground: it keeps the last observation."""
    diverged = (
        native.diverged(i, rules.engine)
        or too_fast(i, rules.body.joint_dof, MAX_JOINT_SPEED, rules.physics.qvel)
        or is_lost(i, rules.body, rules.physics, rules.ground)
    )
    rules.outcome.diverged[i] = diverged
    return diverged


@compiled
def measure(i: int, rules: SpatialRules) -> None:
    """Measures the body, relative to the current ground."""
    spatial_ground.see_movers(i, rules.physics.qpos, rules.ground)
    measure_body(i, rules.body, rules.physics, rules.ground, rules.measurement)
    x = rules.measurement.root[i, 0] - rules.travel.origin[i, 0]
    y = rules.measurement.root[i, 1] - rules.travel.origin[i, 1]
    rules.travel.distance[i] = np.sqrt(x * x + y * y)


@compiled
def observe_body(i: int, rules: SpatialRules) -> None:
    """Writes the blocks terrain, pose, velocity and phase of the full observation."""
    columns, full = rules.columns, rules.full
    write_terrain(i, columns.terrain, rules.ground, rules.measurement, full)
    write_body(i, columns.pose, columns.velocity, rules.measurement, full)
    if columns.phase >= 0:
        phase = rules.clock.phase[i]
        full[i, columns.phase] = phase
        for k in range(PHASE_BINS):
            full[i, columns.phase + 1 + k] = np.floor(phase * PHASE_BINS) == k


# Its phase is that of the cycle; a mirrored observation has that of the step.
PHASE = Block(
    'phase', 1 + PHASE_BINS, '1', 'phase of the cycle in [0, 1); then the one-hot of its quarter', CLOCK,
    Reflection(
        np.append(0, 1 + np.roll(np.arange(PHASE_BINS), PHASE_BINS // 2)), np.ones(1 + PHASE_BINS)
    ),
    kept=tuple(range(1 + PHASE_BINS // 2)),
    kept_meaning='phase of the step in [0, 1); then the one-hot of its half',
)  # fmt: skip


@compiled
def publish(i: int, rules: SpatialRules) -> None:
    """Writes the observation from the full observation."""
    given, full, observation = rules.given, rules.full, rules.outcome.observation
    left = given.mirrored and full[i, given.phase] >= 0.5
    for k in range(len(given.kept)):
        column = given.kept[k]
        if left:
            observation[i, k] = full[i, given.source[column]] * given.sign[column]
        else:
            observation[i, k] = full[i, column]
    if given.mirrored:  # the phase of the single step
        phase = full[i, given.phase]
        observation[i, given.given_phase] = 2 * (phase - 0.5 if left else phase)


@compiled_loop
def act_all(env_ids: np.ndarray, action: np.ndarray, rules: SpatialRules) -> int:
    """Applies actions; returns how many ground windows must be moved. Takes a pack."""
    leaving = 0
    for i in env_ids:
        leaving += act(i, action, rules)
    return leaving
