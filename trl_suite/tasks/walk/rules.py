"""Walking forward: compiled functions."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from trl_suite.actuation.action_map import Drive, drive
from trl_suite.engine import native
from trl_suite.kinematics import planar, spatial
from trl_suite.kinematics.blocks import Block, Noise
from trl_suite.kinematics.planar import (
    PlanarBody,
    PlanarMeasurement,
    PlanarState,
    has_fallen,
    leaves,
)
from trl_suite.kinematics.spatial import (
    SpatialBody,
    SpatialMeasurement,
    SpatialState,
)
from trl_suite.tasks.components.observation import write_body, write_terrain
from trl_suite.tasks.task import (
    MAX_JOINT_SPEED,
    Outcome,
    conclude,
    too_fast,
)
from trl_suite.terrain.planar.windows import PlanarWindows
from trl_suite.terrain.spatial import windows as spatial_ground
from trl_suite.terrain.spatial.windows import SpatialWindows
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


class SpatialRules(NamedTuple):
    """Data for the compiled functions of a spatial walk.

    Attributes:
      ctrl: controls of the physics, (n, ...).
      columns: first columns of the observation blocks; -1: not observed.
      leaving: whether the walker has left its ground window, which must then be moved, (n,).
    """

    engine: native.Engine
    body: SpatialBody
    physics: SpatialState
    ground: SpatialWindows
    drive: Drive
    ctrl: np.ndarray
    columns: Any
    measurement: SpatialMeasurement
    state: WalkState
    leaving: np.ndarray
    outcome: Outcome


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
def look_spatial(i: int, rules: SpatialRules) -> None:
    """Measures and observes."""
    measurement, state, observation = rules.measurement, rules.state, rules.outcome.observation
    spatial_ground.see_movers(i, rules.physics.qpos, rules.ground)
    spatial.measure(i, rules.body, rules.physics, rules.ground, measurement)
    columns = rules.columns
    write_terrain(i, columns.terrain, rules.ground, measurement, observation)
    write_body(i, columns.pose, columns.velocity, measurement, observation)
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
def act_spatial(env_ids: np.ndarray, action: np.ndarray, rules: SpatialRules) -> int:
    """Applies actions and drives moving boxes; returns how many ground windows must be moved."""
    leaving, root = 0, rules.body.links[0]
    for i in env_ids:
        drive(i, action, rules.drive, rules.ctrl)
        x, y = rules.physics.xpos[i, root, 0], rules.physics.xpos[i, root, 1]
        rules.leaving[i] = spatial_ground.has_left(i, x, y, rules.ground)
        if rules.leaving[i]:
            leaving += 1
        elif spatial_ground.keep_moving(
            i, x, y, rules.physics.qpos, rules.physics.qvel, rules.ground
        ):
            native.forward(i, rules.engine)
    return leaving


@compiled_loop
def finish_spatial(env_ids: np.ndarray, stepped: bool, rules: SpatialRules) -> None:
    """Finishes steps, or only observes."""
    for i in env_ids:
        outcome = rules.outcome
        if stepped:
            outcome.diverged[i] = (
                native.diverged(i, rules.engine)
                or too_fast(i, rules.body.joint_dof, MAX_JOINT_SPEED, rules.physics.qvel)
                or spatial.is_lost(i, rules.body, rules.physics, rules.ground)
            )
            if outcome.diverged[i]:  # keeps the last finite observation
                conclude(i, True, outcome)
                continue
        look_spatial(i, rules)
        if stepped:
            conclude(i, rules.measurement.fallen[i], outcome)
