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
from trl_suite.tasks.task import (
    MAX_JOINT_SPEED,
    Outcome,
    too_fast,
)
from trl_suite.terrain.spatial import windows as spatial_ground
from trl_suite.terrain.spatial.windows import SAMPLES, SpatialWindows
from trl_suite.util.compiled import compiled, compiled_inline, compiled_loop

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


class WalkerData(NamedTuple):
    """A 3D walker in all simulations, for compiled functions.

    Attributes:
      ctrl: controls of the physics, (n, ...).
      leaving: whether the walker has left its ground window, which must then be moved, (n,).
    """

    engine: native.Engine
    body: SpatialBody
    physics: SpatialState
    ground: SpatialWindows
    drive: Drive
    ctrl: np.ndarray
    measurement: SpatialMeasurement
    leaving: np.ndarray
    outcome: Outcome


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
def control(i: int, action: np.ndarray, walker: WalkerData) -> bool:
    """Writes controls and drives moving boxes, unless the ground window must be moved.

    It is moved before the physics steps, so that images rendered afterwards are up to date.

    Returns:
      Whether the ground window must be moved, which drives the boxes as well.
    """
    drive(i, action, walker.drive, walker.ctrl)
    root = walker.body.links[0]
    x, y = walker.physics.xpos[i, root, 0], walker.physics.xpos[i, root, 1]
    walker.leaving[i] = spatial_ground.has_left(i, x, y, walker.ground)
    if not walker.leaving[i] and spatial_ground.keep_moving(
        i, x, y, walker.physics.qpos, walker.physics.qvel, walker.ground
    ):
        native.forward(i, walker.engine)
    return walker.leaving[i]


@compiled
def tick(i: int, period: float, clock: Clock) -> None:
    """Advances a clock of this period, s, by a control step."""
    clock.steps[i] += 1
    cycles = clock.start[i] + clock.steps[i] * (CONTROL_TIMESTEP / period)
    # Rounded, so that rounding errors of the sum do not delay the switch of stance at half a cycle.
    clock.cycles[i] = np.rint(cycles * _DIGITS) / _DIGITS
    clock.phase[i] = clock.cycles[i] - np.floor(clock.cycles[i])


@compiled
def breaks_down(i: int, walker: WalkerData) -> bool:
    """Returns whether a simulation diverged or left its ground: it keeps the last observation."""
    diverged = (
        native.diverged(i, walker.engine)
        or too_fast(i, walker.body.joint_dof, MAX_JOINT_SPEED, walker.physics.qvel)
        or is_lost(i, walker.body, walker.physics, walker.ground)
    )
    walker.outcome.diverged[i] = diverged
    return diverged


@compiled
def measure(i: int, walker: WalkerData) -> None:
    """Measures the body, relative to the current ground."""
    spatial_ground.see_movers(i, walker.physics.qpos, walker.ground)
    measure_body(i, walker.body, walker.physics, walker.ground, walker.measurement)


@compiled
def measure_travel(i: int, walker: WalkerData, travel: Travel) -> None:
    """Measures the body and its distance from the start."""
    measure(i, walker)
    x = walker.measurement.root[i, 0] - travel.origin[i, 0]
    y = walker.measurement.root[i, 1] - travel.origin[i, 1]
    travel.distance[i] = np.sqrt(x * x + y * y)


@compiled
def observe_body(i: int, columns: Any, walker: WalkerData, observation: np.ndarray) -> None:
    """Writes the blocks terrain, pose and velocity; see `spatial_figure.body_blocks`."""
    measurement = walker.measurement
    if columns.terrain >= 0:
        block = observation[i, columns.terrain : columns.terrain + SAMPLES * SAMPLES]
        x, y = measurement.root[i, 0], measurement.root[i, 1]
        spatial_ground.height_map(i, x, y, measurement.heading[i], walker.ground, block)
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


# Loops over simulations; they take packs, and return how many ground windows must be moved.


@compiled_loop
def control_all(env_ids: np.ndarray, action: np.ndarray, walker: WalkerData) -> int:
    """Applies actions."""
    leaving = 0
    for i in env_ids:
        leaving += control(i, action, walker)
    return leaving


@compiled_loop
def act_all(env_ids: np.ndarray, action: np.ndarray, walker: WalkerData, view: View) -> int:
    """Applies actions, which are reflected in left stance if the view is mirrored."""
    leaving = 0
    for i in env_ids:
        left = in_left_stance(i, view)
        for k in range(view.action.shape[1]):
            if left:
                view.action[i, k] = action[i, view.action_source[k]] * view.action_sign[k]
            else:
                view.action[i, k] = action[i, k]
        leaving += control(i, view.action, walker)
    return leaving
