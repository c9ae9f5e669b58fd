"""Simulations of several environments, or with several options, that are stepped together."""

from __future__ import annotations

from typing import Any

import numpy as np

from trl_suite.vector import Step, VectorEnvironment

LANDING_ERRORS = 'landing_error', 'heading_error'  # keys of `info` in footstep tracking


class Several:
    """Simulations of several environments, with the parts of the interface that PPO uses.

    Attributes:
      parts: one vector environment for each; their simulations are concatenated.
    """

    def __init__(self, parts: list[VectorEnvironment]) -> None:
        self.parts, first = parts, parts[0]
        self.num_envs = sum(part.num_envs for part in parts)
        self.spec, self.task, self.blocks = first.spec, first.task, first.blocks
        self.action_map, self.control_timestep = first.action_map, first.control_timestep

    def split(self, rows: np.ndarray) -> list[np.ndarray]:
        """Splits an array (n, ...) into those of the parts."""
        return np.split(rows, np.cumsum([part.num_envs for part in self.parts])[:-1])

    def reset(self, mask: np.ndarray | None = None) -> np.ndarray:
        masks = self.split(np.ones(self.num_envs, bool) if mask is None else mask)
        return np.concatenate([part.reset(m) for part, m in zip(self.parts, masks, strict=True)])

    def step(self, action: np.ndarray) -> Step:
        steps = [part.step(a) for part, a in zip(self.parts, self.split(action), strict=True)]
        *joined, infos = zip(*steps, strict=True)
        terms = {
            name: np.concatenate([info['reward_terms'][name] for info in infos])
            for name in infos[0]['reward_terms']
        }
        info = {
            name: np.concatenate([info[name] for info in infos])
            for name in ('landed', *LANDING_ERRORS)
            if name in infos[0]
        }
        return Step(*(np.concatenate(each) for each in joined), {'reward_terms': terms, **info})

    def get_state(self) -> dict[str, Any]:
        """Returns the complete state of all simulations."""
        return {'parts': [part.get_state() for part in self.parts]}

    def set_state(self, state: dict[str, Any]) -> None:
        """Restores a state from `get_state`."""
        for part, saved in zip(self.parts, state['parts'], strict=True):
            part.set_state(saved)

    def close(self) -> None:
        for part in self.parts:
            part.close()
