"""Errors between a 3D walker and its reference motion, as compiled functions."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from trl_suite.characters import Character
from trl_suite.kinematics.spatial import SpatialMeasurement
from trl_suite.kinematics.spatial_reference import SpatialReference, TrackTable, feature
from trl_suite.tasks.components import rewards
from trl_suite.util.compiled import compiled


class Comparison(NamedTuple):
    """Data for a comparison: the reference, columns of its features, and weights.

    Attributes:
      tracks: the reference.
      rotations, angles, rates, effectors, com_velocity, height, heading, root, positions: first
        columns of these features.
      pose_weights: weights of rotations, then of angles.
      rate_weights: weights of rates.
      term_weights, term_scales: weights and error scales of the reward terms.
    """

    tracks: TrackTable
    rotations: int
    angles: int
    rates: int
    effectors: int
    com_velocity: int
    height: int
    heading: int
    root: int
    positions: int
    pose_weights: np.ndarray
    rate_weights: np.ndarray
    term_weights: np.ndarray
    term_scales: np.ndarray


def comparison(
    character: Character, reference: SpatialReference, terms: Mapping[str, tuple[float, float]]
) -> Comparison:
    """Returns the data for comparing a character with a reference."""
    weights, ball = character.spec.weights, character.spherical
    joints = np.asarray(weights[1:])
    numbers = np.array(list(terms.values()))
    names = (
        'rotations', 'angles', 'rates', 'effectors', 'com_velocity', 'height', 'heading', 'root',
        'positions',
    )  # fmt: skip
    return Comparison(
        tracks=reference.tracks,
        pose_weights=np.concatenate([weights[:1], joints[ball], joints[~ball]]),
        rate_weights=np.concatenate([np.full(3, weights[0]), np.repeat(joints, character.dofs)]),
        term_weights=numbers[:, 0].copy(),
        term_scales=numbers[:, 1].copy(),
        **{name: reference.columns[name].start for name in names},
    )


# Functions of simulation i and a row and remainder of the reference table (see `moment`).


@compiled
def pose_error(
    i: int, row: int, fraction: float, comparison: Comparison, measurement: SpatialMeasurement
) -> float:
    """Weighted sum of squared angles between rotations and squared differences of angles, rad^2."""
    error, mine = 0.0, measurement.features
    count = (comparison.angles - comparison.rotations) // 4
    for joint in range(count):
        column = comparison.rotations + 4 * joint
        dot = square = 0.0
        for k in range(column, column + 4):
            other = feature(row, fraction, k, comparison.tracks)
            dot += mine[i, k] * other
            square += other * other
        angle = 2 * math.acos(min(abs(dot) / math.sqrt(square), 1.0))  # the shortest rotation
        error += comparison.pose_weights[joint] * (angle * angle)
    for joint in range(comparison.rates - comparison.angles):
        off = mine[i, comparison.angles + joint] - feature(
            row, fraction, comparison.angles + joint, comparison.tracks
        )
        error += comparison.pose_weights[count + joint] * (off * off)
    return error


@compiled
def rate_error(
    i: int, row: int, fraction: float, comparison: Comparison, measurement: SpatialMeasurement
) -> float:
    """Weighted sum of squared differences of rates, rad^2/s^2."""
    error = 0.0
    for k in range(comparison.effectors - comparison.rates):
        off = measurement.features[i, comparison.rates + k] - feature(
            row, fraction, comparison.rates + k, comparison.tracks
        )
        error += comparison.rate_weights[k] * (off * off)
    return error


@compiled
def effector_error(
    i: int, row: int, fraction: float, comparison: Comparison, measurement: SpatialMeasurement
) -> float:
    """Mean over end effectors of the squared distance, m^2."""
    error, count = 0.0, comparison.com_velocity - comparison.effectors
    for k in range(comparison.effectors, comparison.com_velocity):
        off = measurement.features[i, k] - feature(row, fraction, k, comparison.tracks)
        error += off * off
    return error / (count // 3)


@compiled
def com_error(
    i: int,
    row: int,
    fraction: float,
    turned: float,
    comparison: Comparison,
    measurement: SpatialMeasurement,
) -> float:
    """Scaled squared difference of the velocities of the centre of mass, m^2/s^2.

    The velocity of the reference is rotated about z by `turned`, rad.
    """
    cosine, sine = math.cos(turned), math.sin(turned)
    x = feature(row, fraction, comparison.com_velocity, comparison.tracks)
    y = feature(row, fraction, comparison.com_velocity + 1, comparison.tracks)
    off_x = measurement.com_velocity[i, 0] - (cosine * x - sine * y)
    off_y = measurement.com_velocity[i, 1] - (sine * x + cosine * y)
    off_z = measurement.com_velocity[i, 2] - feature(
        row, fraction, comparison.com_velocity + 2, comparison.tracks
    )
    return rewards.COM_ERROR_FACTOR * (off_x * off_x + off_y * off_y + off_z * off_z)


@compiled
def height_error(
    i: int, row: int, fraction: float, comparison: Comparison, measurement: SpatialMeasurement
) -> float:
    """Squared difference of the heights of the root, m^2."""
    off = measurement.features[i, comparison.height] - feature(
        row, fraction, comparison.height, comparison.tracks
    )
    return off * off


@compiled
def term(k: int, error: float, comparison: Comparison) -> float:
    """Returns reward term k for an error."""
    return rewards.term(error, comparison.term_weights[k], comparison.term_scales[k])
