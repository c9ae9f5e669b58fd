"""Planar ground under n characters as arrays, and what compiled functions ask of it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from trl_suite.terrain.generators import SPACING
from trl_suite.util.compiled import compiled

_CELLS_PER_METRE = 1 / SPACING


class PlanarGround(NamedTuple):
    """Windows of W vertices, SPACING apart, on the ground of each simulation.

    Attributes:
      start: number of the first vertex of a window, (n,); NaN before the first episode.
      centre: middle of the stretch that a window serves, (n,) m.
      reach: how far from there it has to be laid anew, m.
      heights: of the vertices, (n, W) m.
      rises: from each vertex to the next, (n, W) m.
      vertical: whether the cell before a vertex is a vertical face, (n, W).
      wide: heights of the vertices from one window behind on, (n, 3 W) m; only where `is_wide`.
      is_wide: whether `wide` belongs to the window, (n,).
    """

    start: np.ndarray
    centre: np.ndarray
    reach: float
    heights: np.ndarray
    rises: np.ndarray
    vertical: np.ndarray
    wide: np.ndarray
    is_wide: np.ndarray


@compiled
def height(i: int, x: float, ground: PlanarGround) -> float:
    """Returns the height of the ground at x, m; beyond the window that of its ends."""
    last = ground.heights.shape[1] - 1
    u = x * _CELLS_PER_METRE - ground.start[i]
    whole = math.floor(u) if u > -1e9 and u < 1e9 else -1.0
    cell = int(min(max(whole, 0.0), float(last)))
    return (u - whole) * ground.rises[i, cell] + ground.heights[i, cell]


@compiled
def is_outside(i: int, x: float, ground: PlanarGround) -> bool:
    """Whether x lies beyond the window."""
    u = x * _CELLS_PER_METRE - ground.start[i]
    return not (u >= 0.0 and u < ground.heights.shape[1] - 1)


@compiled
def far_height(i: int, x: float, ground: PlanarGround) -> float:
    """Returns the height at x up to the length of a window beyond the window, m."""
    window = ground.heights.shape[1]
    low = (ground.start[i] - window) * SPACING
    high = (ground.start[i] + 2 * window) * SPACING
    position = min(max(x, low), high) / SPACING
    whole = math.floor(position)
    cell = int(min(max(whole - ground.start[i] + window, 0.0), 3.0 * window - 1.0))
    left = ground.wide[i, cell]
    return left + (position - whole) * (ground.wide[i, cell + 1] - left)


@compiled
def slope(i: int, x: float, ground: PlanarGround) -> float:
    """Returns the slope of the cell that x lies in."""
    last = ground.heights.shape[1] - 1
    u = x * _CELLS_PER_METRE - ground.start[i]
    whole = math.floor(u) if u > -1e9 and u < 1e9 else 0.0
    return ground.rises[i, int(min(max(whole, 0.0), float(last)))] / SPACING


@compiled
def has_left(i: int, x: float, ground: PlanarGround) -> bool:
    """Whether a character at x has come so far that its window must be laid anew."""
    return abs(x - ground.centre[i]) > ground.reach
