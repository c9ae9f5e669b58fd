"""The planar walk: joint-angle curves as Fourier series, with arms for the biped that has them.

The coefficients are the result of a least-squares fit that keeps the feet on the ground and at rest
in stance, close to textbook gait curves (mocap/README.md describes the criteria).
Series are a0, a1, b1, a2, b2, ... over the phase from right heel strike; the left leg is half a
cycle later.
"""

from __future__ import annotations

import numpy as np

from trl_suite.motion.clip import Clip

PERIOD = 1.0  # s
SPEED = 1.5  # m/s
RATE = 120  # frames per second
LEGS = ('right_hip', 'right_knee', 'right_ankle', 'left_hip', 'left_knee', 'left_ankle')
ARMS = ('right_shoulder', 'right_forearm', 'left_shoulder', 'left_forearm', 'neck')

HIP = (
    *(0.2320, 0.5395, -0.0775, -0.0784, -0.0692, -0.0680, 0.0253),
    *(-0.0082, 0.0095, -0.0149, 0.0203, 0.0065, 0.0048),
)
KNEE = (
    *(-0.4124, -0.0034, 0.2935, 0.2803, -0.1327, 0.0399, -0.1475),
    *(-0.0433, 0.0094, 0.0342, -0.0128, -0.0103, -0.0101),
)
ANKLE = (
    *(0.0381, -0.0315, 0.1843, 0.0103, -0.2349, -0.0923, 0.0348),
    *(0.0551, -0.0428, -0.0242, -0.0532, -0.0224, -0.0037),
)
# The root repeats every step, twice a cycle: harmonics 2, 4, 6 only.
HEIGHT = (0.7560, -0.0254, 0.0021, -0.0001, 0.0020, 0.0004, 0.0002)  # m
PITCH = (-0.1128, -0.0005, -0.0113, -0.0017, 0.0020, 0.0018, 0.0012)  # rad, leaning forward
SPEED_RIPPLE = (0.0, -0.0249, -0.0136, -0.0045, -0.0222, -0.0125, -0.0118)  # m/s


def series(coefficients: tuple[float, ...], phase: np.ndarray, stride: int = 1) -> np.ndarray:
    """Returns a Fourier series whose k-th pair has harmonic k times `stride`."""
    a, b = coefficients[1::2], coefficients[2::2]
    angles = 2 * np.pi * stride * np.outer(phase, np.arange(1, len(a) + 1))
    return coefficients[0] + np.cos(angles) @ a + np.sin(angles) @ b


def integral(coefficients: tuple[float, ...], phase: np.ndarray, stride: int = 1) -> np.ndarray:
    """Returns the integral over phase, from 0, of a series without a mean."""
    angular = 2 * np.pi * stride * np.arange(1, len(coefficients) // 2 + 1)
    a, b = np.array(coefficients[1::2]) / angular, np.array(coefficients[2::2]) / angular
    angles = np.outer(phase, angular)
    return np.sin(angles) @ a + (1 - np.cos(angles)) @ b


def leg(phase: np.ndarray) -> np.ndarray:
    """Returns hip, knee and ankle angle of the right leg, shape (n, 3)."""
    return np.stack([series(joint, phase) for joint in (HIP, KNEE, ANKLE)], axis=1)


def arms(phase: np.ndarray) -> np.ndarray:
    """Returns shoulders, forearms and neck in the order of `ARMS`: a counter-swing."""
    swing = 0.40 * np.cos(2 * np.pi * phase)
    bend = 0.15 * np.cos(2 * np.pi * phase - 0.3)
    neck = np.full_like(phase, 0.10)
    return np.stack([-0.05 - swing, 0.45 - bend, -0.05 + swing, 0.45 + bend, neck], axis=1)


def clip(name: str, with_arms: bool = False) -> Clip:
    """Returns the walk for biped2d, or with arms for biped2d_full."""
    phase = np.linspace(0, 1, round(RATE * PERIOD) + 1)
    x = SPEED * PERIOD * phase + PERIOD * integral(SPEED_RIPPLE, phase, 2)
    columns = [
        np.stack([x, series(HEIGHT, phase, 2), series(PITCH, phase, 2)], axis=1),
        leg(phase),
        leg(phase + 0.5),
    ]
    joints = LEGS
    if with_arms:
        columns.append(arms(phase))
        joints += ARMS
    poses = np.concatenate(columns, axis=1)
    poses[-1, 1:] = poses[0, 1:]  # the same number, not merely the same to rounding
    description = 'walk at 1.5 m/s' + (' with swinging arms' if with_arms else '')
    return Clip(
        name, PERIOD * phase, poses, 'planar', joints, (1,) * len(joints), True, description
    )


def clips() -> list[Clip]:
    """Returns the clips of this recipe."""
    return [clip('biped2d_walk'), clip('biped2d_full_walk', with_arms=True)]
