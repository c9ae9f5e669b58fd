"""Valid values and units of terrain parameters, and valid names of new terrain types."""

from __future__ import annotations

import math
import numbers
import types
from collections.abc import Callable, Mapping
from typing import Any

Parameters = Mapping[str, float]
NO_PARAMETERS: Parameters = types.MappingProxyType({})

# Valid values, by name without Min or Max: lengths and counts are not negative, and upper bounds
# limit the memory of a stretch of ground. Names not listed here may be any number.
_LENGTH, _COUNT, _HEIGHT, _SLOPE = (0.0, 1e3), (0.0, 100.0), (-1e3, 1e3), (-100.0, 100.0)
LIMITS = {
    **dict.fromkeys(('GapSpacing', 'WallSpacing', 'StepSpacing', 'CliffSpacing'), _LENGTH),
    **dict.fromkeys(('NarrowGapSpacing', 'NarrowGapDist'), _LENGTH),
    **dict.fromkeys(('GapW', 'WallW', 'NarrowGapW'), _LENGTH),
    **dict.fromkeys(('NarrowGapCount', 'CliffMiniCount'), _COUNT),
    **dict.fromkeys(('GapH', 'WallH', 'StepH0', 'StepH1', 'BumpH'), _HEIGHT),
    **dict.fromkeys(('CliffH0', 'CliffH1', 'NarrowGapDepth'), _HEIGHT),
    **dict.fromkeys(('SlopeDelta', 'SlopeDeltaRange'), _SLOPE),
    # Three-dimensional ground.
    **dict.fromkeys(('PathWidth0', 'PathWidth1', 'PathWidthDeltaStdev', 'PathTurnLength'), _LENGTH),
    **dict.fromkeys(('ConveyorStripLength', 'ConveyorSpacing'), _LENGTH),
    **dict.fromkeys(('ObstacleWidth0', 'ObstacleWidth1'), (0.0, 40.0)),
    **dict.fromkeys(('ObstacleHeight0', 'ObstacleHeight1'), (0.0, 1e3)),
    **dict.fromkeys(('ObstacleSpeed0', 'ObstacleSpeed1'), (1e-6, 100.0)),
    **dict.fromkeys(('PathHeight0', 'PathHeight1', 'StepHeight'), (-20.0, 20.0)),
    **dict.fromkeys(('NumObstacles', 'ConveyorNumStrips', 'ConveyorNumSlices'), _COUNT),
    'PathLength': (0.2, 1e3),
    'PathMaxTurnDelta': (0.0, 2.0),
    'TrailStepProb': (0.0, 1.0),
    'ObstacleDensity': (0.0, 2.0),
    'ObstacleSpeedLerpPow': (0.0, 100.0),
    'Slope': (-10.0, 10.0),
    # Ground that is a function of x, or of x and y.
    'StartSpan': (0.0, 1e5),
}
# Units of parameters other than lengths in m, by name without Min or Max.
UNITS = {
    **dict.fromkeys(('SlopeDelta', 'SlopeDeltaRange', 'Slope'), '1, rise per m'),
    **dict.fromkeys(('CliffMiniCount', 'NarrowGapCount', 'NumObstacles'), '1, number'),
    **dict.fromkeys(('ConveyorNumStrips', 'ConveyorNumSlices'), '1, number'),
    **dict.fromkeys(('ObstacleSpeed0', 'ObstacleSpeed1'), 'm/s'),
    'ObstacleSpeedLerpPow': '1, exponent',
    'ObstacleDensity': '1/m²',
    'PathMaxTurnDelta': 'rad',
    'TrailStepProb': '1, probability',
    'var3d_checkers.Slope': 'm',  # the name has another meaning in this type
}


def unit(type_name: str, name: str) -> str:
    """Returns the unit of a terrain type's parameter."""
    stem = name.removesuffix('Min').removesuffix('Max')
    return UNITS.get(f'{type_name}.{stem}', UNITS.get(stem, 'm'))


def check(
    where: str, values: Mapping[str, object], defaults: Parameters = NO_PARAMETERS
) -> dict[str, float]:
    """Returns parameter values as floats.

    Args:
      where: the owner of the values, for the message.
      values: name -> number.
      defaults: values of the parameters that are not given.

    Raises:
      ValueError: a value is not a finite number or is outside LIMITS, or a Min is above its Max.
    """
    checked = {}
    for key, value in values.items():
        if isinstance(value, bool) or not isinstance(value, numbers.Real):
            raise ValueError(f'{where}: {key} must be a number, not {value!r}')
        low, high = LIMITS.get(key.removesuffix('Min').removesuffix('Max'), (-math.inf, math.inf))
        try:
            checked[key] = float(value)
        except OverflowError:
            checked[key] = math.inf
        if not math.isfinite(checked[key]):
            raise ValueError(f'{where}: {key} must be finite, not {value!r}')
        if not low <= checked[key] <= high:
            raise ValueError(f'{where}: {key} must be from {low:g} to {high:g}, not {value!r}')
    complete = {**defaults, **checked}
    for key in complete:
        top = key.removesuffix('Min') + 'Max'
        if key.endswith('Min') and complete[key] > complete.get(top, math.inf):
            bottom, top = (
                f'{name} {complete[name]:g}{"" if name in checked else " (the default)"}'
                for name in (key, top)
            )
            raise ValueError(f'{where}: {bottom} is above {top}; a range runs from Min to Max')
    return checked


def check_new(
    type_name: str, known: Callable[..., Any] | None, function: Callable[..., Any], replace: bool
) -> None:
    """Checks that a terrain type may be registered.

    Args:
      type_name: name of the type.
      known: the function that is registered already, if any.
      function: the function to register.
      replace: whether the user allows that the type is replaced.

    Raises:
      ValueError: the name belongs to another function. Two functions are the same if they have the
        same module and qualified name; lambdas are always different.
    """
    if known is None or known is function or replace:
        return
    places = [
        (getattr(each, '__module__', ''), getattr(each, '__qualname__', '<lambda>'))
        for each in (known, function)
    ]
    if places[0] != places[1] or places[0][1].endswith('<lambda>'):
        raise ValueError(
            f'terrain type {type_name!r} exists; pass replace=True to replace it, or choose another '
            'name'
        )
