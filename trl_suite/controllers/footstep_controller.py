"""Low-level footstep controllers: loading, checks, and batched calls.

from trl_suite import policies
from trl_suite.controllers import footstep_controller

controller = footstep_controller.load(policies.load('mine.npz'))
controller = footstep_controller.load('mine.npz')  # the same
controller = footstep_controller.load(lambda observation: my_network(observation))  # or any function

A controller is called every 1/30 s. It takes observations of
`trl_suite.tasks.footsteps.task.SpatialFootsteps`, (n, 125) without a terrain map, and returns
actions in [-1, 1], (n, 17). It must be stateless; the observation includes the phase.
"""

from __future__ import annotations

import os
import types
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from trl_suite import policies
from trl_suite.actuation.action_map import ActionMap
from trl_suite.characters import CharacterSpec
from trl_suite.util import errors

Function = Callable[[np.ndarray], Any]


class Controller:
    """A low-level controller with checked actions.

    Attributes:
      name: name for messages.
      policy: the `Policy`; None if the controller is another function.
    """

    def __init__(self, function: Function, name: str) -> None:
        self._function, self.name = function, name
        self._size: int | None = None  # of an action, once it is known
        self.policy = function if isinstance(function, policies.Policy) else None

    def check(
        self, character: CharacterSpec, blocks: dict[str, slice], action_map: ActionMap
    ) -> None:
        """Checks that the controller has these observation blocks and actions.

        Functions other than policies can only be checked when they are called. If a policy was
        trained with another body, a warning is issued, since it may still work.
        """
        self._size = len(action_map)
        if self.policy is None:
            return
        with errors.naming(f'controller {self.name}'):
            self.policy.check(types.SimpleNamespace(blocks=blocks, action_map=action_map))
        trained = self.policy.info.get('character')
        own = character.digest
        if trained is not None and trained != own:
            warnings.warn(
                f'controller {self.name} was trained with body {trained}; this one is {own}',
                stacklevel=2,
            )

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Returns actions, (n, actions), for observations (n, size)."""
        answer = self._function(observation)
        try:
            action = np.asarray(answer, dtype=float)
        except (TypeError, ValueError, OverflowError) as error:
            raise ValueError(f'controller {self.name} does not return numbers: {error}') from None
        n, size = len(observation), self._size
        if action.ndim != 2 or len(action) != n or size not in (None, action.shape[1]):
            raise ValueError(
                f'controller {self.name} returns actions of shape {action.shape}; expected '
                f'({n}, {"k" if size is None else size}), one row for each observation'
            )
        if not np.isfinite(action).all():
            # The simulation of an observation that is not finite has diverged; its action is unused.
            diverged = ~np.isfinite(observation).all(1)
            action = np.where(diverged[:, None], 0.0, action)
        if not np.isfinite(action).all():
            env_id = int(np.argwhere(~np.isfinite(action))[0, 0])
            raise ValueError(
                f'controller {self.name} returns an action that is not finite for observation {env_id}'
            )
        return action


def load(source: str | os.PathLike[str] | Controller | Function) -> Controller:
    """Returns a low-level controller.

    Args:
      source: a `Controller`, a `Policy`, the path of a policy, or any function from observations
        (n, size) to actions (n, k).
    """
    if isinstance(source, Controller):
        return source
    if isinstance(source, policies.Policy):
        return Controller(source, repr(source.id))
    if callable(source):
        return Controller(source, getattr(source, '__name__', type(source).__name__))
    if not isinstance(source, (str, os.PathLike)):
        raise TypeError(
            f'controller is {source!r}; expected the id of an environment, a policy, its file, a '
            'function, or a list of them'
        )
    return Controller(policies.load(source), repr(os.fspath(source)))
