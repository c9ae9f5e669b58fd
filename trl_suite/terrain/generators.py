"""Terrain types: the registry of their generators and parameters.

A planar terrain is a polyline with vertices SPACING apart. Its generator is a function of
(parameters, length in m, random generator) that returns a `Profile`: the vertices to append to the
existing ground, whose last vertex is at height 0. It repeats its feature until the length is
reached, so it overshoots by up to one feature. It must depend on its arguments only: ground that
was forgotten is generated again, and a saved state holds the seed, not the ground. `register` adds a
type:

    @register('var2d_saw', {'ToothW': 1.0, 'ToothHMin': 0.1, 'ToothHMax': 0.2})
    def saw(parameters, length, rng):
        cells = math.ceil(parameters['ToothW'] / SPACING)
        teeth = math.ceil(length / SPACING / cells)
        rises = rng.uniform(parameters['ToothHMin'], parameters['ToothHMax'], teeth)
        heights = np.outer(rises, np.arange(1, cells + 1) / cells).ravel()
        return Profile(heights, np.diff(heights, prepend=0.0) < 0)

The generator of a three-dimensional terrain is a function of (parameters, random generator) that
returns a `Layout`: the ground of one episode. It uses the random generator only while it runs;
unbounded parts are functions with random streams of their own, so that the ground depends on the
seed only, not on the order or extent of queries. `register3d` adds a type:

    @register3d('mounds3d', {'Radius': 2.0, 'HeightMin': 0.1, 'HeightMax': 0.3})
    def mounds(parameters, rng):
        height = rng.uniform(parameters['HeightMin'], parameters['HeightMax'])

        def grid(i, j):
            far = np.hypot.outer(i * GRID, j * GRID) / parameters['Radius']
            return height * np.maximum(1 - far**2, 0)

        return Layout(level=None, grid=grid)

`planar/features.py` and `spatial/features.py` have the original's types.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import math
import types
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from trl_suite.terrain.spatial.layout import Layout
from trl_suite.util.digest import digest
from trl_suite.util.errors import check_known
from trl_suite.util.options import checked

SPACING = 0.025  # m between vertices
STEEP = 3.0  # rise per m; steeper cells of a line are vertical faces
LONGEST = 1e6  # m; largest |x| of a query
BORDER = LONGEST - 1e3  # m; a character beyond has left the ground; its goals are nearer to it

Parameters = Mapping[str, float]
Function = Callable[[Parameters, float, np.random.Generator], 'Profile']
Function3D = Callable[[Parameters, np.random.Generator], Layout]


@dataclasses.dataclass(frozen=True, eq=False)
class Profile:
    """Vertices to append to a ground whose last vertex is at height 0.

    Attributes:
      heights: heights of the vertices, SPACING apart, m, shape (k,).
      vertical: True where the cell between the previous vertex and this one is the vertical face of
        a feature, shape (k,). The first cell begins at the last vertex of the existing ground.
    """

    heights: np.ndarray
    vertical: np.ndarray


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
START_SPAN = {'StartSpan': Parameter(0.0, 0.0, 1e5)}  # of ground that is a function of position


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


_planar: dict[str, Generator] = {}
_spatial: dict[str, Generator] = {}
GENERATORS: Mapping[str, Generator] = types.MappingProxyType(_planar)
GENERATORS3D: Mapping[str, Generator] = types.MappingProxyType(_spatial)


def register(
    type_name: str, defaults: Mapping[str, Parameter | float] = NONE, *, replace: bool = False
) -> Callable[[Function], Function]:
    """Decorates a function as the generator of a new terrain type.

    Args:
      type_name: the `Type` in terrain files.
      defaults: the names of all its parameters, with their defaults; a `Parameter` has limits, too.
      replace: whether a type that belongs to another function may be replaced. A function with the
        same module and name, e.g. of a notebook cell that is run again, always replaces it; one that
        another function makes, if its contents are the same, too.

    Raises:
      ValueError: the name is taken; or a default is not finite, beyond its limits, or a Min above its
        Max.
    """
    return _adding(_planar, type_name, defaults, replace)


def register_line(
    type_name: str, line: Callable[[np.ndarray], np.ndarray], *, replace: bool = True
) -> None:
    """Registers planar ground whose heights are a function of x."""

    @functools.wraps(line, updated=())
    def ahead(parameters: Parameters, length: float, rng: np.random.Generator) -> Profile:
        heights = line(SPACING * np.arange(cells(length) + 1))
        rises = np.diff(heights)
        return Profile(heights[1:] - heights[0], np.abs(rises) > STEEP * SPACING)

    _adding(_planar, type_name, START_SPAN, replace, line)(ahead)


def register3d(
    type_name: str, defaults: Mapping[str, Parameter | float] = NONE, *, replace: bool = False
) -> Callable[[Function3D], Function3D]:
    """Decorates a function as the generator of a new three-dimensional terrain type.

    Arguments and errors are those of `register`.
    """
    return _adding(_spatial, type_name, defaults, replace)


def _adding(
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

    kind, other, others = 'planar', 'three-dimensional', _spatial
    if generators is _spatial:
        kind, other, others = other, kind, _planar

    def add(function: Any) -> Any:
        if type_name in others:
            raise ValueError(
                f'terrain type {type_name!r} exists and is {other}; choose another name for one that is {kind}'
            )
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
    """Whether two functions have the same module and qualified name; lambdas are always different.

    Of functions that another function makes, the contents count as well.
    """
    one, other = inspect.unwrap(one), inspect.unwrap(other)
    if one is other:
        return True
    (module, name), again = (
        (getattr(each, '__module__', ''), getattr(each, '__qualname__', '<lambda>'))
        for each in (one, other)
    )
    if (module, name) != again or name.endswith('<lambda>'):
        return False
    return '<locals>' not in name or digest(one) == digest(other)


def draw(
    type_name: str, parameters: Parameters, length: float, rng: np.random.Generator
) -> Profile:
    """Generates a stretch of ground of a nominal length, m, and checks the generator's result.

    `parameters` are those of `Terrain.parameters`.
    """
    check_known('terrain type', _planar, type_name)
    profile = _planar[type_name].function(parameters, length, rng)
    fault = ''
    if not isinstance(profile, Profile):
        fault = f'must return a Profile, not {type(profile).__name__}'
    else:
        heights, vertical = np.asarray(profile.heights), np.asarray(profile.vertical)
        if heights.ndim != 1 or not len(heights) or heights.dtype.kind not in 'fiu':
            fault = f'heights must be numbers of shape (k,), k > 0, not {heights.shape}'
        elif vertical.shape != heights.shape or vertical.dtype != bool:
            fault = f'vertical must be bools of shape {heights.shape}, not {vertical.shape}'
            fault += f' of {vertical.dtype}'
        elif not np.isfinite(heights).all():
            fault = f'height of vertex {int(np.argmin(np.isfinite(heights)))} is not finite'
    if fault:
        raise ValueError(f'generator of terrain type {type_name!r}: {fault}')
    return Profile(np.ascontiguousarray(heights, float), np.ascontiguousarray(vertical))


def draw3d(type_name: str, parameters: Parameters, rng: np.random.Generator) -> Layout:
    """Generates the ground of an episode, and checks the generator's result.

    `parameters` are those of `Terrain.parameters`.
    """
    check_known('three-dimensional terrain type', _spatial, type_name)
    layout = _spatial[type_name].function(parameters, rng)
    if not isinstance(layout, Layout):
        fault = f'must return a Layout, not {type(layout).__name__}'
    else:
        fault = layout.fault()
    if fault:
        raise ValueError(f'generator of terrain type {type_name!r}: {fault}')
    return dataclasses.replace(layout, generator=type_name)


def cells(length: float) -> int:
    """Returns the number of cells of a length in m: rounded up, except for rounding errors."""
    return math.ceil(length / SPACING - 1e-9)
