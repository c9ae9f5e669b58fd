"""Drives the joints of a task by imperfect motors: the option `actuators` of every task."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import numpy as np
from dm_control import mjcf

from trl_suite.actuation import realism, series
from trl_suite.actuation.realism import Actuators
from trl_suite.characters import Character
from trl_suite.engine import World
from trl_suite.tasks.task import Task
from trl_suite.tasks.wrapper import Wrapper
from trl_suite.util import random

_STREAM = 29  # distinguishes the draws of actuators from other draws with the same seed


class Actuated(Wrapper):
    """Another task, whose joints are driven by the motors that `Actuators` describes.

    `info` has 'delay' (ms) and 'strength_NAME' of each joint or muscle, if they are options.

    What changes between episodes is drawn from the episode's random state without advancing it, so
    that terrain and initial states are those of the task without this option.

    Attributes:
      task: the other task.
      actuators: the options.
    """

    def __init__(self, task: Task, actuators: Actuators, character: Character) -> None:
        """Wraps a task.

        Args:
          task: a task that no other environment uses.
          actuators: the options.
          character: the character whose joints are driven; it has its actuators.
        """
        self.actuators, self._character = actuators, character
        self._curves = realism.curves_of(actuators, character)
        if actuators.backlash or actuators.flex:
            series.finish(character, task.physics_timestep)
        super().__init__(task)

    @property
    def made_of(self) -> dict[str, tuple[str, Any]]:
        return {**self.task.made_of, 'actuators': (str(self.actuators.changed), self.actuators)}

    def bind(self, world: World) -> None:
        self.world = world
        model, actuators = world.models[0], self.actuators
        units = realism.Units(self._character, model)
        self._timestep = world.engine.timestep
        longest = self._steps(actuators.delay.high)
        slots = longest // self.steps_per_call + 2 if longest else 0
        self.motors = world.set_motors(
            realism.limits(actuators, units, model, self._curves),
            realism.noise(actuators, units, self._timestep),
            len(units.names),
            slots,
        )
        self._streams = random.Streams(0)
        self._streams.state = self.motors.stream
        self._strength = realism.Strength(actuators, units, world)
        self._delay = np.zeros(world.n)
        self.info_arrays = {}
        if 'strength' in actuators.changed:
            for name, strength in zip(units.names, self.motors.strength.T, strict=True):
                self.info_arrays[f'strength_{name}'] = strength
        if longest:
            self.info_arrays['delay'] = self._delay
        self.task.bind(world)  # afterwards, since it keeps the engine
        for env_id in world.all_ids.tolist():
            self._strength.apply(env_id, self.motors.strength[env_id])

    def _steps(self, delay: float) -> int:
        """Returns a delay in ms as physics steps."""
        return round(delay / 1000 / self._timestep)

    def reset(self, env_ids: np.ndarray, random_states: Sequence[np.random.RandomState]) -> None:
        entropies = [_entropy(each) for each in random_states]
        self.task.reset(env_ids, random_states)
        for env_id, entropy, each in zip(env_ids.tolist(), entropies, random_states, strict=True):
            if _entropy(each) == entropy:
                each.random_sample()  # the task drew nothing: the next episode differs all the same
            self._draw(env_id, np.random.SeedSequence(entropy, spawn_key=(_STREAM,)))

    def _draw(self, env_id: int, seed: np.random.SeedSequence) -> None:
        """Draws strengths, delay and noise at the start of an episode."""
        state, rng = self.motors, np.random.default_rng(seed)
        state.age[env_id] = state.given[env_id] = state.used[env_id] = 0
        state.strength[env_id] = rng.uniform(*self.actuators.strength, state.strength.shape[1])
        self._strength.apply(env_id, state.strength[env_id])
        state.lag[env_id] = self._steps(rng.uniform(*self.actuators.delay))
        self._delay[env_id] = 1000 * self._timestep * state.lag[env_id]
        state.noise[env_id] = rng.standard_normal(state.noise.shape[1])
        self._streams.seed(env_id, seed.spawn(1)[0])

    def apply_action(self, action: np.ndarray, env_ids: np.ndarray) -> None:
        self._age = self.motors.age[0]
        self.task.apply_action(action, env_ids)

    def after_step(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        if self.motors.age[0] == self._age:
            raise RuntimeError(
                'the motors of this task are updated before every physics step: use '
                'trl_suite.environments.environment.Environment, not a plain composer.Environment'
            )
        self.task.after_step(physics, random_state)

    # Results and state.

    def info(self) -> dict[str, Any]:
        return {**self.task.info(), **super().info()}

    def info_of(self, env_id: int) -> dict[str, Any]:
        return {**self.task.info_of(env_id), **super().info_of(env_id)}

    def get_state(self, env_id: int) -> dict[str, Any]:
        return {
            'task': self.task.get_state(env_id),
            'motors': [array[env_id].copy() for array in self.motors],
        }

    def set_state(self, env_id: int, state: dict[str, Any]) -> None:
        self.task.set_state(env_id, state['task'])
        for array, value in zip(self.motors, state['motors'], strict=True):
            array[env_id] = value
        self._delay[env_id] = 1000 * self._timestep * self.motors.lag[env_id]
        self._strength.apply(env_id, self.motors.strength[env_id])


def _entropy(random_state: np.random.RandomState) -> list[int]:
    """Returns the next random numbers without drawing them."""
    return copy.deepcopy(random_state).randint(0, 2**32, size=4, dtype=np.uint32).tolist()


def actuate(task: Task, actuators: Actuators, character: Character) -> Task:
    """Returns the task with other actuators; the task itself if they are ideal.

    Args:
      task: the task.
      actuators: the options.
      character: the character whose joints are driven, made from what `realism.body` returns.

    Raises:
      ValueError: an option that does not suit the character.
    """
    return Actuated(task, actuators, character) if actuators.changed else task
