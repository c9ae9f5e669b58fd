"""How far a walker in three dimensions is from its reference motion, as compiled functions."""

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
    """What a comparison works on: the reference, where its features are, and weights.

    Attributes:
      tracks: the reference.
      rotations, angles, rates, effectors, com_velocity, height, heading, root, positions: first
        columns of these features.
      pose_weights: of rotations, then angles.
      rate_weights: of rates.
      term_weights, term_scales: of the reward terms.
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
    """Returns what the comparison of a character with a reference works on."""
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


# Of simulation i and a moment of the reference (see `moment`).


@compiled
def pose_error(
    i: int, env_id: int, rest: float, by: Comparison, found: SpatialMeasurement
) -> float:
    """Weighted sum of squared angles between rotations, and of squared differences of angles."""
    error, mine = 0.0, found.features
    count = (by.angles - by.rotations) // 4
    for joint in range(count):
        column = by.rotations + 4 * joint
        dot = square = 0.0
        for k in range(column, column + 4):
            other = feature(env_id, rest, k, by.tracks)
            dot += mine[i, k] * other
            square += other * other
        angle = 2 * math.acos(min(abs(dot) / math.sqrt(square), 1.0))  # the shorter way
        error += by.pose_weights[joint] * (angle * angle)
    for joint in range(by.rates - by.angles):
        off = mine[i, by.angles + joint] - feature(env_id, rest, by.angles + joint, by.tracks)
        error += by.pose_weights[count + joint] * (off * off)
    return error


@compiled
def rate_error(
    i: int, env_id: int, rest: float, by: Comparison, found: SpatialMeasurement
) -> float:
    """Weighted sum of squared differences of rates."""
    error = 0.0
    for k in range(by.effectors - by.rates):
        off = found.features[i, by.rates + k] - feature(env_id, rest, by.rates + k, by.tracks)
        error += by.rate_weights[k] * (off * off)
    return error


@compiled
def effector_error(
    i: int, env_id: int, rest: float, by: Comparison, found: SpatialMeasurement
) -> float:
    """Mean over end effectors of the squared distance, m^2."""
    error, count = 0.0, by.com_velocity - by.effectors
    for k in range(by.effectors, by.com_velocity):
        off = found.features[i, k] - feature(env_id, rest, k, by.tracks)
        error += off * off
    return error / (count // 3)


@compiled
def com_error(
    i: int, env_id: int, rest: float, turned: float, by: Comparison, found: SpatialMeasurement
) -> float:
    """Squared difference of the velocities of the centre of mass, the reference's turned by rad."""
    cosine, sine = math.cos(turned), math.sin(turned)
    x = feature(env_id, rest, by.com_velocity, by.tracks)
    y = feature(env_id, rest, by.com_velocity + 1, by.tracks)
    off_x = found.com_velocity[i, 0] - (cosine * x - sine * y)
    off_y = found.com_velocity[i, 1] - (sine * x + cosine * y)
    off_z = found.com_velocity[i, 2] - feature(env_id, rest, by.com_velocity + 2, by.tracks)
    return rewards.COM_ERROR_FACTOR * (off_x * off_x + off_y * off_y + off_z * off_z)


@compiled
def height_error(
    i: int, env_id: int, rest: float, by: Comparison, found: SpatialMeasurement
) -> float:
    """Squared difference of the heights of the root, m^2."""
    off = found.features[i, by.height] - feature(env_id, rest, by.height, by.tracks)
    return off * off


@compiled
def term(k: int, error: float, by: Comparison) -> float:
    """Returns what an error is worth in reward term k."""
    return rewards.term(error, by.term_weights[k], by.term_scales[k])
