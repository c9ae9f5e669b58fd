"""Errors between a 3D walker and its reference motion, as compiled functions."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from trl_suite.characters import Character
from trl_suite.kinematics.blocks import by_name
from trl_suite.kinematics.spatial import SpatialMeasurement
from trl_suite.kinematics.spatial_reference import SpatialReference, TrackTable, feature
from trl_suite.tasks.common.rewards import COM_ERROR_FACTOR
from trl_suite.tasks.terms import Term, terms_data
from trl_suite.util.compiled import compiled


class Comparison(NamedTuple):
    """Data for a comparison: the reference, columns of its features, and weights.

    Attributes:
      tracks: the reference.
      columns: first column of each feature, by the names of `SpatialReference.columns`.
      pose_weights: weights of rotations, then of angles.
      rate_weights: weights of rates.
      terms: the reward terms.
    """

    tracks: TrackTable
    columns: Any
    pose_weights: np.ndarray
    rate_weights: np.ndarray
    terms: Any


def comparison(
    character: Character, reference: SpatialReference, terms: tuple[Term, ...]
) -> Comparison:
    """Returns the data for comparing a character with a reference."""
    weights, ball = character.spec.weights, character.spherical
    joints = np.asarray(weights[1:])
    return Comparison(
        tracks=reference.tracks,
        columns=by_name('Features', {name: part.start for name, part in reference.columns.items()}),
        pose_weights=np.concatenate([weights[:1], joints[ball], joints[~ball]]),
        rate_weights=np.concatenate([np.full(3, weights[0]), np.repeat(joints, character.dofs)]),
        terms=terms_data(terms),
    )


# Functions of simulation i and a row and remainder of the reference table (see `moment`).


@compiled
def motion_errors(
    i: int, row: int, fraction: float, comparison: Comparison, measurement: SpatialMeasurement
) -> tuple[float, float, float]:
    """Returns the errors of rotations and angles, of rates, and of the height of the root.

    The first is the weighted sum of squared angles between rotations and of squared differences of
    angles, rad^2; the others are of squared differences, rad^2/s^2 and m^2.
    """
    columns, tracks, mine = comparison.columns, comparison.tracks, measurement.features
    pose = rates = 0.0
    count = (columns.angles - columns.rotations) // 4
    for joint in range(count):
        column = columns.rotations + 4 * joint
        dot = square = 0.0
        for k in range(column, column + 4):
            other = feature(row, fraction, k, tracks)
            dot += mine[i, k] * other
            square += other * other
        angle = 2 * math.acos(min(abs(dot) / math.sqrt(square), 1.0))  # the shortest rotation
        pose += comparison.pose_weights[joint] * (angle * angle)
    for k in range(columns.rates - columns.angles):
        off = mine[i, columns.angles + k] - feature(row, fraction, columns.angles + k, tracks)
        pose += comparison.pose_weights[count + k] * (off * off)
    for k in range(columns.effectors - columns.rates):
        off = mine[i, columns.rates + k] - feature(row, fraction, columns.rates + k, tracks)
        rates += comparison.rate_weights[k] * (off * off)
    height = mine[i, columns.height] - feature(row, fraction, columns.height, tracks)
    return pose, rates, height * height


@compiled
def effector_error(
    i: int, row: int, fraction: float, comparison: Comparison, measurement: SpatialMeasurement
) -> float:
    """Mean over end effectors of the squared distance, m^2."""
    first, stop = comparison.columns.effectors, comparison.columns.com_velocity
    error = 0.0
    for k in range(first, stop):
        off = measurement.features[i, k] - feature(row, fraction, k, comparison.tracks)
        error += off * off
    return error / ((stop - first) // 3)


@compiled
def com_error(
    i: int, row: int, fraction: float, turned: float, comparison: Comparison,
    measurement: SpatialMeasurement,
) -> float:  # fmt: skip
    """Scaled squared difference of the velocities of the centre of mass, m^2/s^2.

    The velocity of the reference is rotated about z by `turned`, rad.
    """
    cosine, sine = math.cos(turned), math.sin(turned)
    column, tracks = comparison.columns.com_velocity, comparison.tracks
    x = feature(row, fraction, column, tracks)
    y = feature(row, fraction, column + 1, tracks)
    off_x = measurement.com_velocity[i, 0] - (cosine * x - sine * y)
    off_y = measurement.com_velocity[i, 1] - (sine * x + cosine * y)
    off_z = measurement.com_velocity[i, 2] - feature(row, fraction, column + 2, tracks)
    return COM_ERROR_FACTOR * (off_x * off_x + off_y * off_y + off_z * off_z)
