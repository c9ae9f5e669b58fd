"""Windows of the planar grounds of n simulations, as arrays, and functions of one simulation."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trl_suite.terrain.generators import BORDER, SPACING, cells
from trl_suite.util.compiled import compiled_inline, nearest_index

FARTHEST = 1e4  # m from its window; a character that is suddenly farther away is lost
ADVANCE = cells(6.0)  # window centres are multiples of it; unit of all lengths: SPACING
BEHIND, AHEAD = cells(6.0), cells(18.0)  # extent of the boxes around the centre of a window
BEFORE = AHEAD - BEHIND  # heights reach as far backwards as ahead: characters may turn round
VERTICES = 2 * AHEAD + 1

_REACH = ADVANCE * SPACING / 2 + SPACING  # m from the centre; beyond, a window is refilled
_CELLS_PER_METRE = 1 / SPACING


class PlanarWindows(NamedTuple):
    """Windows of W = `VERTICES` vertices, SPACING apart, of n grounds; arrays are never replaced.

    The boxes of a window begin `BEFORE` vertices after its first one.
    """

    start: np.ndarray  # (n,); index of the vertex where boxes begin; NaN before the first episode
    heights: np.ndarray  # (n, W) m
    rises: np.ndarray  # (n, W) m; from each vertex to the next; the last is 0
    vertical: np.ndarray  # (n, W) bool; whether the cell before a vertex is a vertical face


def empty(n: int) -> PlanarWindows:
    """Allocates n windows."""
    heights, rises = np.zeros((2, n, VERTICES))
    return PlanarWindows(np.full(n, np.nan), heights, rises, np.zeros((n, VERTICES), bool))


@compiled_inline
def height(i: int, x: float, ground: PlanarWindows) -> float:
    """Returns the height in m of the ground of simulation i at x, m.

    Within 18 m of the centre of the window. Beyond, it is meaningless, but finite if x is finite.
    """
    u = x * _CELLS_PER_METRE - ground.start[i]
    whole = np.floor(u)
    cell = nearest_index(whole + BEFORE, VERTICES)
    return (u - whole) * ground.rises[i, cell] + ground.heights[i, cell]


@compiled_inline
def _away(i: int, x: float, ground: PlanarWindows) -> float:
    """Distance of x, m, from the centre of the window of simulation i, m."""
    return abs(x - (ground.start[i] + BEHIND) * SPACING)


@compiled_inline
def is_lost(i: int, x: float, ground: PlanarWindows) -> bool:
    """Returns whether a character at x, m, is where no ground is drawn; its episode then ends."""
    return not (abs(x) < BORDER and _away(i, x, ground) < FARTHEST)


@compiled_inline
def has_left(i: int, x: float, ground: PlanarWindows) -> bool:
    """Returns whether the window of simulation i must be refilled for a character at x, m."""
    return _away(i, x, ground) > _REACH and not is_lost(i, x, ground)
