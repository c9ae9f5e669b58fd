"""Task types: the parts and options that a kind of task takes, its constructor and description."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

from trl_suite.characters import Character
from trl_suite.motion import Clip, FootstepLibrary
from trl_suite.tasks.common import description
from trl_suite.tasks.task import Task
from trl_suite.util.options import Config
from trl_suite.util.tables import Section

if TYPE_CHECKING:
    from trl_suite.environments.environment import Environment
    from trl_suite.registry.spec import EnvSpec


class Difference(NamedTuple):
    """A difference from the original, and a function that returns whether it applies to a spec."""

    text: str
    applies: Callable[[EnvSpec], bool] = lambda spec: True


def _from(hertz: int) -> str:
    return f'MuJoCo at 300 Hz instead of Bullet at {hertz} Hz; see the option substeps'


FROM_1200, FROM_3000 = Difference(_from(1200)), Difference(_from(3000))
ACTIONS = Difference('actions are in [-1, 1] and clipped; the original takes physical units')
AXES = Difference('axes are x forward, y left, z up; the original has y up and z to the right')
CONES = Difference('a ball joint is limited by one cone, as wide as the widest of its three ranges')
ROTATIONS = (
    Difference(
        'targets of ball joints are rotation vectors about the mean pose; the option '
        "action_offset='original' selects the original's angle and axis"
    ),
    Difference(
        'rotation errors are the shortest rotation; angular velocities of character and reference are '
        'compared in the same frame'
    ),
)
OWN_CLIP = Difference(
    "the clip was made for this suite, with gait and speed close to the original's"
)
START_PHASE = Difference('the start phase is drawn uniformly, not in a fixed sequence')
LANDING = Difference('a landing error ends the episode only with the option max_landing_error')
FACES = Difference(
    'faces of gaps, walls and steps are exactly vertical, and every start has flat ground from -1 to 1 m',
    lambda spec: spec.terrain != 'flat',
)
CUT = Difference('episodes are truncated after 256 steps (discount 1)')


def tracking(task: Callable[..., Task]) -> Callable[[Parts, Any], Task]:
    """Returns the `make` function of a task type, for a task class with a reference motion."""
    return lambda parts, config: task(
        parts.character, parts.arena, parts.motion, config, actuation_model=parts.actuation
    )


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
class Description:
    """Functions that describe a task, for `trl-suite info` and the documentation pages.

    Attributes:
      rules: spec, task -> sections on motion, reward and termination.
      before: task -> sections before the section on the observation.
      action: environment -> section on the meaning of actions.
      time: spec, task -> section on rates and limits.
      joints: task -> title of the last column in the table of links, and its entry for each joint.
      legend: meaning of the markers in rendered images.
    """

    rules: Callable[[EnvSpec, Any], Iterator[Section]] = lambda spec, task: iter(())
    before: Callable[[Any], Iterator[Section]] = lambda task: iter(())
    action: Callable[[Environment], Section] = description.action
    time: Callable[[EnvSpec, Any], Section] = description.time
    joints: Callable[[Any], tuple[str, Iterable[object]]] = description.reward_weights
    legend: str = ''


@dataclasses.dataclass(frozen=True)
class TaskType:
    """A kind of task.

    Attributes:
      name: unique name, for `EnvSpec.task_type`.
      title: name for `suite.build`; a planar and a spatial type may have the same title.
      spatial: whether it is for three-dimensional characters, not for planar ones.
      config: class of its options.
      make: parts, config -> task.
      description: functions that describe it.
      motion: type of the reference motion: `Clip`, `FootstepLibrary`, or None.
      actuations: supported actuation models; None for all of them.
      options: options for `suite.build` that differ from the defaults.
      score: the main performance measure, a key of the result of `evaluation.evaluate`.
      samples: name of the steps where they are counted, e.g. 'cycles'.
      differences: differences from the original.
    """

    name: str
    title: str
    spatial: bool
    config: type[Config]
    make: Callable[[Parts, Any], Task]
    description: Description
    motion: type[Clip] | type[FootstepLibrary] | None = None
    actuations: tuple[str, ...] | None = None
    options: tuple[tuple[str, Any], ...] = ()
    score: str = 'normalized_return'
    samples: str = 'control steps'
    differences: tuple[Difference, ...] = ()
