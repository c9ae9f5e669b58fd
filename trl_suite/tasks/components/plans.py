"""How plans of footsteps are drawn, and the pushes that disturb who follows them: options as data."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from trl_suite.util import errors

# Meanings of options of all tasks that follow footstep plans.
MAX_LANDING_ERROR = (
    'a foot that lands farther from its place ends the episode; by default it does not'
)
FOOTSTEP_SCALE = 'factor of the squared landing error in the reward; more teaches accuracy'
ROOT_TURN_LIMIT = 1.2  # rad; the most that a plan made from the root turns


@dataclasses.dataclass(frozen=True)
class Plans:
    """How plans are drawn; a plan says where both feet land next and where the body heads.

    At every switch of stance the second landing place of the old plan becomes the first of the new
    one, and the second is laid from there: a step's length along the planned heading and its width
    to the side of the foot.

    Attributes:
      length: of a step, m: least and most.
      width: between the feet, m: least and most.
      change: probability that a step has other length and width than the one before.
      turn: spread of the change of heading from one step to the next, rad.
      sharp: probability of a sharp turn instead, anything between -pi and pi.
      from_root: probability that a plan is made anew from where the body is and heads, as a
        high-level controller makes plans.
      root_length, root_width: of the steps of such a plan, m: least and most.
      root_turn: spread of its turn off the present heading, rad; cut at 1.2.
    """

    length: tuple[float, float] = (0.5, 0.5)
    width: tuple[float, float] = (0.15, 0.15)
    change: float = 0.1
    turn: float = 0.25
    sharp: float = 0.1
    from_root: float = 0.0
    root_length: tuple[float, float] = (0.2, 0.7)
    root_width: tuple[float, float] = (0.08, 0.28)
    root_turn: float = 0.3

    def __post_init__(self) -> None:
        _check_ranges(self, ('length', 'width', 'root_length', 'root_width'), 'm')
        for name in ('change', 'sharp', 'from_root'):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f'{name} is {getattr(self, name)}; expected a probability')
        for name in ('turn', 'root_turn'):
            if not 0 <= getattr(self, name) < np.inf:
                raise ValueError(f'{name} is {getattr(self, name)}; expected radians, 0 or more')


@dataclasses.dataclass(frozen=True)
class StraightPlans:
    """How plans in the plane are drawn: as those of `Plans`, but straight on and of no width.

    Attributes:
      length: of a step, m: least and most.
      change: probability that a step has another length than the one before.
    """

    length: tuple[float, float] = (0.4, 0.4)
    change: float = 0.1

    def __post_init__(self) -> None:
        _check_ranges(self, ('length',), 'm')
        if not 0 <= self.change <= 1:
            raise ValueError(f'change is {self.change}; expected a probability')


@dataclasses.dataclass(frozen=True)
class Pushes:
    """Horizontal forces from any side on the middle of the torso, again and again.

    Attributes:
      force: N: least and most.
      duration: s of each, in whole control steps.
      interval: s from the end of one, or the start of the episode, to the next.
    """

    force: tuple[float, float] = (50.0, 150.0)
    duration: tuple[float, float] = (0.2, 0.4)
    interval: tuple[float, float] = (1.0, 2.0)

    def __post_init__(self) -> None:
        _check_ranges(self, ('force',), 'N')
        _check_ranges(self, ('duration', 'interval'), 's')


def _check_ranges(instance: Any, names: Sequence[str], unit: str) -> None:
    """Turns fields into pairs of floats, the least and the most."""
    for name in names:
        object.__setattr__(instance, name, span(name, getattr(instance, name), unit))


def span(name: str, value: Any, unit: str) -> tuple[float, float]:
    """Returns the least and the most, 0 or more, as floats.

    Raises:
      ValueError: it is no such pair; the message has the name.
    """
    try:
        low, high = map(float, value)
    except (TypeError, ValueError):
        low, high = np.nan, np.nan
    if not 0 <= low <= high < np.inf:
        raise ValueError(f'{name} is {value}; expected the least and the most, in {unit}')
    return low, high


def options(cls: Any, kind: str, given: Any) -> Any:
    """Returns options as an instance of their class, made of keyword arguments if need be."""
    if not isinstance(given, Mapping):
        if not isinstance(given, cls):
            raise ValueError(f'{kind} is {given!r}; expected {cls.__name__} or a mapping')
        return given
    known = [field.name for field in dataclasses.fields(cls)]
    for name in given:
        if name not in known:
            raise ValueError(errors.unknown(f'option of {kind}', name, known))
    return cls(**given)
