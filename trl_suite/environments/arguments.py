"""Checks of the arguments of environments: limits, simulations, seeds, types."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from typing import Any, TypeGuard

import numpy as np

from trl_suite.util import errors
from trl_suite.util.options import checked

Ids = np.ndarray | Sequence[int] | None  # indices of simulations, or a mask; None for all


def limits(step_limit: Any, time_limit: Any) -> tuple[int | None, float]:
    """Returns limits in control steps and in s; None and infinity for none.

    Raises:
      ValueError: one that is not a positive number.
    """
    if not (errors.is_number(time_limit) and time_limit > 0):
        raise ValueError(
            f'time_limit is {time_limit!r}; expected a positive number of seconds, inf for no limit'
        )
    return checked('step_limit', step_limit, int | None, at_least=1), time_limit


def check_dtype(dtype: Any) -> np.dtype:
    """Returns a type of observations.

    Raises:
      ValueError: it is neither float64 nor float32.
    """
    with contextlib.suppress(TypeError):
        if np.dtype(dtype) in (np.dtype(np.float64), np.dtype(np.float32)):
            return np.dtype(dtype)
    raise ValueError(f'dtype is {dtype!r}; expected float64 or float32')


def given_ids(env_ids: Ids, num_envs: int) -> list[int]:
    """Returns the indices of simulations as they are given.

    Args:
      env_ids: indices of simulations, or a mask (num_envs,) bool; None for all.
      num_envs: number of all simulations.

    Raises:
      TypeError: they are neither integers nor a mask.
      ValueError: there are no such simulations, or a mask has another shape.
    """
    try:
        ids = np.atleast_1d(np.arange(num_envs) if env_ids is None else np.asarray(env_ids))
    except ValueError:  # lists of different lengths
        ids = np.atleast_2d(np.nan)
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


def is_integer(seed: Any) -> TypeGuard[int]:
    """Whether a value is an integer, and no bool."""
    return isinstance(seed, (int, np.integer)) and not isinstance(seed, bool)


def stream_seed(seed: Any) -> Any:
    """Returns the seed of one random stream: that of a whole number of 2**32 or more is hashed."""
    if is_integer(seed) and seed >= 2**32:
        return int(np.random.SeedSequence(seed).generate_state(1)[0])
    return seed


def check_seed(name: str, seed: Any) -> None:
    """Checks the seed of one random stream: raises a TypeError or ValueError."""
    if not is_integer(seed):
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
      TypeError: a seed that is no integer, nor a sequence.
      ValueError: a negative seed, a wrong number of seeds, or one that is no integer in [0, 2**32).
    """
    if seed is None or is_integer(seed):
        if seed is not None and seed < 0:
            raise ValueError(f'seed is {seed}; expected 0 or a positive integer')
        return np.random.SeedSequence(seed).generate_state(num_envs, np.uint32)
    if isinstance(seed, str) or not np.iterable(seed):
        raise TypeError(f'seed is {seed!r}; expected an integer, one for each simulation, or None')
    try:
        seeds = np.asarray(seed)
    except ValueError:  # lists of different lengths
        seeds = np.asarray(None)
    if seeds.dtype.kind in 'iu' and seeds.ndim > 1:
        raise ValueError(f'seed has shape {seeds.shape}; expected ({num_envs},)')
    if seeds.dtype.kind in 'iu' and seeds.shape != (num_envs,):
        raise ValueError(f'seed has {seeds.size} seeds for {num_envs} simulations')
    if seeds.dtype.kind not in 'iu' or (seeds < 0).any() or (seeds >= 2**32).any():
        raise ValueError(f'seed is {seed!r}; expected an integer in [0, 2**32) for each simulation')
    return seeds
