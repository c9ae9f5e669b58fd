"""Components: what changes a task from outside, such as motors, worlds, sensors, and users' terms."""

from __future__ import annotations

import hashlib
import weakref
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from trl_suite.bodies.blocks import Block
from trl_suite.engine import World

if TYPE_CHECKING:
    from trl_suite.tasks.rewards import Outcome
    from trl_suite.tasks.task import Marker, Task


# Spawn keys of the streams of components.
WORLD, PUSH, SENSORS, MOTORS, LEVELS = range(5)


class Component:
    """A part that is added to a task by `Task.add`.

    Its hooks are called for some of the simulations at a time, on several threads unless
    `in_parts` is False: `begin` before the task's reset, `before_physics` before its step, and
    `finish` after both.

    Attributes:
      blocks: observation blocks that follow those of the task.
      saved: state: tuples of arrays (n, ...).
      info_arrays: further results, see `Task.info_arrays`.
      by_engine: what needs the engine's physics steps, so that a plain composer.Environment cannot run
        the task.
      in_parts: whether several threads may call the hooks, each for some simulations.
    """

    blocks: tuple[Block, ...] = ()
    saved: tuple[NamedTuple, ...] = ()
    by_engine = ''
    in_parts = True

    def added_to(self, task: Task) -> None:
        """Keeps the task. A subclass may raise a ValueError if it does not fit."""
        self._task = weakref.ref(task)  # a cycle would keep closed simulations in memory

    @property
    def task(self) -> Any:
        """The task, after `added_to`."""
        return self._task()

    @property
    def made_of(self) -> dict[str, tuple[str, Any]]:
        """What the component is made of; see `Task.made_of`."""
        return {}

    def prepare(self, world: World) -> None:
        """Changes the engine of a world, before the task is bound to it."""

    def bind(self, world: World, outcome: Outcome) -> Outcome:
        """Resolves ids, and allocates arrays, after the task was bound.

        Args:
          world: the simulations.
          outcome: of the task and of the components before this one.

        Returns:
          The outcome after this component; by default the same.
        """
        self.info_arrays: dict[str, Any] = {}
        return outcome

    def begin(self, env_id: int, seed: np.random.SeedSequence) -> None:
        """Draws what varies between episodes of a simulation.

        All components get the same seed; they derive their own with different spawn keys.
        """

    def before_physics(self, action: np.ndarray, env_ids: np.ndarray) -> None:
        """Prepares a step of some simulations; `action` is that of all, (n, k)."""

    def finish(self, env_ids: np.ndarray, fresh: bool) -> None:
        """Writes the outcome of some simulations; if `fresh`, their episodes have just begun."""

    def restored(self, env_id: int) -> None:
        """Called after `saved` was restored in a simulation."""

    def markers(self, env_id: int) -> list[Marker]:
        """Returns markers for rendered images of a simulation."""
        return []


def seed_of(random_state: np.random.RandomState) -> np.random.SeedSequence:
    """Returns a seed from a random state, without drawing from it.

    So a task draws the same terrain and start with components as without.
    """
    state: Any = random_state.get_state()
    _, keys, position, has_gauss, gauss = state
    digest = hashlib.blake2b(keys.tobytes(), digest_size=16)
    digest.update(f'{position} {has_gauss} {gauss!r}'.encode())
    return np.random.SeedSequence(int.from_bytes(digest.digest(), 'little'))


def position(random_state: np.random.RandomState) -> tuple[Any, ...]:
    """Returns what changes in a random state whenever a number is drawn."""
    state: Any = random_state.get_state()
    _, keys, *rest = state
    return int(keys[0]), *rest


def spawned(seed: np.random.SeedSequence, key: int) -> np.random.SeedSequence:
    """Returns the seed of one stream of a component; keys differ between all streams."""
    return np.random.SeedSequence(seed.entropy, spawn_key=(key,))
