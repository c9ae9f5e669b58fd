"""n >= 1 simulations of a task: episodes, limits, random streams, saved states.

`trl_suite.environments.environment.Environment` shows one as time steps of dm_env, and
`trl_suite.environments.vector.VectorEnvironment` many as arrays.
"""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Callable
from typing import Any

import numpy as np

from trl_suite.environments import arguments, states
from trl_suite.environments.arguments import Ids
from trl_suite.tasks.task import Task

TIME_ERROR = 1e-6  # s; more than the error of a sum of physics steps, less than one of them


class Core:
    """n simulations, each with its random stream and its progress in an episode.

    `with core:` encloses their use. It raises a RuntimeError after `close`, in a forked process that
    lacks the threads, and while another thread is inside, since two threads that step the same
    simulation would crash the process; the same thread may enter again.

    Attributes:
      task: the task, bound to the simulations.
      world: the simulations of the physics.
      random: random stream of each simulation, from which resets draw.
      seeds: seeds of the random streams, (n,) uint32; 0 if they are not known.
      steps: steps since the beginning of the episode, (n,).
      ended: whether the episode has ended, so that a reset is needed, (n,) bool.
      fresh: whether no simulation was ever reset.
      signature: of saved states, see `states`.
    """

    def __init__(
        self, task: Task, kind: str, random: list[np.random.RandomState], threads: bool = False
    ) -> None:
        """Begins before the first reset.

        Args:
          task: the task, bound to n simulations.
          kind: of the environment; saved states of one kind are refused by others.
          random: random stream of each simulation.
          threads: whether the simulations have threads, which a forked process lacks.
        """
        n = task.world.n
        self.task, self.world, self.random = task, task.world, random
        self.seeds, self.steps = np.zeros(n, np.uint32), np.zeros(n, int)
        self.ended, self.fresh = np.ones(n, bool), True
        self.signature = states.signature(task, kind)
        self._lock, self._closed = threading.RLock(), False
        self._pid = os.getpid() if threads else None

    def __enter__(self) -> Core:
        if not self._lock.acquire(blocking=False):
            raise RuntimeError(
                'another thread is using the environment; make one environment for each thread'
            )
        if self._closed or self._pid is not None:
            try:
                self.usable()
            except RuntimeError:
                self._lock.release()
                raise
        return self

    def __exit__(self, *error: object) -> None:
        self._lock.release()

    def usable(self) -> Core:
        """Returns these simulations.

        Raises:
          RuntimeError: after `close`, or in a forked process.
        """
        if self._closed:
            raise RuntimeError('the environment is closed')
        if self._pid is not None and self._pid != os.getpid():
            raise RuntimeError(
                'a vector environment cannot be used after a fork: the child has no copy of its '
                "threads. Make it in the child, or use multiprocessing's start method 'spawn'"
            )
        return self

    def close(self) -> bool:
        """Lets the simulations go; returns whether they were there, and usable in this process."""
        if self._closed or self._pid not in (None, os.getpid()):
            return False
        with self:
            self.world.close()
            self._closed = True
            del self.task, self.world  # whose arrays would keep models and data in memory
        return True

    def share(self, work: Callable[[np.ndarray], None], ids: np.ndarray) -> None:
        """Calls `work` on the threads, each time for a part of some simulations."""
        if self.task.in_parts:
            self.world.share(work, ids)
        else:
            work(ids)

    def begin(self, ids: np.ndarray) -> None:
        """Begins episodes in some simulations of a vector environment."""
        if len(ids):
            self.ended[ids] = True  # until the reset has succeeded
            self.task.begin(ids, [self.random[env_id] for env_id in ids.tolist()])
            self.restart(ids)

    def restart(self, ids: Any) -> None:
        """Notes that an episode begins in some simulations; `ids` is an index, or several."""
        self.steps[ids], self.ended[ids], self.fresh = 0, False, False

    def count(self, ids: Any, step_limit: int | None, time_limit: float) -> Any:
        """Counts a step of some simulations; ends episodes that failed or reached a limit.

        Args:
          ids: index of a simulation, or indices of several.
          step_limit: in steps; None for no limit.
          time_limit: in s.

        Returns:
          Whether they reached a limit, also if they failed.
        """
        self.steps[ids] += 1
        at_limit = self.at_limit(ids, step_limit, time_limit)
        self.ended[ids] = at_limit | self.task.seen.failed[ids]
        return at_limit

    def at_limit(self, ids: Any, step_limit: int | None, time_limit: float) -> Any:
        """Returns whether some simulations are at a limit; arguments are those of `count`."""
        # NumPy's False: an operation of a NumPy bool with Python's takes half a microsecond.
        at_limit = np.False_ if step_limit is None else self.steps[ids] >= step_limit
        if time_limit < math.inf:
            at_limit = at_limit | (self.world.time[ids] >= time_limit - TIME_ERROR)
        return at_limit

    def read(self, ids: list[int]) -> dict[str, Any]:
        """Returns a copy of the state of some simulations, without their random streams."""
        return {
            'world': [self.world.get_state(env_id) for env_id in ids],
            'task': [self.task.get_whole_state(env_id) for env_id in ids],
            'steps': self.steps[ids],
            'ended': self.ended[ids],
        }

    def write(self, state: dict[str, Any], ids: list[int]) -> None:
        """Restores what `read` returned, in as many simulations."""
        for env_id, task, world in zip(ids, state['task'], state['world'], strict=True):
            self.task.set_whole_state(env_id, task)
            self.world.set_state(env_id, world)
        self.steps[ids], self.ended[ids] = state['steps'], state['ended']

    def get_state(self, env_ids: Ids = None) -> dict[str, Any]:
        """Returns the complete state of some simulations, or of all; see the environments."""
        with self:
            ids = arguments.given_ids(env_ids, len(self.ended))
            return states.seal({
                'made_for': dict(self.signature),
                **self.read(ids),
                'random': [self.random[env_id].get_state() for env_id in ids],
                'seeds': self.seeds[ids],
                'fresh': self.fresh,
            })  # fmt: skip

    def set_state(self, state: dict[str, Any], env_ids: Ids = None) -> None:
        """Restores a state in some simulations, or in all; see the environments."""
        with self:
            if env_ids is not None and self.fresh:
                raise RuntimeError('set_state of some simulations before the first reset')
            ids = arguments.given_ids(env_ids, len(self.ended))
            states.check(state, self.signature)
            if len(state['world']) != len(ids):
                raise ValueError(
                    f'the state has {len(state["world"])} simulations; expected {len(ids)}'
                )
            if len(set(ids)) != len(ids):
                raise ValueError(f'simulations {ids}; expected each of {len(ids)} simulations once')
            self.write(state, ids)
            for env_id, random in zip(ids, state['random'], strict=True):
                self.random[env_id].set_state(random)
            self.seeds[ids] = state['seeds']
            if env_ids is None:
                self.fresh = state['fresh']
