"""Terrains as parameter files: the paper's format, its presets, and interpolation between sets.

A terrain file is a JSON object:

    {"Type": "var2d_gaps",
     "Params": [{"GapSpacingMin": 2, "GapSpacingMax": 2.5, "GapWMin": 0.25, "GapWMax": 0.3}]}

`Type` is a key of GENERATORS. `Params` is a list of parameter sets, each a flat object, name ->
number. A parameter that a set omits takes the type's default; an empty or absent list means all
defaults. Between several sets `terrain_level` interpolates, e.g. for a curriculum. `GroundWidth`,
`VertSpacingX` and `VertSpacingZ` are accepted and have no effect on planar ground, as in the
original. The example printed in the paper is the preset `slopes_mixed_humanoid`.

Files of DeepTerrainRL, the predecessor, have types without the prefix, such as `gaps` for
`var2d_gaps`, and are read as such. Its vertices are 0.1 m apart and slopes change per vertex, so that
the same numbers give ground that is rougher over short distances here; and its faces are ramps of
0.1 m, as here with `FaceLength` 0.1. Bumps and slopes on cliffs, which it also had, must be 0.

Three-dimensional types are keys of GENERATORS3D; their files look the same. Their height grids have
vertices 0.2 m apart, so another `VertSpacingX` or `VertSpacingZ` is refused.

The original ignored unknown entries. Here a file raises a ValueError that names the file, set and
key, if it has
* a key that its type does not use (of another type, or misspelt), or the same key twice;
* a value that is not a finite number;
* a range whose Min is above its Max, whether given or default;
* a negative spacing, width or count, or a value beyond the limits of its `Parameter`. Zero is
  allowed: every feature has at least one vertex, so every generator terminates.

The presets are the original's terrain files under their original names (planar ones in PRESETS,
three-dimensional ones in PRESETS3D), and `mixed_humanoid`, which is `slopes_mixed_humanoid` without
its slopes. Entries without effect are omitted; `docs/differences.md` has the other differences.
"""

from __future__ import annotations

import dataclasses
import importlib.resources
import json
import os
import types
from collections.abc import Mapping
from typing import Any

# These register the original's types.
import trl_suite.terrain.planar.features
import trl_suite.terrain.spatial.features  # noqa: F401
from trl_suite.terrain.generators import GENERATORS, GENERATORS3D, Generator, check
from trl_suite.terrain.spatial.layout import GRID
from trl_suite.util.errors import check_known, is_number, unknown
from trl_suite.util.files import existing, read_json
from trl_suite.util.options import checked

_UNUSED = ('GroundWidth', 'VertSpacingX', 'VertSpacingZ')
_PREFIX = 'var2d_'
# Parameters of DeepTerrainRL's type `cliffs` that have no effect if they are 0.
_OVERLAYS = ('BumpHMin', 'BumpHMax', 'SlopeDeltaRange', 'SlopeDeltaMin', 'SlopeDeltaMax')


@dataclasses.dataclass(frozen=True)
class Terrain:
    """A terrain type with its parameters.

    Attributes:
      name: preset name, path of the file, or any other name, for messages.
      type: a key of GENERATORS or of GENERATORS3D.
      parameter_sets: the sets as given, without defaults; read-only.

    Raises:
      ValueError: unknown type, or an invalid parameter (see the module).
    """

    name: str
    type: str
    parameter_sets: tuple[Mapping[str, float], ...] = ()

    def __post_init__(self) -> None:
        if self.type not in GENERATORS and self.type not in GENERATORS3D:
            known = (*GENERATORS, *GENERATORS3D)
            raise ValueError(f'{self.name}: Type: {unknown("terrain type", self.type, known)}')
        sets = []
        for i, values in enumerate(self.parameter_sets):
            where = f'{self.name}: Params[{i}]'
            if not isinstance(values, Mapping):
                raise ValueError(f'{where} must be an object name -> number, not {values!r}')
            for key in values:
                if key not in self.generator.parameters:
                    raise ValueError(f'{where}: {self._unknown_parameter(key)}')
            values = check(where, values, self.generator.parameters)
            sets.append(types.MappingProxyType(values))
        object.__setattr__(self, 'parameter_sets', tuple(sets))

    def __reduce__(self) -> tuple[Any, ...]:
        return Terrain, (self.name, self.type, tuple(map(dict, self.parameter_sets)))

    @property
    def spatial(self) -> bool:
        """Whether it is three-dimensional: a `SpatialGround`, not a `PlanarGround`."""
        return self.type in GENERATORS3D

    @property
    def generator(self) -> Generator:
        """Functions and parameters of its type."""
        return (GENERATORS3D if self.spatial else GENERATORS)[self.type]

    @property
    def contents(self) -> tuple[Any, ...]:
        """What the ground depends on: type, parameter sets, and the functions of the type."""
        return self.type, self.parameter_sets, tuple(self.generator)

    def parameters(self, terrain_level: float = 0.0) -> dict[str, float]:
        """Returns a value for every parameter of the type.

        Args:
          terrain_level: number of the set; between whole numbers, each parameter is interpolated
            linearly between the two neighbouring sets.

        Raises:
          ValueError: terrain_level is not a number from 0 to that of the last set.
        """
        defaults = self.generator.defaults
        sets = [{**defaults, **values} for values in self.parameter_sets] or [defaults]
        if not is_number(terrain_level) or not 0 <= terrain_level <= len(sets) - 1:
            raise ValueError(
                f'terrain_level is {terrain_level!r}; expected a number from 0 to {len(sets) - 1}, as '
                f'{self.name!r} has {len(sets)} parameter set{"s" * (len(sets) > 1)}'
            )
        k = int(terrain_level)
        weight = terrain_level - k
        if not weight:
            return sets[k]
        return {key: (1 - weight) * a + weight * sets[k + 1][key] for key, a in sets[k].items()}

    def with_faces(self, length: float | None) -> Terrain:
        """Returns a copy with another `FaceLength`, m; this terrain with None, or without faces.

        Types of your own have faces of another length only if they have this parameter.

        Raises:
          ValueError: the length is out of range.
        """
        if length is None or 'FaceLength' not in self.generator.parameters:
            return self
        sets = ({**values, 'FaceLength': length} for values in self.parameter_sets or ({},))
        return dataclasses.replace(self, parameter_sets=tuple(sets))

    def _unknown_parameter(self, key: object) -> str:
        registry = GENERATORS3D if self.spatial else GENERATORS
        owners = [name for name, generator in registry.items() if key in generator.parameters]
        if owners:
            return f'{key!r} has no effect in {self.type}, only in {", ".join(owners)}'
        if not self.generator.parameters:
            return f'unknown parameter {key!r}; {self.type} has none'
        return unknown(f'parameter of {self.type}', key, self.generator.parameters)


