"""Checks of the arguments of environments: limits, simulations, seeds, types."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from trl_suite.util import errors

Ids = np.ndarray | Sequence[int] | None  # indices of simulations, or a mask; None for all


def absolute(value: Any) -> Any:
    """Returns options whose files have absolute paths: copies may be made in other folders."""
    if isinstance(value, str) and value.endswith(('.npz', '.json')):
        return os.path.abspath(value)
    if isinstance(value, Mapping):
        return {name: absolute(each) for name, each in value.items()}
    return value


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


def check_dtype(dtype: Any) -> np.dtype:
    """Returns a type of observations.

    Raises:
      ValueError: it is neither float64 nor float32.
    """
    try:
        found = np.dtype(dtype)
    except TypeError:
        found = np.dtype(object)
    if found not in (np.dtype(np.float64), np.dtype(np.float32)):
        raise ValueError(f'dtype is {dtype!r}; expected float64 or float32')
    return found


def given_ids(env_ids: Ids, num_envs: int) -> list[int]:
    """Returns the indices of simulations as they are given.

    Args:
      env_ids: indices of simulations, or a mask (num_envs,) bool; None for all.
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
            f'env_ids is {env_ids!r}; expected integers, the indices of simulations, or a mask '
            f'of {num_envs} bools'
        )
    if ids.min() < 0 or ids.max() >= num_envs:
        raise ValueError(f'env_ids are {ids.tolist()}; expected numbers in [0, {num_envs})')
    return ids.tolist()


def unique_ids(env_ids: Ids, num_envs: int) -> np.ndarray:
    """Returns the indices of simulations sorted and without repeats; see `given_ids`."""
    return np.unique(np.array(given_ids(env_ids, num_envs), int))


def check_seed(name: str, seed: Any) -> None:
    """Checks the seed of one random stream.

    Raises:
      TypeError: it is no integer.
      ValueError: it is not in [0, 2**32).
    """
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)):
        raise TypeError(f'{name} is {seed!r}; expected a seed, an integer in [0, 2**32)')
    if not 0 <= seed < 2**32:
        raise ValueError(f'{name} is {seed}; expected a seed in [0, 2**32)')


def all_seeds(seed: int | Sequence[int] | None, num_envs: int) -> np.ndarray:
    """Returns the seeds of simulations, (n,).

    Args:
      seed: one seed, from which those of the simulations are derived; n seeds; or None, for one
        from the operating system.
      num_envs: number of simulations, n.

    Raises:
      TypeError: a seed that is not an integer.
      ValueError: a negative seed, a wrong number of seeds, or one that is no integer in [0, 2**32).
    """
    if seed is None or isinstance(seed, str) or not np.iterable(seed):
        if seed is not None and (isinstance(seed, bool) or not isinstance(seed, (int, np.integer))):
            raise TypeError(
                f'seed is {seed!r}; expected an integer, one for each simulation, or None'
            )
        if seed is not None and seed < 0:
            raise ValueError(f'seed is {seed}; expected 0 or a positive integer')
        return np.random.SeedSequence(seed).generate_state(num_envs, np.uint32)
    try:
        seeds = np.asarray(seed)
    except ValueError:  # lists of different lengths
        seeds = np.asarray(None)
    if seeds.dtype.kind in 'iu' and seeds.shape != (num_envs,):
        raise ValueError(f'seed has {seeds.size} seeds for {num_envs} simulations')
    if seeds.dtype.kind not in 'iu' or (seeds < 0).any() or (seeds >= 2**32).any():
        raise ValueError(f'seed is {seed!r}; expected an integer in [0, 2**32) for each simulation')
    return seeds
