"""The options of actuators, for `trl-suite info` and docs/realism.md."""

from __future__ import annotations

import dataclasses
from typing import Any

from trl_suite.actuation import Actuators
from trl_suite.actuation.realism import NOT_FOR_MUSCLES
from trl_suite.util.tables import Section, Table, section

_WORDS = ('at_least', 'above', 'at_most', 'below')


def actuator_options(actuation: str | None = None) -> Section:
    """Returns the table of options, of those that an actuation model has; None: of all."""
    cells = [
        (field.name, repr(field.default), field.metadata['unit'], _bounds(field), field.metadata['meaning'])
        for field in dataclasses.fields(Actuators)
        if actuation != 'muscle' or field.name not in NOT_FOR_MUSCLES
    ]  # fmt: skip
    return section(
        'Options of actuators',
        Table(('option', 'default', 'unit', 'bounds', 'meaning'), cells),
    )


def _bounds(field: dataclasses.Field[Any]) -> str:
    """Returns the bounds of an option in words."""
    found = field.metadata['bounds']
    return ', '.join(
        f'{word.replace("_", " ")} {found[word]:g}' for word in _WORDS if found[word] is not None
    )
