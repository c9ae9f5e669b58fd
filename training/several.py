"""Simulations of several environments, or with several options, that are stepped together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from trl_suite.vector import Step, VectorEnvironment

LANDING_ERRORS = 'landing_error', 'heading_error'  # keys of `info` in footstep tracking
INFO = 'landed', *LANDING_ERRORS, 'distance'  # what `info` has besides the terms of the reward


class Several:
    """Simulations of several vector environments, numbered one after the other.

    Attributes:
      parts: the vector environments.
      group: which of them each simulation belongs to, (n,) int.
    """

    def __init__(self, parts: Sequence[VectorEnvironment]) -> None:
        self.parts, first = list(parts), parts[0]
        counts = [part.num_envs for part in parts]
        self.num_envs, self.group = sum(counts), np.repeat(np.arange(len(parts)), counts)
        self._place = np.concatenate([np.arange(count) for count in counts])
        self.spec, self.task, self.blocks = first.spec, first.task, first.blocks
        self.action_map, self.control_timestep = first.action_map, first.control_timestep

    @property
    def observation(self) -> np.ndarray:
        """Observations of all simulations, (n, size)."""
        return np.concatenate([part.task.observation for part in self.parts])

    def split(self, rows: np.ndarray) -> list[np.ndarray]:
        """Splits an array (n, ...) into those of the parts."""
        return np.split(rows, np.cumsum([part.num_envs for part in self.parts])[:-1])

    def reset(self, mask: np.ndarray | None = None) -> np.ndarray:
        masks = self.split(np.ones(self.num_envs, bool) if mask is None else mask)
        return np.concatenate([part.reset(m) for part, m in zip(self.parts, masks, strict=True)])

    def step(self, action: np.ndarray) -> Step:
        steps = [part.step(a) for part, a in zip(self.parts, self.split(action), strict=True)]
        *joined, infos = zip(*steps, strict=True)
        info: dict[str, Any] = {
            name: np.concatenate([each[name] for each in infos])
            for name in INFO
            if name in infos[0]
        }
        info['reward_terms'] = {
            name: np.concatenate([each['reward_terms'][name] for each in infos])
            for name in infos[0]['reward_terms']
        }
        return Step(*(np.concatenate(each) for each in joined), info)

    def get_state(self, env_id: int | None = None) -> Any:
        """Returns the complete state of all simulations, or of one."""
        if env_id is None:
            return {'parts': [part.get_state() for part in self.parts]}
        return self.parts[self.group[env_id]].get_state([self._place[env_id]])

    def set_state(self, state: Any, env_id: int | None = None) -> None:
        """Restores a state from `get_state`."""
        if env_id is not None:
            self.parts[self.group[env_id]].set_state(state, [self._place[env_id]])
            return
        for part, saved in zip(self.parts, state['parts'], strict=True):
            part.set_state(saved)

    def close(self) -> None:
        for part in self.parts:
            part.close()
