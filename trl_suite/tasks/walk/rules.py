"""Walking forward: compiled functions."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from trl_suite.actuation.action_map import Drive, drive
from trl_suite.engine import native
from trl_suite.kinematics import planar
from trl_suite.kinematics.blocks import Block, Noise
from trl_suite.kinematics.planar import (
    PlanarBody,
    PlanarMeasurement,
    PlanarState,
    has_fallen,
    leaves,
)
from trl_suite.tasks.components.spatial_rules import (
    WalkerData,
    breaks_down,
    measure,
    observe_body,
)
from trl_suite.tasks.task import (
    MAX_JOINT_SPEED,
    Outcome,
    conclude,
    too_fast,
)
from trl_suite.terrain.planar.windows import PlanarWindows
from trl_suite.util.compiled import compiled, compiled_loop

SAMPLES = 50  # terrain heights that a planar character observes
FROUDE = 0.25  # speed^2 / (gravity * root height) at which the speed reward reaches its maximum
GRAVITY = 9.8  # m/s^2


class WalkState(NamedTuple):
    """State of each walker.

    Attributes:
      origin: x, y of the start, (n, 2) m.
      target_heading: direction to walk in, rad to the left of +x, (n,).
      distance: distance travelled along the target heading, (n,) m.
    """

    origin: np.ndarray
    target_heading: np.ndarray
    distance: np.ndarray


class PlanarRules(NamedTuple):
    """Data for the compiled functions of a planar walk; `ctrl`: controls of the physics."""

    engine: native.Engine
    body: PlanarBody
    physics: PlanarState
    ground: PlanarWindows
    drive: Drive
    ctrl: np.ndarray
    measurement: PlanarMeasurement
    state: WalkState
    outcome: Outcome


class SpatialData(NamedTuple):
    """Data for the compiled functions of a spatial walk; `columns`: of the observation blocks."""

    walker: WalkerData
    columns: Any
    state: WalkState


# In the plane.


@compiled
def look_planar(i: int, rules: PlanarRules) -> None:
    """Measures and observes."""
    observation = rules.outcome.observation
    planar.measure(i, rules.body, rules.physics, rules.ground, observation, rules.measurement)
    x = rules.physics.qpos[i, rules.body.qpos[0]]
    rules.state.distance[i] = x - rules.state.origin[i, 0]


@compiled_loop
def act_planar(env_ids: np.ndarray, action: np.ndarray, rules: PlanarRules) -> int:
    """Applies actions; returns how many ground windows must be moved."""
    leaving = 0
    for i in env_ids:
        drive(i, action, rules.drive, rules.ctrl)
        leaving += leaves(i, rules.body, rules.physics, rules.ground, rules.measurement)
    return leaving


@compiled_loop
def finish_planar(env_ids: np.ndarray, stepped: bool, rules: PlanarRules) -> None:
    """Finishes steps, or only observes."""
    for i in env_ids:
        outcome = rules.outcome
        if stepped:
            outcome.diverged[i] = (
                native.diverged(i, rules.engine)
                or too_fast(i, rules.body.dof[3:], MAX_JOINT_SPEED, rules.physics.qvel)
                or planar.is_lost(i, rules.body, rules.physics, rules.ground)
            )
            if outcome.diverged[i]:  # keeps the last finite observation
                conclude(i, True, outcome)
                continue
        look_planar(i, rules)
        if stepped:
            conclude(i, has_fallen(i, rules.body, rules.physics), outcome)


# In three dimensions.


@compiled
def look_spatial(i: int, data: SpatialData) -> None:
    """Measures and observes."""
    walker, state, columns = data.walker, data.state, data.columns
    observation, measurement = walker.outcome.observation, walker.measurement
    measure(i, walker)
    observe_body(i, columns, walker, observation)
    bearing = state.target_heading[i] - measurement.heading[i]
    observation[i, columns.target_heading] = math.cos(bearing)
    observation[i, columns.target_heading + 1] = math.sin(bearing)
    x, y = measurement.root[i, 0] - state.origin[i, 0], measurement.root[i, 1] - state.origin[i, 1]
    state.distance[i] = (
        math.cos(state.target_heading[i]) * x + math.sin(state.target_heading[i]) * y
    )


TARGET_HEADING = Block(
    'target_heading', 2, '1', 'cosine and sine of the bearing of the target heading, the heading at the start',
    Noise((0.005, 0.02, 0.05)),
)  # fmt: skip


@compiled_loop
def finish_spatial(env_ids: np.ndarray, stepped: bool, data: SpatialData) -> None:
    """Finishes steps, or only observes."""
    for i in env_ids:
        walker = data.walker
        if stepped and breaks_down(i, walker):  # keeps the last finite observation
            conclude(i, True, walker.outcome)
            continue
        look_spatial(i, data)
        if stepped:
            conclude(i, walker.measurement.fallen[i], walker.outcome)
