"""Levels: a limited number of terrains, which episodes draw or users choose."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from trl_suite.engine import World
from trl_suite.tasks.component import LEVELS, Component, spawned
from trl_suite.tasks.rewards import Outcome
from trl_suite.tasks.task import Task
from trl_suite.util.options import checked

MOST = 2**32  # levels are below


class LevelState(NamedTuple):
    """Levels of n simulations.

    Attributes:
      level: of the episode, (n,) int64.
      chosen: of the next episode, if a user has chosen it, or -1, (n,).
    """

    level: np.ndarray
    chosen: np.ndarray


def check(levels: Sequence[int] | None) -> None:
    """Checks the option.

    Raises:
      ValueError: it is not the first level and the number of levels, at least 1, all below `MOST`.
    """
    if levels is not None and not (len(levels) == 2 and levels[1] >= 1 and sum(levels) <= MOST):
        raise ValueError(
            f'levels is {levels}; expected the first level, at least 0, and the number of levels, '
            f'at least 1, with all levels below {MOST}'
        )


class Levels(Component):
    """A level is the seed of an episode's terrain; everything else is drawn as without levels."""

    def __init__(self, levels: Sequence[int]) -> None:
        self.first, self.count = levels

    @property
    def made_of(self) -> dict[str, tuple[str, Any]]:
        return {'levels': (f'{self.count} from {self.first}', (self.first, self.count))}

    def added_to(self, task: Task) -> None:
        super().added_to(task)
        task.levels = self

    def bind(self, world: World, outcome: Outcome) -> Outcome:
        self.state = LevelState(np.full(world.n, self.first), np.full(world.n, -1))
        self.saved = (self.state,)
        super().bind(world, outcome)
        self.info_arrays = {'level': self.state.level}
        return outcome

    def begin(self, env_id: int, seed: np.random.SeedSequence) -> None:
        level, chosen = self.state
        drawn = np.random.default_rng(spawned(seed, LEVELS)).integers(self.count)
        level[env_id] = self.first + drawn if chosen[env_id] < 0 else chosen[env_id]
        chosen[env_id] = -1

    def choose(self, env_ids: Any, level: int | Sequence[int]) -> None:
        """Sets the level of the next episode of some simulations: one for all, or one for each.

        Raises:
          ValueError: a level that is not among those of the environment, or simulations that it
            does not have.
        """
        ids, n = np.asarray(env_ids), len(self.state.chosen)
        if ids.dtype.kind not in 'iu' or ((ids < 0) | (ids >= n)).any():
            raise ValueError(f'env_ids is {env_ids!r}; expected whole numbers from 0 to {n - 1}')
        last = self.first + self.count - 1
        kind = Sequence[int] if np.ndim(level) else int
        given = np.asarray(checked('level', level, kind, at_least=self.first, at_most=last))
        if given.ndim and given.shape != ids.shape:
            raise ValueError(f'{len(given)} levels for {ids.size} simulations')
        self.state.chosen[ids] = given
