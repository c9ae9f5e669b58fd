"""Tasks whose rules are NumPy over all simulations: what is not compiled yet."""

from __future__ import annotations

import abc
from collections.abc import Sequence
from typing import Any

import numpy as np
from dm_control import mjcf

from trl_suite.tasks.task import Task


class BatchTask(Task):
    """A task that handles all rows at once, with masks for those that step."""

    observation: Any = None
    reward: Any = None
    failed: Any = None
    diverged: Any = None
    reward_terms: Any = None

    @abc.abstractmethod
    def begin_episodes(
        self, rows: np.ndarray, random_states: Sequence[np.random.RandomState]
    ) -> None: ...

    @abc.abstractmethod
    def act(self, action: np.ndarray) -> None: ...

    @abc.abstractmethod
    def finish_step(self, stepped: np.ndarray | None = None) -> None: ...

    @abc.abstractmethod
    def observe(self, env_ids: np.ndarray | None = None) -> None: ...

    @abc.abstractmethod
    def infos(self) -> dict[str, Any]: ...

    def info(self) -> dict[str, Any]:
        return self.infos()

    def info_of(self, env_id: int) -> dict[str, Any]:
        def one(value: Any) -> Any:
            if isinstance(value, dict):
                return {name: one(part) for name, part in value.items()}
            return value[env_id].item()

        return one(self.infos())

    def simulate(self, rows: np.ndarray | None = None) -> None:
        ids = self.world.all_ids if rows is None else rows
        self.world.share(lambda part: self.world.step(self._substeps, part), ids)

    def reset(self, env_ids: np.ndarray, random_states: Sequence[np.random.RandomState]) -> None:
        self.begin_episodes(env_ids, random_states)
        self.observe()

    def apply_action(self, action: np.ndarray, env_ids: np.ndarray) -> None:
        self.act(action)

    def step(self, action: np.ndarray, env_ids: np.ndarray) -> None:
        stepped = None
        if len(env_ids) < self.world.n:
            stepped = np.zeros(self.world.n, bool)
            stepped[env_ids] = True
        self.act(action)
        self.simulate(None if stepped is None else env_ids)
        self.finish_step(stepped)
        if stepped is not None:
            self.reward[~stepped] = 0.0
            self.failed[~stepped] = self.diverged[~stepped] = False

    def after_step(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        self.finish_step()
