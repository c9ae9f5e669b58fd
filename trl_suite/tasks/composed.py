"""Adds custom reward terms, observation blocks and failures to a task.

    def low(task):
        return (parts.height(task) < 0.7).astype(float)

    environment = suite.make('PD_Biped2D_Gaps_Terrain-v0', task_kwargs={
        'rewards': {'fast': (0.1, parts.speed)},
        'observations': {'low': (1, low)},
    })

`VectorEnvironment` and Gymnasium environments take the same `task_kwargs`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from dm_control import mjcf

from trl_suite.engine import World
from trl_suite.kinematics.blocks import Block, layout
from trl_suite.tasks.task import Task, outcome
from trl_suite.tasks.wrapper import Wrapper
from trl_suite.util import errors

Function = Callable[[Any], np.ndarray]
OPTIONS = ('rewards', 'observations', 'failures')


class Composed(Wrapper):
    """Another task with additional reward terms, observation blocks and failures.

    Each custom function is called with this task and returns an array with one row per simulation.
    It may read `task.world` (see `World`), `task.action` (n, k), clipped to [-1, 1], and all
    attributes of the other task, and call functions of `trl_suite.tasks.parts`. The row of a
    simulation must depend on this simulation only, in the same way for all, and not on random
    numbers.

    Attributes:
      task: the other task.
      action: the last action, (n, k); 0 at the start of an episode.
    """

    def __init__(
        self,
        task: Task,
        *,
        rewards: Mapping[str, tuple[float, Function]] | None = None,
        observations: Mapping[str, tuple[int, Function]] | None = None,
        failures: Mapping[str, Function] | None = None,
    ) -> None:
        """Composes the task.

        Args:
          task: any task that no other environment uses.
          rewards: name -> (weight, function); the function returns (n,). weight * value is added to
            the reward, except in steps in which the other task fails.
          observations: name -> (size, function); the function returns (n, size), or (n,) if the
            size is 1. These blocks follow those of the other task.
          failures: name -> function; it returns (n,) bool. Where True, the episode ends with
            discount 0.

        Raises:
          ValueError: a name that is in use, an invalid weight or size, or an object that is not a
            function.
        """
        super().__init__(task)
        self.in_parts = False  # custom functions compute the values of all simulations
        self._rewards, self._extras = dict(rewards or {}), dict(observations or {})
        self._failures = dict(failures or {})
        for name, (weight, function) in self._rewards.items():
            _check('reward', name, function, np.isfinite(weight), f'weight {weight!r}')
        for name, (size, function) in self._extras.items():
            whole = isinstance(size, (int, np.integer)) and size > 0
            _check('observation', name, function, whole, f'size {size!r}')
            if name in task.blocks:
                raise ValueError(f'the task already has a block {name!r}; choose another name')
        for name, function in self._failures.items():
            _check('failure', name, function, True, '')
        added = (Block(name, int(size)) for name, (size, _) in self._extras.items())
        self._own = sum(block.size for block in task.observed)
        self.observed = *task.observed, *added
        self.blocks = layout(self.observed)
        self.mirror = None  # unknown for the added blocks

    @property
    def made_of(self) -> dict[str, tuple[str, Any]]:
        added = self._rewards, self._extras, self._failures
        label = ', '.join(name for group in added for name in group)
        return {**self.task.made_of, 'additions': (label, added)}

    def bind(self, world: World) -> None:
        self.task.bind(world)
        self.world, n = world, world.n
        self.outcome = outcome(n, sum(block.size for block in self.observed))
        self.action = np.zeros((n, len(self.action_map)))
        self._terms = np.zeros((len(self._rewards), n))

    def reset(self, env_ids: np.ndarray, random_states: Sequence[np.random.RandomState]) -> None:
        self.task.reset(env_ids, random_states)
        self.action[env_ids] = self.reward[env_ids] = 0.0
        self._terms[:, env_ids] = 0.0
        self.failed[env_ids] = self.diverged[env_ids] = False
        self._write(env_ids)

    def step(self, action: np.ndarray, env_ids: np.ndarray) -> None:
        self.action[env_ids] = np.clip(action[env_ids], -1.0, 1.0)
        self.world.share(lambda part: self.task.step(action, part), env_ids)
        self._finish(env_ids)

    # A plain composer.Environment calls these instead of `step`.

    def apply_action(self, action: np.ndarray, env_ids: np.ndarray) -> None:
        self.action[env_ids] = np.clip(action[env_ids], -1.0, 1.0)
        self.task.apply_action(action, env_ids)

    def finish_step(self, env_ids: np.ndarray) -> None:
        self.task.finish_step(env_ids)
        self._finish(env_ids)

    def after_step(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        self.task.after_step(physics, random_state)
        self._finish(self.world.all_ids)

    def _finish(self, env_ids: np.ndarray) -> None:
        """Adds the custom reward terms and failures to the outcome of the other task."""
        inner = self.task
        self.diverged[env_ids] = inner.diverged[env_ids]
        self._write(env_ids)
        self.reward[env_ids] = inner.reward[env_ids]
        failed = inner.failed[env_ids]
        for term, (name, (weight, function)) in zip(
            self._terms, self._rewards.items(), strict=True
        ):
            value = self._ask('reward', name, function, 1)[env_ids, 0]
            term[env_ids] = np.where(failed, 0.0, weight * value)
            self.reward[env_ids] += term[env_ids]
        for name, function in self._failures.items():
            failed = failed | (self._ask('failure', name, function, 1)[env_ids, 0] != 0)
        self.failed[env_ids] = failed

    def observe(self, env_ids: np.ndarray | None = None) -> None:
        self.task.observe(env_ids)
        self._write(self.world.all_ids if env_ids is None else env_ids)

    def _write(self, env_ids: np.ndarray) -> None:
        self.observation[env_ids, : self._own] = self.task.observation[env_ids]
        usable = env_ids[~self.diverged[env_ids]]
        for name, (size, function) in self._extras.items():
            value = self._ask('observation', name, function, size)
            self.observation[usable, self.blocks[name]] = value[usable]

    def _ask(self, kind: str, name: str, function: Function, size: int) -> np.ndarray:
        """Returns the checked value of a custom function, (n, size).

        It must be finite, except in simulations that have diverged, where it becomes 0.
        """
        with np.errstate(invalid='ignore' if self.diverged.any() else 'warn'):
            value = np.asarray(function(self), dtype=float)
        n = self.world.n
        if value.shape == (n,) and size == 1:
            value = value[:, None]
        if value.shape != (n, size):
            expected = f'({n},)' if kind != 'observation' else f'({n}, {size})'
            raise ValueError(f'{kind} {name!r} has shape {value.shape}; expected {expected}')
        finite = np.isfinite(value).all(1)
        if not finite.all():
            if not (finite | self.diverged).all():
                raise ValueError(f'{kind} {name!r} is not finite: {value[~finite][0]}')
            value = np.where(finite[:, None], value, 0.0)
        return value

    def info(self) -> dict[str, Any]:
        """Returns the info of the other task, with the custom reward terms added."""
        return self._added(self.task.info(), lambda term: term.copy())

    def info_of(self, env_id: int) -> dict[str, Any]:
        """Returns `info` for one simulation, as numbers."""
        return self._added(self.task.info_of(env_id), lambda term: term.item(env_id))

    def _added(self, found: dict[str, Any], read: Callable[[np.ndarray], Any]) -> dict[str, Any]:
        terms = {name: read(term) for name, term in zip(self._rewards, self._terms, strict=True)}
        return {**found, 'reward_terms': {**found.get('reward_terms', {}), **terms}}

    def get_state(self, env_id: int) -> dict[str, Any]:
        arrays = [self.action, self._terms.T, *self.outcome]
        return {
            'task': self.task.get_state(env_id),
            'arrays': [array[env_id].copy() for array in arrays],
        }

    def set_state(self, env_id: int, state: dict[str, Any]) -> None:
        self.task.set_state(env_id, state['task'])
        arrays = [self.action, self._terms.T, *self.outcome]
        for array, value in zip(arrays, state['arrays'], strict=True):
            array[env_id] = value


def compose(task: Task, parts: Mapping[str, Any]) -> Task:
    """Returns a `Composed` task with these keyword arguments; the task itself if they are empty.

    Raises:
      ValueError: an unknown keyword, a value that is not a dict by name, or see `Composed`.
    """
    for kind, entries in parts.items():
        if kind not in OPTIONS:
            raise ValueError(errors.unknown('kind of parts', kind, OPTIONS))
        if not isinstance(entries, Mapping):
            raise ValueError(f'{kind} is {entries!r}; expected a dict of name -> part')
        for name, entry in entries.items():
            if kind != 'failures' and not (isinstance(entry, tuple) and len(entry) == 2):
                first = 'weight' if kind == 'rewards' else 'size'
                raise ValueError(f'{kind}[{name!r}] is {entry!r}; expected ({first}, function)')
    return Composed(task, **parts) if any(parts.values()) else task


def _check(kind: str, name: str, function: Any, good: Any, number: str) -> None:
    if not callable(function):
        raise ValueError(f'{kind} {name!r} is {function!r}; expected a function of the task')
    if not good:
        raise ValueError(
            f'{kind} {name!r} has {number}; expected a finite weight, or a positive integer size'
        )
