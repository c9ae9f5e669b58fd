"""Torque limits by joint angle: tables, and those of human legs.

A table maps joints to the knots of two curves; joints that it lacks keep their limits:

    {"right_knee": {"angle": [-2.0, -1.0, 0.0],      # of the joint, rad, ascending
                    "positive": [0.6, 1.0, 0.4],     # factor of the limit of positive torques
                    "negative": [0.3, 0.4, 0.5]}}    # factor of the limit of negative torques

Between the knots the factors are interpolated, beyond the ends they are constant. The angle of a ball
joint is that about the lateral axis: minus the y component of its rotation vector, so that a positive
angle, as a positive torque, swings a limb forward; torques about other axes keep their limits.

The human curves are those of D. E. Anderson, M. L. Madigan, M. A. Nussbaum, 'Maximum voluntary joint
torque as a function of joint angle and angular velocity: model development and application to the lower
limb', Journal of Biomechanics 40 (2007), 3105-3113: table 3, men of 18 to 25 years, isometric torque
C1 cos(C2 (angle - C3)) relative to body weight times height. The coefficients were compared with those
in the library RBDL (`Millard2016TorqueMuscle`), which cites the same table. Ours are the choices of
normalisation (the largest torque of a joint, in its stronger direction, is the character's torque limit)
and of `LEAST`, the factor where the cosine is smaller, which is outside the measured range.
"""

from __future__ import annotations

import pathlib
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from trl_suite.characters.character import CharacterSpec
from trl_suite.engine.motors import Curves
from trl_suite.util import errors, files

HUMAN = 'human'
LEAST = 0.1
KNOTS = 41
_FIELDS = ('angle', 'positive', 'negative')
MOST = 10.0  # largest factor


class Exertion(NamedTuple):
    """Coefficients of one direction of a joint."""

    c1: float  # largest isometric torque / (weight * height)
    c2: float  # width: the torque is proportional to cos(c2 (angle - c3))
    c3: float  # angle of the largest torque, rad


# Flexion is positive at hip and knee, dorsiflexion at the ankle; 0 is upright standing.
ANDERSON_2007 = {
    'hip': {'extension': Exertion(0.161, 0.958, 0.932), 'flexion': Exertion(0.113, 0.738, -0.214)},
    'knee': {'extension': Exertion(0.163, 1.258, 1.133), 'flexion': Exertion(0.087, 0.869, 0.522)},
    'ankle': {
        'extension': Exertion(0.095, 1.391, 0.408),
        'flexion': Exertion(0.033, 1.510, -0.187),
    },
}
# Whether flexion swings the limb forward.
_FORWARD = {'hip': True, 'knee': False, 'ankle': True}


def human(joint: str) -> Curves | None:
    """Returns the curve of a joint whose name ends in hip, knee or ankle; None for other joints.

    Positive angles and torques of the joint must swing the limb forward.
    """
    kind = joint.split('_')[-1]
    if kind not in ANDERSON_2007:
        return None
    exertions, forward = ANDERSON_2007[kind], _FORWARD[kind]
    angle = np.linspace(-np.pi, np.pi, KNOTS)
    flexion = angle if forward else -angle
    largest = max(each.c1 for each in exertions.values())
    factors = {
        name: np.maximum(each.c1 / largest * _cosine(each.c2 * (flexion - each.c3)), LEAST)
        for name, each in exertions.items()
    }
    positive, negative = ('flexion', 'extension') if forward else ('extension', 'flexion')
    return Curves(angle, factors[positive], factors[negative])


def _cosine(angle: np.ndarray) -> np.ndarray:
    """Cosine, but 0 beyond a quarter turn."""
    return np.where(np.abs(angle) < np.pi / 2, np.cos(angle), 0.0)


def load(given: Any, character: CharacterSpec) -> dict[str, Curves]:
    """Returns the curves of a character by joint.

    What is given is True for its own, 'human', a JSON file, or a table; None for no curves.
    """
    if given is None:
        return {}
    name, joints = character.name, character.joints
    if given is True:
        if character.torque_curves is None:
            raise ValueError(
                f'torque_pose: character {name!r} has no curves of its own; give a table of '
                'joint -> angle, positive, negative'
            )
        given = character.torque_curves
    if given == HUMAN:
        curves = {joint: curve for joint in joints if (curve := human(joint)) is not None}
        if not curves:
            raise ValueError(f'torque_pose: {name!r} has no joint that ends in hip, knee or ankle')
        return curves
    if isinstance(given, (str, pathlib.Path)):
        with errors.naming('torque_pose: cannot read the table', (OSError, ValueError)):
            given = files.read_json(given)
    if not isinstance(given, Mapping) or not given:
        raise ValueError(
            f"torque_pose is {given!r}; expected True, 'human', a JSON file, or a table by joint"
        )
    errors.check_known(f'joint of {name!r} in torque_pose', joints, *given)
    return {joint: _curve(joint, entry) for joint, entry in given.items()}


def _curve(joint: str, entry: Any) -> Curves:
    """Returns a checked curve of a table."""
    owner = f'torque_pose[{joint!r}]'
    if not isinstance(entry, Mapping) or set(entry) != set(_FIELDS):
        raise ValueError(f'{owner} is {entry!r}; expected a dict with {", ".join(_FIELDS)}')
    angle, positive, negative = (errors.floats(f'{owner}: {name}', entry[name]) for name in _FIELDS)
    if angle.ndim != 1 or len(angle) < 2 or not angle.shape == positive.shape == negative.shape:
        raise ValueError(f'{owner}: expected lists of equal length, at least 2')
    if not (np.diff(angle) > 0).all():
        raise ValueError(f'{owner}: angle is {angle}; expected numbers in ascending order')
    for name, factors in (('positive', positive), ('negative', negative)):
        if not ((factors >= 0) & (factors <= MOST)).all():
            raise ValueError(f'{owner}: {name} is {factors}; expected numbers from 0 to {MOST:g}')
    return Curves(angle, positive, negative)
