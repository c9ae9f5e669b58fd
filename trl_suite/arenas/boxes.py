"""Collision boxes for a planar height profile: exact vertical faces, no ghost edges.

A profile is cut into pieces: level runs become one box each, sloped stretches become tilted boxes
as long as the profile stays within a tolerance of them. Cuts depend on absolute vertex numbers
only, so the surface under a character does not change when the window of boxes moves on.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trl_suite.terrain import SPACING

PIECE = 4  # cells of the shortest tilted piece: 0.1 m
DOUBLINGS = 3  # tilted pieces grow to at most PIECE * 2**DOUBLINGS cells: 0.8 m
TOLERANCE = 0.004  # m; how far the profile may stray from a piece that is doubled
LEVEL_THICKNESS = 4.0  # m; level boxes face the sides of the deepest gaps (2.5 m)
TILTED_THICKNESS = 1.0  # m
OVERLAP = 0.05  # m; how far tilted pieces run on below each other at valleys
LEAN = 0.9  # of the way to the next face; how far the lower end of a tilted box may lean out
HALF_WIDTH = 1.0  # m; the strip is 2 m wide
EPSILON = 1e-9
_FRACTIONS = {
    PIECE << i: np.arange(PIECE << i)[:, None] / (PIECE << i) for i in range(1, DOUBLINGS + 1)
}


class Boxes(NamedTuple):
    """Static boxes in the x-z plane, in order of x."""

    position: np.ndarray  # (k, 3) m
    half_size: np.ndarray  # (k, 3) m
    quaternion: np.ndarray  # (k, 4) w, x, y, z


def _cuts(start: int, heights: np.ndarray, face: np.ndarray, tolerance: float) -> np.ndarray:
    """Returns a mask over vertices: True where a piece ends and the next begins.

    Args:
      face: whether cell i, between vertices i - 1 and i, is a vertical face, shape (m + 1,).
    """
    count = len(heights)
    level = np.zeros(count + 1, dtype=bool)  # of cell i, between vertices i-1 and i
    np.less(np.abs(heights[1:] - heights[:-1]), EPSILON, out=level[1:count])
    level &= ~face
    left, right = level[:count], level[1:]
    cut = (left != right) | face[:count] | face[1:]
    cut[0] = cut[-1] = True
    sloped = ~(level | face)[1:count]
    if not sloped.any():
        return cut
    # The cell beside a vertical face is split off: a level post with an exactly vertical side.
    cut[1:] |= face[: count - 1] & sloped
    cut[:-1] |= face[2:] & sloped
    mandatory = cut.copy()
    offset = -start % PIECE
    cut[offset::PIECE] |= ~(left & right)[offset::PIECE]
    spans = (count - 1 - offset) // PIECE
    # Of the spans of one length: whether nothing is cut inside.
    whole = ~cut[offset : offset + spans * PIECE].reshape(spans, PIECE)[:, 1:].any(1)
    for doubling in range(1, DOUBLINGS + 1):
        half, span = PIECE << doubling - 1, PIECE << doubling
        first_half, offset = offset, -start % span
        spans = (count - 1 - offset) // span
        if spans < 1 or not whole.any():
            break
        halves = whole[(offset - first_half) // half :][: 2 * spans]
        whole = halves[::2] & halves[1::2]
        middle = slice(offset + half, offset + spans * span, span)
        # A span may be one piece if its halves are, nothing must be cut between them, and the
        # profile stays close to the chord.
        joint = (whole & cut[middle] & ~mandatory[middle]).nonzero()[0]
        height = heights[offset : offset + spans * span].reshape(spans, span)[joint].T
        first = height[:1]
        rise = heights[offset + span :: span][joint] - first
        stray = np.abs(height - (first + rise * _FRACTIONS[span])).max(0)
        cut[offset + half + span * joint[stray < tolerance]] = False
        whole &= ~cut[middle]
    return cut


def from_profile(
    start: int, heights: np.ndarray, vertical: np.ndarray, tolerance: float = TOLERANCE
) -> Boxes:
    """Cuts a window of a profile into boxes.

    Args:
      start: number of the first vertex; vertex i stands at x = i * SPACING.
      heights: heights of the vertices, m, shape (m,).
      vertical: True where the cell before a vertex is a vertical face, shape (m,).
      tolerance: largest deviation of the profile from a tilted box longer than 0.1 m, m.

    Returns:
      Boxes whose upper faces follow the profile; their sides stand in the middle of the vertical
      cells.
    """
    count = len(heights)
    face = np.zeros(count + 1, dtype=bool)
    face[1:count] = vertical[1:]
    knots = _cuts(start, heights, face, tolerance).nonzero()[0]
    a, b = knots[:-1], knots[1:]
    faces = face.any()
    if faces:
        # A vertical cell is no piece, but its left vertex is one if the cell before is vertical too.
        upright = face[b] & (b - a == 1)
        lone = face[a] & upright
        keep = ~upright | lone
        a, b = a[keep], np.where(lone, a, b)[keep]
    at_left, at_right = face[a], face[b + 1]
    x0 = (start + a - 0.5 * at_left) * SPACING
    x1 = (start + b + 0.5 * at_right) * SPACING
    z0, z1 = heights[a], heights[b]
    if faces:
        # Posts are level; the height is that of the vertex at the face.
        post = (b - a <= 1) & (at_left | at_right)
        z0, z1 = np.where(post & at_right & ~at_left, z1, z0), np.where(post & at_left, z0, z1)
    if np.abs(z1 - z0).max(initial=0) < EPSILON:
        return _level(x0, x1, z0)
    slope = (z1 - z0) / (x1 - x0)
    tilted = np.abs(slope) > EPSILON

    # At a valley both pieces run on below the surface of the other, so that a sliding foot meets
    # no end face.
    joined = (b[:-1] == a[1:]) & ~at_right[:-1]
    valley = joined & (slope[1:] > slope[:-1] + EPSILON)
    length = x1 - x0
    overlap = np.minimum(OVERLAP, length)
    run_on_right, run_on_left = np.zeros((2, len(a)))
    run_on_right[:-1] = valley * overlap[1:]
    run_on_left[1:] = valley * overlap[:-1]
    x0, z0 = x0 - run_on_left, z0 - run_on_left * slope
    x1, z1 = x1 + run_on_right, z1 + run_on_right * slope

    angle = np.arctan(slope)
    sine, cosine = np.sin(angle), np.cos(angle)
    thickness = np.where(tilted, TILTED_THICKNESS, LEVEL_THICKNESS)
    if faces:
        # The lower end of a tilted box leans out: to the right where the ground rises, else to the
        # left. It must not come out of the next face on that side.
        right_face = np.minimum.accumulate(np.where(at_right, x1, np.inf)[::-1])[::-1]
        left_face = np.maximum.accumulate(np.where(at_left, x0, -np.inf))
        room = LEAN * np.where(slope > 0, right_face - x1, x0 - left_face)
        room /= np.maximum(np.abs(sine), EPSILON)
        thickness = np.where(tilted, np.minimum(thickness, room), thickness)
    position = np.zeros((len(a), 3))
    position[:, 0] = 0.5 * (x0 + x1) + 0.5 * thickness * sine
    position[:, 2] = 0.5 * (z0 + z1) - 0.5 * thickness * cosine
    half_size = np.empty((len(a), 3))
    half_size[:, 0] = 0.5 * np.hypot(x1 - x0, z1 - z0)
    half_size[:, 1] = HALF_WIDTH
    half_size[:, 2] = 0.5 * thickness
    quaternion = np.zeros((len(a), 4))
    quaternion[:, 0] = np.cos(0.5 * angle)
    quaternion[:, 2] = -np.sin(0.5 * angle)
    return Boxes(position, half_size, quaternion)


def _level(x0: np.ndarray, x1: np.ndarray, z: np.ndarray) -> Boxes:
    """Boxes whose upper faces lie at z between x0 and x1, m, shape (k,)."""
    position, half_size = np.zeros((2, len(z), 3))
    position[:, 0] = 0.5 * (x0 + x1)
    position[:, 2] = z - 0.5 * LEVEL_THICKNESS
    half_size[:, 0] = 0.5 * (x1 - x0)
    half_size[:, 1:] = HALF_WIDTH, 0.5 * LEVEL_THICKNESS
    quaternion = np.zeros((len(z), 4))
    quaternion[:, 0] = 1
    return Boxes(position, half_size, quaternion)
