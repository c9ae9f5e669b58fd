"""Weights and scales of reward terms, and the functions that they share."""

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
# The reward of footstep controllers, of the same structure; its end-effector error includes the
# landing place, and `heading` is a power of a cosine (see `facing`), so that its scale is unused.
# Source: the step scenario of the original; 'DeepLoco' (Peng, Berseth, Yin, van de Panne 2017).
STEP_TERMS: dict[str, tuple[float, float]] = {
    'pose': (0.5 / 1.05, 2.0),
    'velocity': (0.05 / 1.05, 0.005),
    'end_effector': (0.2 / 1.05, 5.0),
    'com': (0.1 / 1.05, 10.0),
    'root': (0.1 / 1.05, 10.0),
    'heading': (0.1 / 1.05, 0.0),
}
# Imitation while walking to a goal, after the original's scenario with a goal: velocity and heading
# are compared with the direction of the goal unless it is near, and the error of `proximity` is the
# squared ratio of the distance to the radius that counts as near.
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
    """Returns weight * exp(-scale * error)."""
    return weight * math.exp(-scale * error)


@compiled
def facing(error: float) -> float:
    """Returns ((1 + cos error) / 2)^4 for an error in rad: 1 if it is 0, 0 if it is pi."""
    half = 0.5 + 0.5 * math.cos(error)
    return half * half * half * half


@compiled
def wrapped(angle: float) -> float:
    """Returns an angle in rad wrapped to [-pi, pi]; angles in this range are unchanged."""
    return angle - 2 * math.pi * np.rint(angle / (2 * math.pi))


def wrap(angle: np.ndarray) -> np.ndarray:
    """Returns angles in rad wrapped to [-pi, pi]; angles in this range are unchanged."""
    return angle - 2 * np.pi * np.round(angle / (2 * np.pi))
