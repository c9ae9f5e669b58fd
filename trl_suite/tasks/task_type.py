"""Task types: the parts and options that a kind of task takes, and its constructor."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

from trl_suite import motion
from trl_suite.characters import Character
from trl_suite.motion import Clip, FootstepLibrary
from trl_suite.tasks.common.goals import Ball
from trl_suite.tasks.footsteps import task as footsteps
from trl_suite.tasks.gait.task import GaitConfig, GaitTask
from trl_suite.tasks.imitation import task as imitation
from trl_suite.tasks.navigation import direct
from trl_suite.tasks.navigation.hierarchical import HierarchicalConfig, HierarchicalNavigation
from trl_suite.tasks.task import Task
from trl_suite.tasks.walk import task as walk
from trl_suite.util import errors
from trl_suite.util.options import Config


class Parts(NamedTuple):
    """The parts from which a task is made.

    Attributes:
      character: a character without actuators.
      arena: planar or spatial, as the character.
      motion: the reference motion, a clip or a library of steps; None if the task type has none.
      actuation: one of the actuation models of the task type.
    """

    character: Character
    arena: Any  # PlanarArena or SpatialArena
    motion: Any  # Clip or FootstepLibrary
    actuation: str


@dataclasses.dataclass(frozen=True)
class TaskType:
    """A kind of task.

    Attributes:
      name: unique name, for `EnvSpec.task_type`.
      title: name for `suite.build`; a planar and a spatial type may have the same title.
      spatial: whether it is for three-dimensional characters, not for planar ones.
      config: class of its options.
      make: parts, config -> task.
      motion: type of the reference motion: `Clip`, `FootstepLibrary`, or None.
      actuations: supported actuation models; None for all of them.
      options: options for `suite.build` that differ from the defaults.
      score: the main performance measure, a key of the result of `evaluation.evaluate`.
      samples: name of the steps where they are counted, e.g. 'cycles'.
    """

    name: str
    title: str
    spatial: bool
    config: type[Config]
    make: Callable[[Parts, Any], Task]
    motion: type[Clip] | type[FootstepLibrary] | None = None
    actuations: tuple[str, ...] | None = None
    options: tuple[tuple[str, Any], ...] = ()
    score: str = 'normalized_return'
    samples: str = 'control steps'


def tracking(task: Callable[..., Task], with_ball: bool = False) -> Callable[[Parts, Any], Task]:
    """Returns the `make` function of a task class with a reference motion, or also with a ball."""

    def make(parts: Parts, config: Any) -> Task:
        ball = {'ball': Ball(parts.arena)} if with_ball else {}
        part = parts.character, parts.arena, parts.motion, config
        return task(*part, actuation_model=parts.actuation, **ball)

    return make


def _direct(parts: Parts, config: Any) -> Task:
    if config.reward == 'original':
        name = parts.character.spec.name
        errors.check_known(
            "character with reward='original', which needs its steps", motion.steps_names(), name
        )
        steps = motion.load_steps(name)
        if parts.motion.name != parts.character.spec.clip:
            raise ValueError(
                f"clip {parts.motion.name!r}: reward='original' takes the steps of {name!r}, and no clip"
            )
        return direct.hidden_plan(parts.character, parts.arena, steps, config, parts.actuation)
    return tracking(direct.DirectNavigation)(parts, config)


def _walk(parts: Parts, config: Any) -> Task:
    return walk.Walk(parts.character, parts.arena, config, actuation_model=parts.actuation)


def _tracking(name: str, spatial: bool, task: Any, kind: Any) -> TaskType:
    """Returns the type of a task of imitation or footsteps."""
    full = f'{"spatial" if spatial else "planar"}_{name}'
    return TaskType(full, name, spatial, task.CONFIG, tracking(task), kind)


def _planned(name: str, with_ball: bool = False) -> TaskType:
    """Returns the type of a task whose actions are plans."""
    return TaskType(
        name,
        name,
        True,
        HierarchicalConfig,
        tracking(HierarchicalNavigation, with_ball),
        FootstepLibrary,
        actuations=('position',),
        samples='plans',
    )


TASK_TYPES: dict[str, TaskType] = {
    type_.name: type_
    for type_ in (
        _tracking('imitation', False, imitation.PlanarImitation, Clip),
        _tracking('imitation', True, imitation.SpatialImitation, Clip),
        _tracking('footsteps', False, footsteps.PlanarFootsteps, Clip),
        _tracking('footsteps', True, footsteps.SpatialFootsteps, FootstepLibrary),
        _planned('goal_navigation'),
        _planned('soccer', with_ball=True),
        TaskType(
            'direct_navigation',
            'direct_navigation',
            True,
            direct.DirectNavigationConfig,
            _direct,
            Clip,
        ),
        TaskType(
            'direct_soccer',
            'direct_soccer',
            True,
            direct.DirectConfig,
            tracking(direct.DirectNavigation, with_ball=True),
            Clip,
        ),
        TaskType(
            'gait',
            'gait',
            False,
            GaitConfig,
            lambda parts, config: GaitTask(parts.character, parts.arena, config),
            actuations=('gait',),
            score='distance',
            samples='cycles',
        ),
        *(
            TaskType(
                f'{"spatial" if spatial else "planar"}_walk',
                'walk',
                spatial,
                config,
                _walk,
                options=(('rewards', walk.WALK),),
            )
            for spatial, config in walk.Walk.CONFIG.items()
        ),
    )
}
TITLES: tuple[str, ...] = tuple(dict.fromkeys(type_.title for type_ in TASK_TYPES.values()))
