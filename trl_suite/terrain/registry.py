"""The registry of terrain types: their functions, and parameters with defaults, limits and units."""

from __future__ import annotations

import inspect
import math
import types
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from trl_suite.util.options import checked

Parameters = Mapping[str, float]


class Parameter(NamedTuple):
    """A parameter of a terrain type.

    Attributes:
      default: value of sets that omit it.
      low, high: limits; upper ones bound the memory of a stretch of ground.
      unit: unit, for pages.
    """

    default: float
    low: float = -math.inf
    high: float = math.inf
    unit: str = 'm'


NONE: Mapping[str, Parameter] = types.MappingProxyType({})
START_SPAN = {
    'StartSpan': Parameter(0.0, 0.0, 1e5)
}  # of ground that is a function of x, or of x and y


class Generator(NamedTuple):
    """A terrain type: its function, and its parameters.

    Ground that is the same in every episode also has a `line`, a function that returns heights (k,)
    at x (k,), m; a `PlanarGround` then takes its vertices from this function.
    """

    function: Callable[..., Any]
    parameters: Mapping[str, Parameter]
    line: Callable[..., Any] | None = None

    @property
    def defaults(self) -> dict[str, float]:
        """The default of each parameter."""
        return {name: parameter.default for name, parameter in self.parameters.items()}


def limited(low: float, high: float, unit: str = 'm', /, **defaults: float) -> dict[str, Parameter]:
    """Returns parameters with the same limits and unit."""
    return {name: Parameter(default, low, high, unit) for name, default in defaults.items()}


def check(
    where: str, values: Mapping[str, Any], parameters: Mapping[str, Parameter]
) -> dict[str, float]:
    """Returns the values of some parameters as floats; `where` is their owner, for messages."""
    given = {}
    for key, value in values.items():
        bounds: Any = dict(zip(('at_least', 'at_most'), parameters[key][1:3], strict=True))
        bounds = {word: bound for word, bound in bounds.items() if math.isfinite(bound)}
        given[key] = float(checked(f'{where}: {key}', value, float, **bounds))
    complete = {**{name: parameter.default for name, parameter in parameters.items()}, **given}
    for key in complete:
        top = key.removesuffix('Min') + 'Max'
        if key.endswith('Min') and complete[key] > complete.get(top, math.inf):
            bottom, top = (
                f'{name} {complete[name]:g}{"" if name in given else " (the default)"}'
                for name in (key, top)
            )
            raise ValueError(f'{where}: {bottom} is above {top}; a range runs from Min to Max')
    return given


def adding(
    generators: dict[str, Generator],
    type_name: str,
    parameters: Mapping[str, Parameter | float],
    replace: bool,
    line: Callable[..., Any] | None = None,
) -> Callable[[Any], Any]:
    """Returns the decorator that adds a function to a registry; see `register`."""
    full = {
        name: each if isinstance(each, Parameter) else Parameter(each)
        for name, each in parameters.items()
    }
    defaults = {name: each.default for name, each in full.items()}
    defaults = check(f'terrain type {type_name!r}', defaults, full)
    full = {name: each._replace(default=defaults[name]) for name, each in full.items()}

    def add(function: Any) -> Any:
        known = generators.get(type_name)
        if known is not None and not replace and not _same(known.function, function):
            raise ValueError(
                f'terrain type {type_name!r} exists; pass replace=True to replace it, or choose another '
                'name'
            )
        generators[type_name] = Generator(function, types.MappingProxyType(full), line)
        return function

    return add


def _same(one: Any, other: Any) -> bool:
    """Whether two functions have the same module and qualified name; lambdas are always different."""
    if inspect.unwrap(one) is inspect.unwrap(other):
        return True
    (module, name), again = (
        (getattr(each, '__module__', ''), getattr(each, '__qualname__', '<lambda>'))
        for each in (one, other)
    )
    return (module, name) == again and not name.endswith('<lambda>')
