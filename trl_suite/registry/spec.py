"""The specification of an environment, as data."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from trl_suite import terrain as terrains

STEP_LIMIT = 256  # steps after which an episode is truncated


@dataclasses.dataclass(frozen=True)
class EnvSpec:
    """One environment: names of its parts, and custom objects in place of some of them.

    Attributes:
      id: id, named as in the papers.
      domain: family, for `suite.load`.
      task: name within the family, for `suite.load`.
      character: name in `trl_suite.characters.CHARACTERS`.
      actuation: one of `trl_suite.actuation.ACTUATIONS`, or 'gait'.
      terrain: a preset, or a file that `trl_suite.terrain.load` takes.
      description: one line.
      task_type: name in `trl_suite.tasks.task_type.TASK_TYPES`.
      clip: name of a clip or library of steps in mocap/, or a file; None if the task type has no
        reference motion.
      options: options of the task type that differ from its defaults.
      tags: tags by which environments can be selected.
      aliases: other ids.
      step_limit: steps after which an episode is truncated.
      differences: differences from the original, in sentences, in addition to those of the task
        type.
      own: custom objects that replace the named 'character', 'terrain', 'clip' or 'task_type'.
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
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    tags: frozenset[str] = frozenset()
    aliases: tuple[str, ...] = ()
    step_limit: int = STEP_LIMIT
    differences: tuple[str, ...] = ()
    own: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ('options', 'own'):  # the catalogue is shared by all, and must not change
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))

    def __reduce__(self) -> tuple[Any, ...]:
        values = (getattr(self, field.name) for field in dataclasses.fields(self))
        return EnvSpec, tuple(
            dict(value) if isinstance(value, MappingProxyType) else value for value in values
        )

    def part(self, name: str) -> Any:
        """Returns the custom object for a field if there is one, otherwise the field's name."""
        return self.own.get(name, getattr(self, name))

    def with_terrain(self, terrain: Any) -> EnvSpec:
        """Returns a copy with another terrain: anything that `trl_suite.terrain.load` takes.

        A file is read once: copies may be made where its name leads nowhere.
        """
        own = {name: value for name, value in self.own.items() if name != 'terrain'}
        if not isinstance(terrain, str) or terrain.endswith(('.json', '.txt')):
            own['terrain'] = terrains.load(terrain)
        if not isinstance(terrain, str):
            terrain = 'terrain'
        return dataclasses.replace(self, terrain=terrain, own=own)
