"""Checks shared by single and vector environments: limits, saved states, threads."""

from __future__ import annotations

import numbers
import threading
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np


class OneThread:
    """Rejects a second thread while a first one is inside; the same thread may enter again.

    Two threads that step the same simulation would crash the process.
    """

    def __init__(self) -> None:
        self._lock = threading.RLock()

    def __enter__(self) -> None:
        if not self._lock.acquire(blocking=False):
            raise RuntimeError(
                'another thread is using the environment; make one environment for each thread'
            )

    def __exit__(self, *error: object) -> None:
        self._lock.release()


def check_step_limit(value: Any) -> int | None:
    """Returns a limit of control steps; None for no limit.

    Raises:
      ValueError: it is neither None nor a positive integer.
    """
    if value is not None and not (_is_number(value) and 1 <= value < np.inf and value % 1 == 0):
        raise ValueError(f'step_limit is {value!r}; expected a positive integer or None')
    return None if value is None else int(value)


def check_time_limit(value: Any) -> float:
    """Returns a limit of simulated time in s; infinity for no limit.

    Raises:
      ValueError: it is not a positive number.
    """
    if not (_is_number(value) and value > 0):
        raise ValueError(
            f'time_limit is {value!r}; expected a positive number of seconds, inf for no limit'
        )
    return value


def _is_number(value: Any) -> bool:
    return isinstance(value, numbers.Real) and not isinstance(value, (bool, np.bool_))


def check_state(state: Any, owner: str, keys: Iterable[str]) -> None:
    """Checks that a saved state was made by an environment like this one.

    Args:
      state: the state to check.
      owner: the value of 'made_for' in a state of this environment.
      keys: the other keys of such a state.

    Raises:
      TypeError: the state is not a mapping.
      ValueError: it belongs to another environment, or parts of it are missing.
    """
    if not isinstance(state, Mapping):
        raise TypeError(f'a state is a dict from get_state, not {type(state).__name__}')
    found = state.get('made_for')
    if found != owner:
        raise ValueError(f'the state belongs to {found}; this environment is {owner}')
    missing = [key for key in keys if key not in state]
    if missing:
        raise ValueError(f'the state lacks {", ".join(map(repr, missing))}')