def _from_mapping(name: str, content: Mapping[str, Any]) -> Terrain:
    known = ('Type', 'Params', *_UNUSED)
    check_known(f'key of {name}:', known, *content)
    if 'Type' not in content:
        types = ', '.join((*GENERATORS, *GENERATORS3D))
        raise ValueError(f"{name}: key 'Type' is missing; known types: {types}")
    checked(f'{name}: Type', content['Type'], str)
    sets = content.get('Params', ())
    if not isinstance(sets, (list, tuple)):
        raise ValueError(f'{name}: Params must be a list of parameter sets, not {sets!r}')
    kind = content['Type']
    if kind not in GENERATORS and f'{_PREFIX}{kind}' in GENERATORS:  # a file of DeepTerrainRL
        kind = f'{_PREFIX}{kind}'
        if kind == 'var2d_cliffs':
            sets = [_without_overlays(each) for each in sets]
    for key in [key for key in _UNUSED if key in content]:
        value = checked(f'{name}: {key}', content[key], float)
        if kind in GENERATORS3D and key != 'GroundWidth' and value != GRID:
            raise ValueError(f'{name}: {key} must be {GRID:g} m, not {value!r}')
    return Terrain(name, kind, tuple(sets))


def _without_overlays(values: Any) -> Any:
    if not isinstance(values, Mapping):
        return values  # an error, see `Terrain`
    return {key: value for key, value in values.items() if key not in _OVERLAYS or value}


def load(source: Terrain | str | os.PathLike[str] | Mapping[str, Any]) -> Terrain:
    """Returns a terrain.

    Args:
      source: a Terrain (returned unchanged), the name of a preset, the path of a terrain file (a
        str that ends in .json or .txt, or any os.PathLike), or the content of one as a mapping.

    Raises:
      ValueError: unknown preset or type, malformed file, or an invalid parameter (see the module);
        the message names file, set, key and reason.
      OSError: the file cannot be read.
      TypeError: the source has another type.
    """
    if isinstance(source, Terrain):
        return source
    if isinstance(source, Mapping):
        return _from_mapping(str(source.get('Type', 'terrain')), source)
    if not isinstance(source, (str, os.PathLike)):
        raise TypeError(
            'a terrain is given as a preset name, a path, a mapping or a Terrain, '
            f'not {type(source).__name__}'
        )
    name = os.fspath(source)
    if isinstance(source, str) and not name.endswith(('.json', '.txt')):
        known = {**PRESETS, **PRESETS3D}
        if name not in known and (name in GENERATORS or name in GENERATORS3D):
            raise ValueError(
                f"{name!r} is a type of terrain; expected {{'Type': {name!r}}}, or a preset"
            )
        check_known('terrain', known, name)
        return known[name]
    content = read_json(existing(name))
    if not isinstance(content, dict):
        raise ValueError(f'{name}: must hold a JSON object with keys Type and Params')
    return _from_mapping(name, content)


def _presets(file: str) -> Mapping[str, Terrain]:
    text = importlib.resources.files(__package__).joinpath(file).read_text('utf-8')
    presets = {name: _from_mapping(name, content) for name, content in json.loads(text).items()}
    return types.MappingProxyType(presets)


PRESETS: Mapping[str, Terrain] = _presets('presets.json')
PRESETS3D: Mapping[str, Terrain] = _presets('presets3d.json')
