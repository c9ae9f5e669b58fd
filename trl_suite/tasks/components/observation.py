"""Observation blocks of a 3D character, written from its measurement; for compiled functions."""

from __future__ import annotations

import numpy as np

from trl_suite.kinematics.spatial import SpatialMeasurement
from trl_suite.terrain.spatial import windows as spatial_ground
from trl_suite.terrain.spatial.windows import SAMPLES, SpatialWindows
from trl_suite.util.compiled import compiled


@compiled
def write_body(
    i: int, pose: int, velocity: int, measurement: SpatialMeasurement, observation: np.ndarray
) -> None:
    """Writes the blocks pose and velocity to an observation, from these columns on."""
    for k in range(measurement.pose.shape[1]):
        observation[i, pose + k] = measurement.pose[i, k]
    for k in range(measurement.velocity.shape[1]):
        observation[i, velocity + k] = measurement.velocity[i, k]


@compiled
def write_terrain(
    i: int,
    column: int,
    ground: SpatialWindows,
    measurement: SpatialMeasurement,
    observation: np.ndarray,
) -> None:
    """Writes the height map around a character to an observation, unless the column is negative."""
    if column >= 0:
        block = observation[i, column : column + SAMPLES * SAMPLES]
        x, y = measurement.root[i, 0], measurement.root[i, 1]
        spatial_ground.height_map(i, x, y, measurement.heading[i], ground, block)
