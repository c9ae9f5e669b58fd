"""Reward terms as pure functions over a leading batch axis."""

from __future__ import annotations

import math

import numpy as np

from trl_suite.util.compiled import compiled

# The imitation reward: weight * exp(-scale * error), weights summing to 1.
# Source: the imitation scenario of the original; 'Does the choice of action space matter?'
# (Peng & van de Panne 2017) has the same structure.
IMITATION_TERMS: dict[str, tuple[float, float]] = {
    'pose': (0.5, 2.0),
    'velocity': (0.05, 0.005),
    'end_effector': (0.15, 40.0),
    'com': (0.2, 10.0),
    'root': (0.1, 10.0),
}
# The footstep controller's, of the same structure; its end-effector error has the footstep in it,
# and `heading` is a power of a cosine (see `heading`), its scale meaningless.
# Source: the step scenario of the original; 'DeepLoco' (Peng, Berseth, Yin, van de Panne 2017).
STEP_TERMS: dict[str, tuple[float, float]] = {
    'pose': (0.5 / 1.05, 2.0),
    'velocity': (0.05 / 1.05, 0.005),
    'end_effector': (0.2 / 1.05, 5.0),
    'com': (0.1 / 1.05, 10.0),
    'root': (0.1 / 1.05, 10.0),
    'heading': (0.1 / 1.05, 0.0),
}
# Imitation on the way to a goal, as the original's scenario with a goal means it: velocity and heading
# count towards the goal, and `proximity` is of the squared distance over that within which they no
# longer do.
DIRECT_TERMS: dict[str, tuple[float, float]] = {
    'pose': (0.5 / 1.15, 2.0),
    'velocity': (0.05 / 1.15, 0.005),
    'end_effector': (0.15 / 1.15, 40.0),
    'com': (0.2 / 1.15, 10.0),
    'root': (0.1 / 1.15, 10.0),
    'heading': (0.05 / 1.15, 0.0),
    'proximity': (0.1 / 1.15, 4.0),
}
COM_ERROR_FACTOR = 0.1  # the com error is this times the squared velocity error


@compiled
def term(error: float, weight: float, scale: float) -> float:
    """Returns what an error is worth: weight * exp(-scale * error)."""
    return weight * math.exp(-scale * error)


@compiled
def facing(error: float) -> float:
    """Returns ((1 + cos error) / 2)^4 of an error in rad: 1 where it is 0, 0 where opposite."""
    half = 0.5 + 0.5 * math.cos(error)
    return half * half * half * half


@compiled
def wrapped(angle: float) -> float:
    """Returns an angle in rad wrapped to [-pi, pi]; one inside stays bit for bit."""
    return angle - 2 * math.pi * np.rint(angle / (2 * math.pi))


def wrap(angle: np.ndarray) -> np.ndarray:
    """Wraps angles in rad to [-pi, pi]: the shortest rotation. Those inside stay bit for bit."""
    return angle - 2 * np.pi * np.round(angle / (2 * np.pi))
