"""Worlds that vary between episodes, pushes, and sensors with noise, for every task.

    environment = suite.make('PD_Biped2D_Gaps_Terrain-v0', task_kwargs={
        'randomize': {'friction': (0.5, 1.2), 'push': {'force': 150, 'interval': 3}},
        'sensors': {'noise': {'pose': 0.01, 'velocity': 0.1}, 'terrain_dropout': 0.05},
    })
    environment = suite.make('PD_Biped2D_Gaps_Terrain-v0', task_kwargs={'randomize': 'robot'})

`VectorEnvironment` and Gymnasium environments take the same `task_kwargs`. `worlds` and `sensors`
have the options and the presets.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from trl_suite.tasks.disturbances.sensors import SensorConfig
from trl_suite.tasks.disturbances.task import Disturbed
from trl_suite.tasks.disturbances.worlds import WorldConfig
from trl_suite.tasks.task import Task

OPTIONS: Mapping[str, Any] = {'randomize': WorldConfig, 'sensors': SensorConfig}


def disturb(task: Task, options: Mapping[str, Any]) -> Task:
    """Returns a `Disturbed` task with these options; the task itself if there are none.

    Args:
      task: any task that no other environment uses.
      options: values of `OPTIONS`: None; the name of a preset; options by name, in which 'preset' may
        name a preset that the others change, None removing one; or a config.

    Raises:
      ValueError: unknown names, values out of range, or options that contradict each other or that
        the task cannot have.
    """
    configs = {
        name: OPTIONS[name].parse(name, value)
        for name, value in options.items()
        if value is not None and not (isinstance(value, Mapping) and not value)
    }
    if not configs:
        return task
    return Disturbed(task, configs.get('randomize'), configs.get('sensors'))
