"""Generators of planar terrain: their results, and the registry of terrain types.

A planar terrain is a polyline with vertices SPACING apart. A generator is a function of
(parameters, length in m, random generator) that returns a `Profile`: the vertices to append to the
existing ground, whose last vertex is at height 0. It repeats its feature until the length is
reached, so it overshoots by up to one feature. It must depend on its arguments only: ground that
was forgotten is generated again, and a saved state holds the seed, not the ground. `features.py`
has the original's terrain types. `register` adds a type:

    @register('var2d_saw', {'ToothW': 1.0, 'ToothHMin': 0.1, 'ToothHMax': 0.2})
    def saw(parameters, length, rng):
        cells = math.ceil(parameters['ToothW'] / SPACING)
        teeth = math.ceil(length / SPACING / cells)
        rises = rng.uniform(parameters['ToothHMin'], parameters['ToothHMax'], teeth)
        heights = np.outer(rises, np.arange(1, cells + 1) / cells).ravel()
        return Profile(heights, np.diff(heights, prepend=0.0) < 0)
"""

from __future__ import annotations

import dataclasses
import functools
import math
import types
from collections.abc import Callable, Mapping

import numpy as np

from trl_suite.terrain.registry import NONE, START_SPAN, Generator, Parameter, Parameters, adding
from trl_suite.util.errors import check_known

SPACING = 0.025  # m between vertices
STEEP = 3.0  # rise per m; steeper cells of a line are vertical faces
LONGEST = 1e6  # m; largest length of a stretch, and largest |x| of a query
BORDER = LONGEST - 1e3  # m; a character beyond has left the ground; its goals are nearer to it


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


Function = Callable[[Parameters, float, np.random.Generator], Profile]


_generators: dict[str, Generator] = {}
GENERATORS: Mapping[str, Generator] = types.MappingProxyType(_generators)


def register(
    type_name: str, defaults: Mapping[str, Parameter | float] = NONE, *, replace: bool = False
) -> Callable[[Function], Function]:
    """Decorates a function as the generator of a new terrain type.

    Args:
      type_name: the `Type` in terrain files.
      defaults: the names of all its parameters, with their defaults; a `Parameter` has limits, too.
      replace: whether a type that belongs to another function may be replaced. A function with the
        same module and name, e.g. of a notebook cell that is run again, always replaces it.

    Raises:
      ValueError: the name is taken; or a default is not finite, beyond its limits, or a Min above its
        Max.
    """
    return adding(_generators, type_name, defaults, replace)


def register_line(
    type_name: str, line: Callable[[np.ndarray], np.ndarray], *, replace: bool = True
) -> None:
    """Registers planar ground whose heights are a function of x."""

    @functools.wraps(line, updated=())
    def ahead(parameters: Parameters, length: float, rng: np.random.Generator) -> Profile:
        heights = line(SPACING * np.arange(cells(length) + 1))
        rises = np.diff(heights)
        return Profile(heights[1:] - heights[0], np.abs(rises) > STEEP * SPACING)

    adding(_generators, type_name, START_SPAN, replace, line)(ahead)


def draw(
    type_name: str, parameters: Parameters, length: float, rng: np.random.Generator
) -> Profile:
    """Generates a stretch of ground of a nominal length, m, and checks the generator's result.

    `parameters` are those of `Terrain.parameters`.
    """
    check_known('terrain type', _generators, type_name)
    if not 0 < length <= LONGEST:
        raise ValueError(
            f'length is {length!r}; expected a number above 0 and at most {LONGEST:g} m'
        )
    profile = _generators[type_name].function(parameters, length, rng)
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


def cells(length: float) -> int:
    """Returns the number of cells of a length in m: rounded up, except for rounding errors."""
    return math.ceil(length / SPACING - 1e-9)
