"""MuJoCo's muscles as approximations of the Hill-type muscles of the original simulator.

The original integrates a contractile element in series with a tendon (after Geyer and Herr) at
3000 Hz. The muscle actuation here uses MuJoCo's muscle force curves instead, so that no Python runs
between substeps: force-length and force-velocity are MuJoCo's functions with parameters fitted to
the original's formulas (those of `tests/muscles_test.py`), the tendon is rigid, and a cosine moment
arm is replaced by its value at the rest angle. Peak forces, optimal lengths, rest angles, grouping,
and signs and sizes of constant arms are those of the table in `muscles.py`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from trl_suite.actuation.muscles import Arm, Muscle

MIN_ACTIVATION = 0.01

# MuJoCo's muscle curves fitted to the formulas: least squares over lengths of 0.3 to 1.8 optimal
# lengths, and speeds of up to 10 of these per second. Largest errors in peak forces: 0.046 of active
# force by length; 0.18 by velocity, at a slow stretch, where the original is steeper; of passive
# force 0.10 up to a length of 1.6, and 0.5 at 1.8.
MUJOCO_RANGE = (0.5, 1.5)  # of operating lengths; only determines the scale of `lengthrange`
MUJOCO_CURVES = (0.30, 1.70, 6.0, 0.86, 1.5)  # lmin, lmax, vmax, fpmax, fvmax


def constant_arm(arm: Arm) -> float:
    """The constant arm in m that replaces `arm` in MuJoCo: its value at the rest angle."""
    if arm.peak is None:
        return arm.arm
    return float(arm.arm * np.maximum(0, np.cos(arm.rest - arm.peak)))


def optimal_length(muscle: Muscle) -> float:
    """Length scale of the MuJoCo actuator in m: the pennation factor divides joint travel."""
    return muscle.l_opt / muscle.pennation


def rest_length(muscle: Muscle) -> float:
    """Length of the MuJoCo tendon in m at which the fibre has its optimal length."""
    return -sum(constant_arm(arm) * arm.rest for arm in muscle.arms)


def mujoco_parameters(muscle: Muscle) -> dict[str, Any]:
    """Attributes of the MuJoCo `general` actuator that represents a muscle."""
    scale = optimal_length(muscle)
    tendon = rest_length(muscle) - scale
    parameters = (*MUJOCO_RANGE, muscle.f_max, 200.0, *MUJOCO_CURVES)
    return {
        'dyntype': 'none',
        'gaintype': 'muscle',
        'biastype': 'muscle',
        'gainprm': parameters,
        'biasprm': parameters,
        'ctrllimited': True,
        'ctrlrange': (MIN_ACTIVATION, 1),
        'lengthrange': tuple(tendon + end * scale for end in MUJOCO_RANGE),
    }
