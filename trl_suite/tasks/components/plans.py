"""Options for drawing footstep plans, and for pushes that disturb the walker."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from trl_suite.util import errors

# Meanings of options of all tasks that follow footstep plans.
MAX_LANDING_ERROR = (
    'distance between a foot and its landing place above which landing ends the episode; by default there '
    'is no limit'
)
FOOTSTEP_SCALE = 'factor of the squared landing error in the reward; larger values reward accuracy'
ROOT_TURN_LIMIT = 1.2  # rad; largest turn of a plan relative to the root


@dataclasses.dataclass(frozen=True)
class Plans:
    """Options for drawing plans; a plan has the next landing places of both feet and a heading.

    At every switch of stance, the second landing place of the old plan becomes the first of the new
    one. The new second place is displaced from it by the length of a step along the planned
    heading, and by its width to the side of the foot.

    Attributes:
      length: minimum and maximum length of a step, m.
      width: minimum and maximum distance between the feet to the side, m.
      change: probability that length and width of a step are redrawn.
      turn: standard deviation of the change of heading from one step to the next, rad.
      sharp: probability of a sharp turn instead, drawn from [-pi, pi).
      from_root: probability that a plan is relative to position and heading of the root, as the
        plans of a high-level controller are.
      root_length, root_width: minimum and maximum length and width of the steps of such a plan, m.
      root_turn: standard deviation of its turn from the current heading, rad; clipped to +-1.2.
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
    """Options for drawing plans in the plane: as `Plans`, but without turns and width.

    Attributes:
      length: minimum and maximum length of a step, m.
      change: probability that the length of a step is redrawn.
    """

    length: tuple[float, float] = (0.4, 0.4)
    change: float = 0.1

    def __post_init__(self) -> None:
        _check_ranges(self, ('length',), 'm')
        if not 0 <= self.change <= 1:
            raise ValueError(f'change is {self.change}; expected a probability')


@dataclasses.dataclass(frozen=True)
class Pushes:
    """Repeated horizontal forces on the torso's centre of mass, in random directions.

    Attributes:
      force: minimum and maximum force, N.
      duration: minimum and maximum duration of a push, s; rounded to control steps.
      interval: minimum and maximum time from the end of a push, or the start of the episode, to the
        next push, s; rounded to control steps.
    """

    force: tuple[float, float] = (50.0, 150.0)
    duration: tuple[float, float] = (0.2, 0.4)
    interval: tuple[float, float] = (1.0, 2.0)

    def __post_init__(self) -> None:
        _check_ranges(self, ('force',), 'N')
        _check_ranges(self, ('duration', 'interval'), 's')


def _check_ranges(instance: Any, names: Sequence[str], unit: str) -> None:
    """Converts fields to pairs of floats, minimum and maximum."""
    for name in names:
        object.__setattr__(instance, name, span(name, getattr(instance, name), unit))


def span(name: str, value: Any, unit: str) -> tuple[float, float]:
    """Returns a minimum and a maximum, both at least 0, as floats.

    Raises:
      ValueError: the value is not such a pair; the message has the name.
    """
    try:
        low, high = map(float, value)
    except (TypeError, ValueError, OverflowError):
        low, high = np.nan, np.nan
    if not 0 <= low <= high < np.inf:
        raise ValueError(f'{name} is {value}; expected minimum and maximum, in {unit}')
    return low, high


def options(cls: Any, kind: str, given: Any) -> Any:
    """Returns options as an instance of `cls`; a mapping is passed to it as keyword arguments."""
    if not isinstance(given, Mapping):
        if not isinstance(given, cls):
            raise ValueError(f'{kind} is {given!r}; expected {cls.__name__} or a mapping')
        return given
    known = [field.name for field in dataclasses.fields(cls)]
    for name in given:
        if name not in known:
            raise ValueError(errors.unknown(f'option of {kind}', name, known))
    return cls(**given)
