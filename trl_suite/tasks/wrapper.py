"""The base class of tasks that change another task: its actuators, its world, its reward."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from dm_control import composer

from trl_suite.tasks.task import Task


class Wrapper(Task):
    """Another task, whose methods and attributes are those of the wrapper unless it has its own.

    Attributes:
      task: the other task.
    """

    task: Task

    def __init__(self, task: Task) -> None:
        """Wraps a task that no other environment uses."""
        self.task = task
        self.set_timesteps(task.control_timestep, task.physics_timestep)
        self.fields, self.action_map, self.observed = task.fields, task.action_map, task.observed
        self.blocks, self.terms = task.blocks, task.terms
        self.in_parts = task.in_parts

    def __getattr__(self, name: str) -> Any:
        if name == 'task' or name.startswith('__'):  # `task` is not set yet while a copy is made
            raise AttributeError(name)
        return getattr(self.task, name)

    @property
    def watch(self) -> Any:
        """Callback within steps of variable duration of the other task; for rendering."""
        return self.task.watch  # type: ignore[attr-defined]

    @watch.setter
    def watch(self, look: Callable[[], None] | None) -> None:
        self.task.watch = look  # type: ignore[attr-defined]

    @property
    def made_of(self) -> dict[str, tuple[str, Any]]:
        return self.task.made_of

    @property
    def root_entity(self) -> composer.Entity:
        return self.task.root_entity

    @property
    def steps_per_call(self) -> int:
        return self.task.steps_per_call

    def step(self, action: np.ndarray, env_ids: np.ndarray) -> None:
        self.task.step(action, env_ids)

    def apply_action(self, action: np.ndarray, env_ids: np.ndarray) -> None:
        self.task.apply_action(action, env_ids)

    def simulate(self, env_ids: np.ndarray) -> None:
        self.task.simulate(env_ids)

    def finish_step(self, env_ids: np.ndarray) -> None:
        self.task.finish_step(env_ids)

    def observe(self, env_ids: np.ndarray | None = None) -> None:
        self.task.observe(env_ids)


def unwrapped(task: Any) -> Any:
    """Returns the innermost task."""
    while isinstance(task, Wrapper):
        task = task.task
    return task
