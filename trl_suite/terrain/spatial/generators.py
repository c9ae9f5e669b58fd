"""Generators of three-dimensional terrain: the registry of terrain types.

A generator is a function of (parameters, random generator) that returns a `Layout`: the ground of
one episode. It uses the random generator only while it runs; unbounded parts are functions with
random streams of their own, so that the ground depends on the seed only, not on the order or extent
of queries. `features.py` has the original's terrain types. `register3d` adds a type:

    @register3d('mounds3d', {'Radius': 2.0, 'HeightMin': 0.1, 'HeightMax': 0.3})
    def mounds(parameters, rng):
        height = rng.uniform(parameters['HeightMin'], parameters['HeightMax'])

        def grid(i, j):
            far = np.hypot.outer(i * GRID, j * GRID) / parameters['Radius']
            return height * np.maximum(1 - far**2, 0)

        return Layout(level=None, grid=grid)
"""

from __future__ import annotations

import dataclasses
import types
from collections.abc import Callable, Mapping

import numpy as np

from trl_suite.terrain.registry import NONE, Generator, Parameter, Parameters, adding
from trl_suite.terrain.spatial.layout import Layout
from trl_suite.util.errors import check_known

Function3D = Callable[[Parameters, np.random.Generator], Layout]

_generators: dict[str, Generator] = {}
GENERATORS3D: Mapping[str, Generator] = types.MappingProxyType(_generators)


def register3d(
    type_name: str, defaults: Mapping[str, Parameter | float] = NONE, *, replace: bool = False
) -> Callable[[Function3D], Function3D]:
    """Decorates a function as the generator of a new three-dimensional terrain type.

    Arguments and errors are those of `register`.
    """
    return adding(_generators, type_name, defaults, replace)


def draw3d(type_name: str, parameters: Parameters, rng: np.random.Generator) -> Layout:
    """Generates the ground of an episode, and checks the generator's result.

    `parameters` are those of `Terrain.parameters`.
    """
    check_known('three-dimensional terrain type', _generators, type_name)
    layout = _generators[type_name].function(parameters, rng)
    if not isinstance(layout, Layout):
        fault = f'must return a Layout, not {type(layout).__name__}'
    else:
        fault = layout.fault()
    if fault:
        raise ValueError(f'generator of terrain type {type_name!r}: {fault}')
    return dataclasses.replace(layout, generator=type_name)
