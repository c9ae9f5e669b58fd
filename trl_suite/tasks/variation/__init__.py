"""Components of every task: motors, worlds that vary, pushes, sensors, and users' additions.

    environment = suite.make('PD_Biped2D_Gaps_Terrain-v0', task_kwargs={
        'randomize': {'friction': (0.5, 1.2), 'push': {'force': 150, 'interval': 3}},
        'sensors': {'noise': {'pose': 0.01, 'velocity': 0.1}, 'terrain_dropout': 0.05},
        'actuators': {'delay': 10, 'strength': (0.9, 1.1)},
    })
    environment = suite.make('PD_Biped2D_Gaps_Terrain-v0', task_kwargs={'randomize': 'robot'})

`VectorEnvironment` and Gymnasium environments take the same `task_kwargs`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from trl_suite.actuation import Actuators
from trl_suite.characters import Character
from trl_suite.tasks.component import Component
from trl_suite.tasks.variation import additions
from trl_suite.tasks.variation.motors import Motors
from trl_suite.tasks.variation.sensors import SensorConfig, Sensors
from trl_suite.tasks.variation.worlds import WorldConfig, Worlds
from trl_suite.util.options import Config

ADDITIONS = additions.OPTIONS
DISTURBANCES: Mapping[str, tuple[type[Config], Any]] = {
    'randomize': (WorldConfig, Worlds), 'sensors': (SensorConfig, Sensors),
}  # fmt: skip
OPTIONS = *ADDITIONS, 'actuators', *DISTURBANCES


def components(
    options: Mapping[str, Any], actuators: Actuators, character: Character
) -> Iterator[Component]:
    """Yields the components that options ask for, in the order in which a task has them.

    Args:
      options: values of `ADDITIONS` and `DISTURBANCES`. Of the latter: None; the name of a preset;
        options by name, in which 'preset' may name a preset that the others change, None removing
        one; or a config.
      actuators: the motors.
      character: the character whose joints they drive.

    Raises:
      ValueError: unknown names, values out of range, or options that contradict each other.
    """
    if actuators.changed:
        yield Motors(actuators, character)
    added = {name: options[name] for name in ADDITIONS if name in options}
    if any(added.values()):
        yield additions.additions(added)
    for name, (config, component) in DISTURBANCES.items():
        value = options.get(name)
        if value is not None and not (isinstance(value, Mapping) and not value):
            yield component(config.parse(name, value))
