"""What an environment is, as data."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

STEP_LIMIT = 256  # control steps after which an episode is cut
_MAPPINGS = ('options', 'own')


def _empty() -> Mapping[str, Any]:
    return MappingProxyType({})


@dataclasses.dataclass(frozen=True)
class EnvSpec:
    """One environment: names only, and beside them objects of the user's own.

    Attributes:
      id: id in the paper's manner.
      domain: family, for `suite.load`.
      task: name within the family, for `suite.load`.
      character: name in `trl_suite.characters.CHARACTERS`.
      actuation: one of `trl_suite.actuation.ACTUATIONS`, or 'gait'.
      terrain: a preset, or a file that `trl_suite.terrain.load` takes.
      description: one line.
      task_type: name in `trl_suite.registry.task_types.TASK_TYPES`.
      clip: a clip or a library of steps in mocap/, or a file; None where the task type tracks nothing.
      options: of the task type, where they differ from its defaults.
      tags: for selection.
      aliases: other ids.
      step_limit: control steps after which an episode is cut.
      differences: from the original, in sentences, beside those of the task type.
      own: objects of the user's in place of what 'character', 'terrain', 'clip' or 'task_type' names.
    """

    id: str
    domain: str
    task: str
    character: str
    actuation: str
    terrain: str
    description: str
    task_type: str = 'planar_imitation'
    clip: str | None = None
    options: Mapping[str, Any] = dataclasses.field(default_factory=_empty)
    tags: frozenset[str] = frozenset()
    aliases: tuple[str, ...] = ()
    step_limit: int = STEP_LIMIT
    differences: tuple[str, ...] = ()
    own: Mapping[str, Any] = dataclasses.field(default_factory=_empty)

    def __reduce__(self) -> tuple[Any, ...]:
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return _spec, ({**values, **{name: dict(values[name]) for name in _MAPPINGS}},)

    def part(self, name: str) -> Any:
        """Returns what a field names: the user's object, or else the name."""
        return self.own.get(name, getattr(self, name))

    def with_terrain(self, terrain: Any) -> EnvSpec:
        """Returns the same environment on another terrain, whatever `trl_suite.terrain.load` takes."""
        own = {name: value for name, value in self.own.items() if name != 'terrain'}
        if not isinstance(terrain, str):
            own['terrain'], terrain = terrain, 'terrain'
        return dataclasses.replace(self, terrain=terrain, own=MappingProxyType(own))


def _spec(values: dict[str, Any]) -> EnvSpec:
    return EnvSpec(**{**values, **{name: MappingProxyType(values[name]) for name in _MAPPINGS}})
