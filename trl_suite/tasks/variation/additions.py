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

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from trl_suite.bodies.blocks import Block, by_name
from trl_suite.engine import World
from trl_suite.tasks.component import Component
from trl_suite.tasks.rewards import Outcome, outcome
from trl_suite.util.options import checked

if TYPE_CHECKING:
    from trl_suite.tasks.task import Task

Function = Callable[[Any], np.ndarray]
LARGEST = 1e30  # number that a custom function may return


class Additions(Component):
    """Additional reward terms, observation blocks and failures of a task.

    Each custom function is called with the task and returns an array with one row per simulation.
    It may read `task.world` (see `World`), `task.action` (n, k), the last action clipped to [-1, 1],
    and all attributes of the task, and call functions of `trl_suite.tasks.parts`. The row of a
    simulation must depend on this simulation only, in the same way for all, and not on random
    numbers.
    """

    in_parts = False  # custom functions compute the values of all simulations

    def __init__(
        self,
        rewards: Mapping[str, tuple[float, Function]],
        observations: Mapping[str, tuple[int, Function]],
        failures: Mapping[str, Function],
    ) -> None:
        """Keeps the functions.

        Args:
          rewards: name -> (weight, function); the function returns (n,). weight * value is added to
            the reward, except in steps in which the task fails.
          observations: name -> (size, function); the function returns (n, size), or (n,) if the
            size is 1. These blocks follow those of the task.
          failures: name -> function; it returns (n,) bool. Where True, the episode ends with
            discount 0.

        Raises:
          ValueError: an argument that is not a dict, an invalid weight or size, or an object that is
            not a function.
        """
        for kind, first, entries in (
            ('rewards', 'weight', rewards), ('observations', 'size', observations), ('failures', '', failures),
        ):  # fmt: skip
            if not isinstance(entries, Mapping):
                raise ValueError(f'{kind} is {entries!r}; expected a dict of name -> part')
            for name, entry in entries.items():
                checked(f'a name in {kind}', name, str)
                if first and not (isinstance(entry, tuple) and len(entry) == 2):
                    raise ValueError(f'{kind}[{name!r}] is {entry!r}; expected ({first}, function)')
        self._rewards, self._extras, self._failures = (
            dict(rewards),
            dict(observations),
            dict(failures),
        )
        for name, (weight, function) in self._rewards.items():
            checked(f'weight of reward {name!r}', weight, float)
            _check('reward', name, function)
        for name, (size, function) in self._extras.items():
            checked(f'size of observation {name!r}', size, int, at_least=1)
            _check('observation', name, function)
        for name, function in self._failures.items():
            _check('failure', name, function)
        self.blocks = tuple(Block(name, int(size)) for name, (size, _) in self._extras.items())

    def added_to(self, task: Task) -> None:
        super().added_to(task)
        for name in self._extras:
            if name in task.blocks:
                raise ValueError(f'the task already has a block {name!r}; choose another name')
        for name in self._rewards:
            if name in [term.name for term in getattr(task, 'terms', ())]:
                raise ValueError(
                    f'the task already has a reward term {name!r}; choose another name'
                )

    @property
    def made_of(self) -> dict[str, tuple[str, Any]]:
        added = self._rewards, self._extras, self._failures
        label = ', '.join(name for group in added for name in group)
        return {'additions': (label, added)}

    def bind(self, world: World, inner: Outcome) -> Outcome:
        n, task = world.n, self.task
        self._inner, self._own = inner, inner.observation.shape[1]
        terms = inner.reward_terms.shape[1]
        size = sum(block.size for block in self.blocks)
        own = outcome(n, self._own + size, terms + len(self._rewards))
        self._outcome = own._replace(fell=inner.fell, diverged=inner.diverged)
        self._terms = self._outcome.reward_terms[:, terms:]
        self.action = task.action = np.zeros((n, len(task.action_map)))
        self.saved = (by_name('Saved', {'action': self.action}), self._outcome)
        self.info_arrays = {'reward_terms': dict(zip(self._rewards, self._terms.T, strict=True))}
        if self.blocks:
            task.mirror = None  # unknown for the added blocks
        return self._outcome

    def before_physics(self, action: np.ndarray, env_ids: np.ndarray) -> None:
        self.action[env_ids] = np.clip(action[env_ids], -1.0, 1.0)

    def finish(self, env_ids: np.ndarray, fresh: bool) -> None:
        """Adds the custom reward terms, blocks and failures to the outcome of the task."""
        inner, out = self._inner, self._outcome
        if fresh:
            self.action[env_ids] = self._terms[env_ids] = 0.0
        out.observation[env_ids, : self._own] = inner.observation[env_ids]
        out.reward_terms[env_ids, : inner.reward_terms.shape[1]] = inner.reward_terms[env_ids]
        usable, column = env_ids[~out.diverged[env_ids]], self._own
        for name, (size, function) in self._extras.items():
            value = self._ask('observation', name, function, size)
            out.observation[usable, column : column + size] = value[usable]
            column += size
        out.reward[env_ids] = inner.reward[env_ids]
        out.failed[env_ids] = failed = inner.failed[env_ids]
        if fresh:
            return
        for k, (name, (weight, function)) in enumerate(self._rewards.items()):
            value = self._ask('reward', name, function, 1, weight)[env_ids, 0]
            self._terms[env_ids, k] = np.where(failed, 0.0, value)
            out.reward[env_ids] += self._terms[env_ids, k]
        for name, function in self._failures.items():
            failed = failed | (self._ask('failure', name, function, 1)[env_ids, 0] != 0)
        out.failed[env_ids] = failed

    def _ask(
        self, kind: str, name: str, function: Function, size: int, weight: float = 1.0
    ) -> np.ndarray:
        """Returns the checked value of a custom function, times a weight, (n, size).

        It must be finite, except in simulations that have diverged, where it becomes 0.
        """
        diverged = self._outcome.diverged
        with np.errstate(invalid='ignore' if diverged.any() else 'warn'):
            value = np.asarray(function(self.task), dtype=float)
        n = self.task.world.n
        if value.shape == (n,) and size == 1:
            value = value[:, None]
        if value.shape != (n, size):
            expected = f'({n},)' if kind != 'observation' else f'({n}, {size})'
            raise ValueError(f'{kind} {name!r} has shape {value.shape}; expected {expected}')
        with np.errstate(over='ignore'):
            value = weight * value
        finite = np.all(np.abs(value) <= LARGEST, axis=1)  # also as float32, and in sums
        if not finite.all():
            if not (finite | diverged).all():
                raise ValueError(
                    f'{kind} {name!r} is {value[~finite][0]}; expected finite numbers up to {LARGEST:g}'
                )
            value = np.where(finite[:, None], value, 0.0)
        return value


def _check(kind: str, name: str, function: Any) -> None:
    if not callable(function):
        raise ValueError(f'{kind} {name!r} is {function!r}; expected a function of the task')
