"""Checks of the arguments of environments: limits, simulations, seeds, threads."""

from __future__ import annotations

import os
import threading
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from trl_suite.util import errors

TIME_ERROR = 1e-6  # s; more than the error of a sum of physics steps, less than one of them


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


def absolute(value: Any) -> Any:
    """Returns options whose files have absolute paths: copies may be made in other folders."""
    if isinstance(value, str) and value.endswith(('.npz', '.json')):
        return os.path.abspath(value)
    if isinstance(value, Mapping):
        return {name: absolute(each) for name, each in value.items()}
    return value


def check_step_limit(value: Any) -> int | None:
    """Returns a limit of control steps; None for no limit.

    Raises:
      ValueError: it is neither None nor a positive integer.
    """
    if value is not None and not (
        errors.is_number(value) and 1 <= value < np.inf and value % 1 == 0
    ):
        raise ValueError(f'step_limit is {value!r}; expected a positive integer or None')
    return None if value is None else int(value)


def check_time_limit(value: Any) -> float:
    """Returns a limit of simulated time in s; infinity for no limit.

    Raises:
      ValueError: it is not a positive number.
    """
    if not (errors.is_number(value) and value > 0):
        raise ValueError(
            f'time_limit is {value!r}; expected a positive number of seconds, inf for no limit'
        )
    return value


def given_ids(env_ids: np.ndarray | Sequence[int] | None, num_envs: int) -> list[int]:
    """Returns the numbers of simulations as they are given.

    Args:
      env_ids: numbers of simulations, or a mask (num_envs,) bool; None for all.
      num_envs: number of all simulations.

    Raises:
      TypeError: they are neither integers nor a mask.
      ValueError: there are no such simulations, or a mask has another shape.
    """
    if env_ids is None:
        return list(range(num_envs))
    ids = np.atleast_1d(np.asarray(env_ids))
    if ids.dtype == bool:
        if ids.shape != (num_envs,):
            raise ValueError(f'mask has shape {ids.shape}; expected ({num_envs},)')
        return np.flatnonzero(ids).tolist()
    if not ids.size:
        return []
    if ids.dtype.kind not in 'iu' or ids.ndim > 1:
        raise TypeError(
            f'env_ids is {env_ids!r}; expected integers, the numbers of simulations, or a mask '
            f'of {num_envs} bools'
        )
    if ids.min() < 0 or ids.max() >= num_envs:
        raise ValueError(f'env_ids are {ids.tolist()}; expected numbers in [0, {num_envs})')
    return ids.tolist()


def unique_ids(env_ids: np.ndarray | Sequence[int] | None, num_envs: int) -> np.ndarray:
    """Returns the numbers of simulations sorted and without repeats; see `given_ids`."""
    return np.unique(np.array(given_ids(env_ids, num_envs), int))


def all_seeds(seed: int | Sequence[int] | None, num_envs: int) -> np.ndarray:
    """Returns the seeds of simulations, (n,).

    Args:
      seed: one seed, from which those of the simulations are derived; n seeds; or None, for one
        from the operating system.
      num_envs: number of simulations, n.

    Raises:
      TypeError: a seed that is not an integer.
      ValueError: a negative seed, or a wrong number of seeds.
    """
    if seed is None or isinstance(seed, str) or not np.iterable(seed):
        return _seed_sequence(seed).generate_state(num_envs, np.uint32)
    return _seeds(seed, num_envs)


def _seed_sequence(seed: Any) -> np.random.SeedSequence:
    """Returns the sequence of a seed for all simulations.

    Raises:
      TypeError: it is not an integer.
      ValueError: it is negative.
    """
    if seed is not None and (isinstance(seed, bool) or not isinstance(seed, (int, np.integer))):
        raise TypeError(f'seed is {seed!r}; expected an integer, one for each simulation, or None')
    if seed is not None and seed < 0:
        raise ValueError(f'seed is {seed}; expected 0 or a positive integer')
    return np.random.SeedSequence(seed)


def _seeds(seed: Sequence[int], num_envs: int) -> np.ndarray:
    """Returns the given seeds of all simulations, (n,).

    Raises:
      ValueError: there are not n, or they are no integers in [0, 2**32).
    """
    try:
        seeds = np.asarray(seed)
    except ValueError:  # lists of different lengths
        seeds = np.asarray(None)
    if seeds.dtype.kind in 'iu' and seeds.shape != (num_envs,):
        raise ValueError(f'seed has {seeds.size} seeds for {num_envs} simulations')
    if seeds.dtype.kind not in 'iu' or (seeds < 0).any() or (seeds >= 2**32).any():
        raise ValueError(f'seed is {seed!r}; expected an integer in [0, 2**32) for each simulation')
    return seeds
