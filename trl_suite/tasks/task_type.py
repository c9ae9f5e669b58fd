"""A task type: what a kind of task takes, how it is made, and how it is described."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

from trl_suite.characters import Character
from trl_suite.motion import Clip, Steps
from trl_suite.tasks.components import description
from trl_suite.tasks.components.description import Meanings
from trl_suite.tasks.components.differences import Difference
from trl_suite.tasks.task import Task
from trl_suite.util.options import Config
from trl_suite.util.tables import Section

if TYPE_CHECKING:
    from trl_suite.environments.environment import Environment
    from trl_suite.registry.spec import EnvSpec


def tracking(task: Callable[..., Task]) -> Callable[[Parts, Any], Task]:
    """Returns what makes a task that tracks a motion, and takes parts as those of the suite do."""
    return lambda parts, config: task(
        parts.character, parts.arena, parts.motion, config, actuation_model=parts.actuation
    )


class Parts(NamedTuple):
    """What a task is composed of.

    Attributes:
      character: without actuators.
      arena: of as many dimensions.
      motion: a clip or a library of steps, as the task type asks for; None if it takes none.
      actuation: one of the actuation models of the type.
    """

    character: Character
    arena: Any  # PlanarArena or SpatialArena
    motion: Any  # Clip or Steps
    actuation: str


@dataclasses.dataclass(frozen=True)
class Description:
    """Functions that describe a task for people; sections come in the order of the attributes.

    Attributes:
      blocks: task -> unit and meaning of each observation block.
      rules: spec, task -> sections on motion, reward and termination.
      before, after: task -> sections before and after that of the observation.
      action: environment -> section on what actions mean.
      time: spec, task -> section on rates and limits.
      joints: task -> title of one more column in the table of links, and its entry for each joint.
      legend: what pictures show beside the physics.
    """

    blocks: Callable[[Any], Meanings]
    rules: Callable[[EnvSpec, Any], Iterator[Section]] = lambda spec, task: iter(())
    before: Callable[[Any], Iterator[Section]] = lambda task: iter(())
    after: Callable[[Any], Iterator[Section]] = lambda task: iter(())
    action: Callable[[Environment], Section] = description.action
    time: Callable[[EnvSpec, Any], Section] = description.time
    joints: Callable[[Any], tuple[str, Iterable[object]]] = description.reward_weights
    legend: str = ''


@dataclasses.dataclass(frozen=True)
class TaskType:
    """A kind of task.

    Attributes:
      name: as an `EnvSpec` names it.
      title: as `suite.build` names it; types with the same title are for other characters.
      spatial: whether it is for three-dimensional characters, or for planar ones.
      config: its options.
      make: parts, config -> task.
      description: how it is described.
      motion: what it tracks: `Clip`, `Steps`, or None for nothing.
      actuations: models by which it may drive joints; None for all of them.
      options: options that differ from the defaults in what `suite.build` makes.
      score: what tells best how well a policy does, a key of what `evaluation.evaluate` returns.
      samples: what a step is called where steps are counted.
      differences: from the original.
    """

    name: str
    title: str
    spatial: bool
    config: type[Config]
    make: Callable[[Parts, Any], Task]
    description: Description
    motion: type[Clip] | type[Steps] | None = None
    actuations: tuple[str, ...] | None = None
    options: tuple[tuple[str, Any], ...] = ()
    score: str = 'normalized_return'
    samples: str = 'control steps'
    differences: tuple[Difference, ...] = ()
