"""The Hill-type muscle of the original simulator as formulas, and its image in MuJoCo's muscle.

The original integrates a contractile element in series with a tendon (after Geyer and Herr) at
3000 Hz. Our muscle actuation uses MuJoCo's own muscle force curves instead, so that no Python runs
between substeps: force-length and force-velocity are MuJoCo's functions with parameters fitted to
the formulas below, the tendon is rigid, and a cosine moment arm is replaced by its value at the
rest angle. Peak forces, optimal lengths, rest angles, grouping, and the signs and sizes of constant
arms are the table's. The formulas here are what the tests hold MuJoCo's muscles against, and what
a user may need to analyse a rollout; lengths `l` are in optimal fibre lengths.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from trl_suite.actuation.muscles import Arm, Muscle

WIDTH = 0.56  # half width of the active force-length curve, optimal lengths
RESIDUE = 0.05  # active force left at the end of that width
V_MAX = 10.0  # largest shortening speed, optimal lengths per second
CURVATURE = 5.0  # of the shortening branch
ECCENTRIC = 1.5  # plateau of the lengthening branch, peak forces
TENDON_STRAIN = 0.04  # tendon strain at peak force
MIN_ACTIVATION = 0.01

# MuJoCo's muscle curves fitted to the formulas: least squares over l in 0.3...1.8 and
# |v| <= 10 optimal lengths per second. Largest errors in peak forces: 0.046 of active force by
# length; 0.18 by velocity, at a slow stretch, where the original is steeper; of passive force 0.10
# up to l = 1.6 and 0.5 at l = 1.8.
MUJOCO_RANGE = (0.5, 1.5)  # of operating lengths; only fixes the scale of `lengthrange`
MUJOCO_LMIN, MUJOCO_LMAX = 0.30, 1.70
MUJOCO_VMAX = 6.0
MUJOCO_FPMAX = 0.86
MUJOCO_FVMAX = 1.5


def force_length(l: ArrayLike) -> np.ndarray:  # noqa: E741
    """Active force-length factor of the contractile element."""
    return np.exp(np.log(RESIDUE) * np.abs((np.asarray(l) - 1) / WIDTH) ** 3)


def parallel_force(l: ArrayLike) -> np.ndarray:  # noqa: E741
    """Passive force of the parallel spring, in peak forces."""
    return np.maximum(0, (np.asarray(l) - 1) / WIDTH) ** 2


def buffer_force(l: ArrayLike) -> np.ndarray:  # noqa: E741
    """Force of the spring that keeps the contractile element from collapsing, in peak forces."""
    return np.maximum(0, (1 - WIDTH - np.asarray(l)) / (WIDTH / 2)) ** 2


def tendon_force(strain: ArrayLike) -> np.ndarray:
    """Tendon force in peak forces for a strain relative to the slack length."""
    return np.maximum(0, np.asarray(strain) / TENDON_STRAIN) ** 2


def velocity(force_velocity: ArrayLike) -> np.ndarray:
    """Inverse force-velocity relation.

    Args:
      force_velocity: factor f_V, clamped to [0, 1.5].

    Returns:
      Fibre velocity in optimal lengths per second, lengthening positive.
    """
    f = np.clip(force_velocity, 0, ECCENTRIC)
    shortening = -V_MAX * (1 - f) / (1 + CURVATURE * f)
    a = (f - ECCENTRIC) / (ECCENTRIC - 1)
    lengthening = -V_MAX * (a + 1) / (7.56 * CURVATURE * a - 1)
    return np.where(f < 1, shortening, lengthening)


def moment_arm(arm: Arm, angle: ArrayLike) -> np.ndarray:
    """Moment arm in m at a joint angle in rad, as the original has it."""
    angle = np.asarray(angle, dtype=float)
    if arm.peak is None:
        return np.full_like(angle, arm.arm)
    return arm.arm * np.maximum(0, np.cos(angle - arm.peak))


def constant_arm(arm: Arm) -> float:
    """The arm in m that stands for `arm` in MuJoCo: its value at the rest angle."""
    return float(moment_arm(arm, arm.rest))


def optimal_length(muscle: Muscle) -> float:
    """Length scale of the MuJoCo actuator in m: the pennation factor divides joint travel."""
    return muscle.l_opt / muscle.pennation


def rest_length(muscle: Muscle) -> float:
    """Length of the MuJoCo tendon in m where the fibre has its optimal length."""
    return -sum(constant_arm(arm) * arm.rest for arm in muscle.arms)


def mujoco_parameters(muscle: Muscle) -> dict[str, tuple[float, ...]]:
    """Attributes of the `general` actuator of MuJoCo that stands for a muscle."""
    scale = optimal_length(muscle)
    tendon = rest_length(muscle) - scale
    parameters = (
        *MUJOCO_RANGE, muscle.f_max, 200.0, MUJOCO_LMIN, MUJOCO_LMAX, MUJOCO_VMAX, MUJOCO_FPMAX,
        MUJOCO_FVMAX,
    )  # fmt: skip
    return {
        'gainprm': parameters,
        'biasprm': parameters,
        'lengthrange': tuple(tendon + end * scale for end in MUJOCO_RANGE),
    }
