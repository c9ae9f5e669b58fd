"""Checks of the arrays of a network, which may come from a user's file."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

from trl_suite.util import errors

LARGEST = float(np.finfo(np.float32).max)  # bound of sums


array = functools.partial(errors.floats, dtype=np.float32)


def stack(name: str, weight: Any, axes: int) -> tuple[int, ...]:
    """Returns (m,) if the weights are those of m networks, with one axis more than `axes`, else ()."""
    found = np.shape(weight)[:1] if np.ndim(weight) == axes + 1 else ()
    if found == (0,):
        raise ValueError(f'{name}: expected the weights of at least one network')
    return found


def columns(name: str, value: Any, axes: int, inputs: int) -> np.ndarray:
    """Returns a read-only copy of indices of columns below `inputs`, at least one."""
    copied = np.array(value)
    if copied.ndim != axes or copied.dtype.kind not in 'iu' or not copied.size:
        raise ValueError(f'{name}: expected integers, at least one')
    if copied.min() < 0 or copied.max() >= inputs:
        raise ValueError(f'{name}: expected numbers of 0 to {inputs - 1}')
    copied.setflags(write=False)
    return copied


def largest_sum(name: str, weight: np.ndarray, bias: np.ndarray, bound: float) -> float:
    """Returns a bound of a layer's sums, given a bound of its inputs."""
    axes = tuple(range(weight.ndim - 1))
    most = float((np.abs(weight.astype(float)).sum(axes) * bound + np.abs(bias)).max())
    if most > LARGEST:
        raise ValueError(
            f'{name}: is too large: sums may reach {most:.3g}; expected at most {LARGEST:.3g}'
        )
    return most
