"""Low-level controllers that place the feet: loaded, checked, and called for many bodies at once.

from trl_suite import policies
from trl_suite.controllers import footstep_controller

controller = footstep_controller.load(policies.load('mine.npz'))
controller = footstep_controller.load('mine.npz')  # the same
controller = footstep_controller.load(lambda observation: my_network(observation))  # or any function

A controller takes the observations of `trl_suite.tasks.footsteps.spatial.SpatialFootsteps`, (n, 125) without a
terrain map, and gives actions in [-1, 1], (n, 17): every 1/30 s, without memory of its own, as the
phase is in the observation.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from trl_suite import characters, policies

Function = Callable[[np.ndarray], Any]


class Controller:
    """A low-level controller whose answers are checked.

    Attributes:
      name: for messages.
      policy: what it was read from; None if it is a function.
    """

    def __init__(self, function: Function, name: str) -> None:
        self._function, self.name = function, name
        self._size: int | None = None  # of an action, once it is known
        self.policy = function if isinstance(function, policies.Policy) else None

    def check(self, task: Any) -> None:
        """Checks that observation and action of a footstep task are what the controller knows.

        Of a function nothing can be known before it is called. A body other than the one that the
        controller was trained with is a warning: it may still walk.

        Raises:
          ValueError: they are not; the message has both.
        """
        self._size = len(task.action_map)
        if self.policy is None:
            return
        self.policy.check(task)
        trained = self.policy.info.get('character')
        own = characters.fingerprint(task.character.spec)
        if trained is not None and trained != own:
            warnings.warn(
                f'controller {self.name} was trained with body {trained}; this one is {own}',
                stacklevel=2,
            )

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Returns actions, (n, actions), for observations (n, size).

        Raises:
          ValueError: the controller gives no array of numbers, another shape, or anything but
            finite numbers; the message names the simulation.
        """
        answer = self._function(observation)
        try:
            action = np.asarray(answer, dtype=float)
        except (TypeError, ValueError) as error:
            raise ValueError(f'controller {self.name} gives no numbers: {error}') from None
        n, size = len(observation), self._size
        if action.ndim != 2 or len(action) != n or size not in (None, action.shape[1]):
            raise ValueError(
                f'controller {self.name} gives actions of shape {action.shape}; expected '
                f'({n}, {"k" if size is None else size}), one simulation for each body'
            )
        if not np.isfinite(action).all():
            # Of an observation that is no number nothing follows: the simulation has diverged.
            diverged = ~np.isfinite(observation).all(1)
            action = np.where(diverged[:, None], 0.0, action)
        if not np.isfinite(action).all():
            env_id = int(np.argwhere(~np.isfinite(action))[0, 0])
            raise ValueError(
                f'controller {self.name} gives no finite action for simulation {env_id}'
            )
        return action


def load(source: str | os.PathLike[str] | Controller | Function) -> Controller:
    """Returns a low-level controller.

    Args:
      source: a `Policy`, the path of one (a PathLike, or a string that ends in .npz), or any function
        from observations (n, size) to actions (n, k).

    Raises:
      TypeError: none of these.
      ValueError: a broken file; see `policies.load`.
      FileNotFoundError: there is no such file.
    """
    if isinstance(source, Controller):
        return source
    if isinstance(source, policies.Policy):
        return Controller(source, repr(source.id))
    if callable(source):
        return Controller(source, getattr(source, '__name__', type(source).__name__))
    if not isinstance(source, (str, os.PathLike)):
        raise TypeError(f'controller is a policy, its file or a function, not {source!r}')
    return Controller(policies.load(source), repr(os.fspath(source)))
