"""The simulations of a vector environment: starting episodes, seeds, saved states and copies."""

from __future__ import annotations

from typing import Any

import numpy as np

from trl_suite.engine import BatchWorld, light_model
from trl_suite.environments import states
from trl_suite.tasks.task import Task


class Simulations:
    """n simulations of a task, each with its random stream and its progress in an episode.

    Attributes:
      task: the task, bound to the world.
      world: the simulations of the physics.
      seeds: seed of each random stream, (n,) uint32.
      steps: control steps since the beginning of the episode, (n,).
      ended: whether the episode has ended, so that a reset is needed, (n,) bool.
      fresh: whether no simulation was ever reset.
      signature: of saved states, see `states`.
    """

    def __init__(self, task: Task, n: int, num_threads: int) -> None:
        """Compiles one model without visual assets and makes n simulations of it.

        Args:
          task: a task that no other environment uses.
          n: number of simulations.
          num_threads: threads that step the physics; 0 uses all cores.
        """
        model = light_model(task.root_entity.mjcf_model)
        self.task, self.world = task, BatchWorld(model, n, num_threads, task.fields)
        task.bind(self.world)
        self.signature = states.signature(task, 'vector environment')
        self.seeds = np.zeros(n, np.uint32)
        self.steps, self.ended, self.fresh = np.zeros(n, int), np.ones(n, bool), True
        self._random = [np.random.RandomState(0)] * n

    def seed(self, seeds: np.ndarray, env_ids: np.ndarray) -> None:
        """Reseeds the random streams of some simulations, from which resets draw.

        Args:
          seeds: seeds of all simulations, (n,).
          env_ids: numbers of those that are reseeded.
        """
        for env_id in env_ids.tolist():
            self.seeds[env_id] = seeds[env_id]
            self._random[env_id] = np.random.RandomState(int(seeds[env_id]))

    def begin(self, env_ids: np.ndarray) -> None:
        """Begins episodes in some simulations."""
        if not len(env_ids):
            return
        self.task.reset(env_ids, [self._random[env_id] for env_id in env_ids.tolist()])
        self.steps[env_ids] = 0
        self.ended[env_ids] = False

    def get_state(self, ids: list[int]) -> dict[str, Any]:
        """Returns the complete state of some simulations."""
        return states.seal({
            'made_for': dict(self.signature),
            'world': [self.world.get_state(env_id) for env_id in ids],
            'task': [self.task.get_state(env_id) for env_id in ids],
            'random': [self._random[env_id].get_state() for env_id in ids],
            'seeds': self.seeds[ids],
            'steps': self.steps[ids],
            'ended': self.ended[ids],
            'fresh': self.fresh,
        })  # fmt: skip

    def set_state(self, state: dict[str, Any], ids: list[int]) -> None:
        """Restores the state of some simulations, except `fresh`.

        Raises:
          TypeError, ValueError: see `VectorEnvironment.set_state`; nothing is changed.
        """
        states.check(state, self.signature)
        if len(state['world']) != len(ids):
            raise ValueError(
                f'the state has {len(state["world"])} simulations; expected {len(ids)}'
            )
        if len(set(ids)) != len(ids):
            raise ValueError(f'simulations {ids}; expected each of {len(ids)} simulations once')
        for i, env_id in enumerate(ids):
            self.task.set_state(env_id, state['task'][i])
            self.world.set_state(env_id, state['world'][i])
            self._random[env_id].set_state(state['random'][i])
        self.seeds[ids] = state['seeds']
        self.steps[ids], self.ended[ids] = state['steps'], state['ended']

    def copy_from(self, other: Simulations, other_ids: list[int], ids: list[int]) -> None:
        """Copies simulations of the same task, without their random streams and seeds.

        Args:
          other: the other simulations, or these.
          other_ids: numbers of those to copy, as they are before the call.
          ids: numbers of as many of these simulations.
        """
        # All are read before the first is written, since the simulations may be the same.
        found = [(other.task.get_state(i), other.world.get_state(i)) for i in other_ids]
        for env_id, (task, world) in zip(ids, found, strict=True):
            self.task.set_state(env_id, task)
            self.world.set_state(env_id, world)
        self.steps[ids], self.ended[ids] = other.steps[other_ids], other.ended[other_ids]
