"""Components of every task: levels, motors, worlds that vary, pushes, sensors, and users' additions.

    environment = suite.make('PD_Biped2D_Gaps_Terrain-v0', task_kwargs={
        'randomize': {'friction': (0.5, 1.2), 'push': {'force': 150, 'interval': 3}},
        'sensors': {'noise': {'pose': 0.01, 'velocity': 0.1}, 'terrain_dropout': 0.05},
        'actuators': {'delay': 10, 'strength': (0.9, 1.1)},
    })
    environment = suite.make('PD_Biped2D_Gaps_Terrain-v0', task_kwargs={'randomize': 'robot'})

`VectorEnvironment` and Gymnasium environments take the same `task_kwargs`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from trl_suite.actuation import Actuators
from trl_suite.characters import Character
from trl_suite.tasks.component import Component
from trl_suite.tasks.variation import levels as level
from trl_suite.tasks.variation.additions import Additions
from trl_suite.tasks.variation.motors import Motors
from trl_suite.tasks.variation.pushes import Pushes
from trl_suite.tasks.variation.sensors import SensorConfig, Sensors
from trl_suite.tasks.variation.worlds import WorldConfig, Worlds
from trl_suite.util.options import Config, option


@dataclasses.dataclass(frozen=True, kw_only=True)
class CommonOptions(Config):
    """Options of every task, in addition to its own."""

    rewards: Any = option(
        None, 'custom terms: name -> (weight, function); see docs/make_your_own.md'
    )
    observations: Any = option(None, 'custom blocks: name -> (size, function)')
    failures: Any = option(None, 'custom failures: name -> function')
    randomize: WorldConfig | None = option(
        None,
        "properties of the world and pushes, drawn in every episode: 'mild', 'robot', 'harsh' or a "
        'dict, see docs/realism.md',
    )
    sensors: SensorConfig | None = option(
        None,
        "noise, bias, drop-outs and delay of observations: 'mild', 'robot', 'harsh' or a dict, see "
        'docs/realism.md',
    )
    actuators: Actuators = option(
        None,
        'limits, delay, noise, strength, free play and elasticity of motors: a dict, see '
        'docs/realism.md',
    )
    levels: Sequence[int] | None = option(
        None,
        'the first level and the number of levels from which every episode draws one; a level is the '
        'seed of its terrain',
        at_least=0,
    )

    def __post_init__(self) -> None:
        for name in ('randomize', 'sensors'):
            if isinstance(getattr(self, name), Mapping) and not getattr(self, name):
                self._set(name, None)  # nothing is asked for
        super().__post_init__()
        level.check(self.levels)


def components(options: CommonOptions, character: Character) -> Iterator[Component]:
    """Yields the components that options ask for, in the order in which a task has them.

    Raises:
      ValueError: invalid additions, or options that do not suit the character, whose joints motors
        drive.
    """
    if options.levels is not None:
        yield level.Levels(options.levels)
    if options.actuators.changed:
        yield Motors(options.actuators, character)
    added = options.rewards, options.observations, options.failures
    if any(added):
        yield Additions(*(each or {} for each in added))
    if options.randomize is not None:
        yield Worlds(options.randomize)
        if options.randomize.push is not None:
            yield Pushes(options.randomize.push)
    if options.sensors is not None:
        yield Sensors(options.sensors)
