"""Musculotendon units of three characters, as data in `muscles.json`, and as actuators of MuJoCo.

Source: the muscle lists of the original's character files. Its muscle environments load the
hand-tuned ones, `PLAIN`; 'Learning locomotion skills using DeepRL: does the choice of action space
matter?' (Peng, van de Panne 2017) evaluates those optimised for a motion. Two names that the
original uses twice (the last tail units of dog and raptor) have the spanned joint added here.

A row of the file has the fields of a `Muscle`, then those of each `Arm`. A set that was optimised
lists the units that differ from those of `PLAIN`; units of left legs mirror those of right legs.

The original integrates a contractile element in series with a tendon (after Geyer and Herr) at
3000 Hz. The muscle actuation here uses MuJoCo's muscle force curves instead, so that no Python runs
between substeps: force-length and force-velocity are MuJoCo's functions with parameters fitted to
the original's formulas (those of `tests/muscles_test.py`), the tendon is rigid, and a cosine moment
arm is replaced by its value at the rest angle. Peak forces, optimal lengths, rest angles, grouping,
and signs and sizes of constant arms are those of the table.
"""

from __future__ import annotations

import importlib.resources
import json
from typing import Any, NamedTuple

import numpy as np

PLAIN = 'plain'
MIN_ACTIVATION = 0.01

# MuJoCo's muscle curves fitted to the formulas: least squares over lengths of 0.3 to 1.8 optimal
# lengths, and speeds of up to 10 of these per second. Largest errors in peak forces: 0.046 of active
# force by length; 0.18 by velocity, at a slow stretch, where the original is steeper; of passive
# force 0.10 up to a length of 1.6, and 0.5 at 1.8.
MUJOCO_RANGE = (0.5, 1.5)  # of operating lengths; only determines the scale of `lengthrange`
MUJOCO_CURVES = (0.30, 1.70, 6.0, 0.86, 1.5)  # lmin, lmax, vmax, fpmax, fvmax


class Arm(NamedTuple):
    """The moment arm of a muscle at one joint."""

    joint: str
    arm: float  # m; its sign is that of the torque of the contracting muscle
    rest: float  # rest angle, rad
    peak: float | None = None  # angle of the largest arm, rad; None for a constant arm


class Muscle(NamedTuple):
    """One musculotendon unit."""

    name: str
    l_opt: float  # optimal length of the fibre, m
    l_slack: float  # slack length of the tendon, m
    f_max: float  # peak force, N
    pennation: float  # factor
    arms: tuple[Arm, ...]


def _muscle(row: list[Any], prefix: str = 'right_') -> Muscle:
    """Returns the unit of a row; one of a right leg, or its mirror image, with the given prefix."""
    row = [each.replace('right_', prefix) if isinstance(each, str) else each for each in row]
    fields: Any = *row[:5], tuple(Arm(*row[i : i + 4]) for i in range(5, len(row), 4))
    return Muscle(*fields)


def _sets(rows: dict[str, list[list[Any]]]) -> dict[str, tuple[Muscle, ...]]:
    """Returns the sets of a character in full."""
    plain, found = {row[0]: row for row in rows[PLAIN]}, {}
    for name, own in rows.items():
        right = {**plain, **{row[0]: row for row in own}}.values()
        left = [_muscle(row, 'left_') for row in right if row[0].startswith('right_')]
        found[name] = (*map(_muscle, right), *left)
    return found


_FILE = importlib.resources.files(__package__).joinpath('muscles.json')
_OWN = {name: _sets(rows) for name, rows in json.loads(_FILE.read_text('utf-8')).items()}
# For each character PLAIN, then the sets by the motion for which they were optimised. The arms of
# the 12-link biped are passive; the goat has the skeleton of the dog.
MUSCLES = {
    'biped2d': _OWN['biped2d'],
    'biped2d_full': _OWN['biped2d'],
    'dog': _OWN['dog'],
    'goat': {PLAIN: _OWN['dog'][PLAIN]},
    'raptor': _OWN['raptor'],
}


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
