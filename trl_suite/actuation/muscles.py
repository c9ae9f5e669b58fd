"""Musculotendon units of three characters, as data in `muscles.json`.

Source: the muscle lists of the original's character files. Its muscle environments load the
hand-tuned ones, `PLAIN`; 'Learning locomotion skills using DeepRL: does the choice of action space
matter?' (Peng, van de Panne 2017) evaluates those optimised for a motion. Two names that the
original uses twice (the last tail units of dog and raptor) have the spanned joint added here.

A row of the file has the fields of a `Muscle`, then those of each `Arm`. A set that was optimised
lists the units that differ from those of `PLAIN`; units of left legs mirror those of right legs.
"""

from __future__ import annotations

import importlib.resources
import json
from typing import Any, NamedTuple

PLAIN = 'plain'


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
