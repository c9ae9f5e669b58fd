"""Windows of the planar grounds of n simulations, as arrays, and functions of one simulation."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trl_suite.terrain.planar.generators import BORDER, SPACING
from trl_suite.util.compiled import compiled_inline, nearest_index

FARTHEST = 1e4  # m from its window; a character that is suddenly farther away is lost
BEFORE = 480  # vertices of a window before `start`, so that characters can look backwards, too

_CELLS_PER_METRE = 1 / SPACING


class PlanarWindows(NamedTuple):
    """Windows of W vertices, SPACING apart, of n grounds. The arrays are never replaced.

    Attributes:
      start: number of the vertex at which the boxes of a window begin, `BEFORE` vertices after the
        first one, (n,); NaN before the first episode.
      centre: middle of the range of character positions for which a window is valid, (n,) m.
      reach: distance of the character from the centre beyond which a window is refilled, m.
      heights: heights of the vertices, (n, W) m.
      rises: from each vertex to the next, (n, W) m; the last is 0.
      vertical: whether the cell before a vertex is a vertical face, (n, W) bool.
      wide: heights of vertices, the first of them W before the window, (n, 3 W + 1) m.
      is_wide: whether `wide` is filled for the current window, (n,) bool.
    """

    start: np.ndarray
    centre: np.ndarray
    reach: float
    heights: np.ndarray
    rises: np.ndarray
    vertical: np.ndarray
    wide: np.ndarray
    is_wide: np.ndarray


def empty(n: int, vertices: int, reach: float) -> PlanarWindows:
    """Allocates n windows."""
    heights, rises = np.zeros((2, n, vertices))
    return PlanarWindows(
        start=np.full(n, np.nan),
        centre=np.zeros(n),
        reach=reach,
        heights=heights,
        rises=rises,
        vertical=np.zeros((n, vertices), bool),
        wide=np.zeros((n, 3 * vertices + 1)),  # the system allocates only written pages
        is_wide=np.zeros(n, bool),
    )


@compiled_inline
def height(i: int, x: float, ground: PlanarWindows) -> float:
    """Returns the height in m of the ground of simulation i at x, m.

    Beyond the window the result is meaningless, but finite if x is finite; see `far_height`.
    """
    u = x * _CELLS_PER_METRE - ground.start[i]
    whole = np.floor(u)
    cell = nearest_index(whole + BEFORE, ground.heights.shape[1])
    return (u - whole) * ground.rises[i, cell] + ground.heights[i, cell]


@compiled_inline
def slope(i: int, x: float, ground: PlanarWindows) -> float:
    """Returns the slope dh/dx of the ground of simulation i at x, m."""
    whole = np.floor(x * _CELLS_PER_METRE - ground.start[i])
    return ground.rises[i, nearest_index(whole + BEFORE, ground.heights.shape[1])] / SPACING


@compiled_inline
def is_outside(i: int, x: float, ground: PlanarWindows) -> bool:
    """Returns whether x, m, lies beyond the window of simulation i."""
    u = x * _CELLS_PER_METRE - ground.start[i] + BEFORE
    return u < 0.0 or u >= ground.heights.shape[1] - 1


@compiled_inline
def far_height(i: int, x: float, ground: PlanarWindows) -> float:
    """Returns the height in m at x, m, from `wide`: up to one window length beyond the window.

    Valid where `is_wide`; beyond `wide` its end values apply. It rounds as `PlanarGround.height`
    does, unlike `height`: if a terrain observation reaches beyond the window, all of its heights
    come from this function.
    """
    position = x / SPACING
    whole = np.floor(position)
    first = ground.start[i] - BEFORE - ground.heights.shape[1]
    last = ground.wide.shape[1] - 1
    if whole < first:
        return ground.wide[i, 0]
    if whole >= first + last:
        return ground.wide[i, last]
    cell = nearest_index(whole - first, last)
    left = ground.wide[i, cell]
    return left + (position - whole) * (ground.wide[i, cell + 1] - left)


@compiled_inline
def is_lost(i: int, x: float, ground: PlanarWindows) -> bool:
    """Returns whether a character at x, m, is where no ground is drawn; its episode then ends."""
    return not (abs(x) < BORDER and abs(x - ground.centre[i]) < FARTHEST)


@compiled_inline
def has_left(i: int, x: float, ground: PlanarWindows) -> bool:
    """Returns whether the window of simulation i must be refilled for a character at x, m."""
    return ground.reach < abs(x - ground.centre[i]) and not is_lost(i, x, ground)
