"""Collision boxes for a planar height profile: exact vertical faces, no ghost edges.

A profile is cut into pieces: level runs become one box each, sloped stretches become tilted boxes
as long as the profile stays within a tolerance of them. Cuts depend on absolute indices of
vertices only, so the surface under a character does not change when the window of boxes moves.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from trl_suite.arenas.scene import PARKED
from trl_suite.terrain import SPACING
from trl_suite.util.compiled import compiled, compiled_inline

PIECE = 4  # cells of the shortest tilted piece: 0.1 m
DOUBLINGS = 3  # tilted pieces grow to at most PIECE * 2**DOUBLINGS cells: 0.8 m
TOLERANCE = 0.004  # m; largest deviation of the profile from a piece that is doubled
# m; level boxes form the sides of gaps, of which those of presets are up to 2.5 m deep. Beside deeper
# ones they reach `BELOW` m below the floor.
LEVEL_THICKNESS, BELOW = 4.0, 1.0
TILTED_THICKNESS = 1.0  # m
OVERLAP = 0.05  # m; by which tilted pieces are extended below each other at valleys
LEAN = 0.9  # of the distance to the next face; limit of the overhang of a tilted box's lower end
HALF_WIDTH = 1.0  # m; the strip is 2 m wide
THINNEST = 0.02  # m; of a tilted box beside a ridge
KINK = 0.5  # rise per m; change of slope at the ends of a ramp
EPSILON = 1e-9


class Boxes(NamedTuple):
    """Static boxes in the x-z plane, in order of x."""

    position: np.ndarray  # (k, 3) m
    half_size: np.ndarray  # (k, 3) m
    quaternion: np.ndarray  # (k, 4) w, x, y, z


class Pieces(NamedTuple):
    """The pieces of a profile of m vertices, in order of x; the first `number` entries are used."""

    number: int
    level: bool  # whether all of them are level
    ends: np.ndarray  # (2, m); indices of the first and the last vertex of each
    edges: np.ndarray  # (5, m); of upper faces, x, z of the left and of the right edge, m; slopes


def cut(
    start: int,
    heights: np.ndarray,
    vertical: np.ndarray,
    tolerance: float = TOLERANCE,
    kink: float = math.inf,
) -> Pieces:
    """Cuts a window of a profile into pieces, each of which becomes a box.

    The upper faces of the boxes follow the profile; their sides are in the middle of the vertical
    cells.

    Args:
      start: index of the first vertex; vertex i is at x = i * SPACING.
      heights: heights of the vertices, m, shape (m,).
      vertical: True where the cell before a vertex is a vertical face, shape (m,).
      tolerance: largest deviation of the profile from a tilted box longer than 0.1 m, m.
      kink: change of slope at which a piece ends, rise per m; `KINK` if the ground has ramps.
    """
    marks = np.empty((3, len(heights)), bool)
    ends, edges = np.empty((2, len(heights)), int), np.empty((5, len(heights)))
    _mark(start, heights, vertical, tolerance, kink, marks)
    count, level = _join(start, heights, vertical, marks, ends, edges)
    return Pieces(count, level, ends, edges)


def angles(pieces: Pieces) -> np.ndarray:
    """Returns the tilt angles of the upper faces of pieces, (number,) rad."""
    slope = pieces.edges[4, : pieces.number]
    # By NumPy: the compiled function may differ in the last bit.
    return slope if pieces.level else np.arctan(slope)


@compiled_inline
def _is_face(cell: int, vertical: np.ndarray) -> bool:
    """Whether a cell, between vertices cell - 1 and cell, is a vertical face of the window."""
    return 0 < cell < len(vertical) and vertical[cell]


@compiled_inline
def _is_level(cell: int, heights: np.ndarray, vertical: np.ndarray) -> bool:
    """Whether a cell of the window is level."""
    if not 0 < cell < len(heights) or vertical[cell]:
        return False
    return abs(heights[cell] - heights[cell - 1]) < EPSILON


@compiled
def _mark(
    start: int,
    heights: np.ndarray,
    vertical: np.ndarray,
    tolerance: float,
    kink: float,
    marks: np.ndarray,
) -> None:
    """Marks the vertices between pieces in marks[0]; other rows of marks, (3, m), are scratch."""
    cuts, mandatory, whole = marks[0], marks[1], marks[2]
    count, any_sloped = len(heights), False
    for i in range(count):
        left, right = _is_level(i, heights, vertical), _is_level(i + 1, heights, vertical)
        before, after = _is_face(i, vertical), _is_face(i + 1, vertical)
        cuts[i] = left != right or before or after or i == 0 or i == count - 1
        if not cuts[i]:
            bend = heights[i + 1] - 2 * heights[i] + heights[i - 1]
            cuts[i] = abs(bend) > kink * SPACING
        any_sloped |= i > 0 and not (left or before)
    if not any_sloped:
        return
    # The cell next to a vertical face becomes a separate piece: a level post with a vertical side.
    for i in range(1, count):
        if not (_is_level(i, heights, vertical) or vertical[i]):
            cuts[i] |= _is_face(i - 1, vertical)
            cuts[i - 1] |= _is_face(i + 1, vertical)
    for i in range(count):
        mandatory[i] = cuts[i]
    offset = -start % PIECE
    for i in range(offset, count, PIECE):
        level = _is_level(i, heights, vertical) and _is_level(i + 1, heights, vertical)
        cuts[i] |= not level
    # For each span of the current length, whether it contains no cut.
    for k in range((count - 1 - offset) // PIECE):
        whole[k] = True
        for i in range(offset + k * PIECE + 1, offset + (k + 1) * PIECE):
            whole[k] &= not cuts[i]
    for doubling in range(1, DOUBLINGS + 1):
        half, span = PIECE << (doubling - 1), PIECE << doubling
        first_half, offset = offset, -start % span
        skipped = (offset - first_half) // half
        for k in range((count - 1 - offset) // span):
            # A span may be one piece if both halves are pieces, no cut between them is mandatory,
            # and the profile stays close to the chord.
            first = offset + k * span
            middle = first + half
            whole[k] = whole[skipped + 2 * k] and whole[skipped + 2 * k + 1]
            if whole[k] and cuts[middle] and not mandatory[middle]:
                cuts[middle] = _stray(first, span, heights) >= tolerance
            whole[k] &= not cuts[middle]


@compiled_inline
def _stray(first: int, span: int, heights: np.ndarray) -> float:
    """Largest deviation of a profile from the chord of a span, m."""
    most, rise = 0.0, heights[first + span] - heights[first]
    for k in range(span):
        most = max(most, abs(heights[first + k] - (heights[first] + rise * (k / span))))
    return most


@compiled
def _join(
    start: int,
    heights: np.ndarray,
    vertical: np.ndarray,
    marks: np.ndarray,
    ends: np.ndarray,
    edges: np.ndarray,
) -> tuple[int, bool]:
    """Finds the pieces between the marks; returns their number, and whether all are level."""
    count, begin, steepest = 0, 0, 0.0
    for end in range(1, len(heights)):
        if not marks[0, end]:
            continue
        a, b = begin, end
        begin = end
        if b - a == 1 and _is_face(b, vertical):
            # A vertical cell is not a piece, but its left vertex is one if the previous cell is
            # also vertical.
            if not _is_face(a, vertical):
                continue
            b = a
        at_left, at_right = _is_face(a, vertical), _is_face(b + 1, vertical)
        z0, z1 = heights[a], heights[b]
        if b - a <= 1 and (at_left or at_right):
            # Posts are level; the height is that of the vertex at the face.
            if at_left:
                z1 = z0
            else:
                z0 = z1
        ends[0, count], ends[1, count] = a, b
        edges[0, count] = (start + a - (0.5 if at_left else 0.0)) * SPACING
        edges[1, count] = z0
        edges[2, count] = (start + b + (0.5 if at_right else 0.0)) * SPACING
        edges[3, count] = z1
        edges[4, count] = (z1 - z0) / (edges[2, count] - edges[0, count])
        steepest = max(steepest, abs(z1 - z0))
        count += 1
    return count, steepest < EPSILON


@compiled
def pose(pieces: Pieces, vertical: np.ndarray, angle: np.ndarray, end: float, boxes: Boxes) -> None:
    """Writes pieces to the first of the boxes, and parks the others; changes `pieces.edges`.

    Args:
      pieces: at most as many as there are boxes.
      vertical: the vertical faces of the profile.
      angle: angle of each piece, see `angles`.
      end: x of the unused boxes, m.
      boxes: the boxes.
    """
    count, level, ends, edges = pieces
    if not level:
        _run_on(count, vertical, ends, edges)
    right_face = math.inf
    for k in range(count - 1, -1, -1):  # distance to the face on the right, in half_size
        if _is_face(ends[1, k] + 1, vertical):
            right_face = min(right_face, edges[2, k])
        boxes.half_size[k, 2] = right_face - edges[2, k]
    left_face = -math.inf
    for k in range(count):
        x0, z0, x1, z1 = edges[0, k], edges[1, k], edges[2, k], edges[3, k]
        if _is_face(ends[0, k], vertical):
            left_face = max(left_face, x0)
        boxes.position[k, 1] = boxes.quaternion[k, 1] = boxes.quaternion[k, 3] = 0.0
        boxes.half_size[k, 1] = HALF_WIDTH
        lowest = z0
        if k > 0:
            lowest = min(lowest, edges[3, k - 1])
        if k < count - 1:
            lowest = min(lowest, edges[1, k + 1])
        thick = max(LEVEL_THICKNESS, z0 - lowest + BELOW)
        if level:
            boxes.position[k, 0], boxes.position[k, 2] = 0.5 * (x0 + x1), z0 - 0.5 * thick
            boxes.half_size[k, 0], boxes.half_size[k, 2] = 0.5 * (x1 - x0), 0.5 * thick
            boxes.quaternion[k, 0], boxes.quaternion[k, 2] = 1.0, 0.0
            continue
        slope, sine, cosine = edges[4, k], math.sin(angle[k]), math.cos(angle[k])
        thickness = thick
        if abs(slope) > EPSILON:
            # The lower end of a tilted box overhangs: to the right where the ground rises, else to
            # the left. It must not protrude from the next face on that side, nor beyond a ridge.
            room = boxes.half_size[k, 2] if slope > 0 else x0 - left_face
            steep = max(abs(sine), EPSILON)
            thickness = min(TILTED_THICKNESS, LEAN * room / steep)
            room = _room(k, count, thickness * steep, edges)
            thickness = min(thickness, max(THINNEST, LEAN * room / steep))
        boxes.position[k, 0] = 0.5 * (x0 + x1) + 0.5 * thickness * sine
        boxes.position[k, 2] = 0.5 * (z0 + z1) - 0.5 * thickness * cosine
        boxes.half_size[k, 0] = 0.5 * np.hypot(x1 - x0, z1 - z0)
        boxes.half_size[k, 2] = 0.5 * thickness
        boxes.quaternion[k, 0] = math.cos(0.5 * angle[k])
        boxes.quaternion[k, 2] = -math.sin(0.5 * angle[k])
    for k in range(count, len(boxes.position)):
        boxes.position[k, 0], boxes.position[k, 1], boxes.position[k, 2] = end, 0.0, PARKED
        boxes.half_size[k, 0] = boxes.half_size[k, 1] = boxes.half_size[k, 2] = 0.1


@compiled
def _room(k: int, count: int, overhang: float, edges: np.ndarray) -> float:
    """Distance from the upper end of a tilted piece to ground that is below the end of its box, m.

    Such ground, beyond a ridge, falls more steeply than the end face of the box, which the box
    extends by `overhang`, m, to that side. Infinite if there is none.
    """
    side = 1 if edges[4, k] > 0 else -1  # of the upper end
    near, far = (0, 2) if side > 0 else (2, 0)  # ends of the pieces on that side
    x, z, j = edges[far, k], edges[far + 1, k], k + side
    while 0 <= j < count and side * (edges[near, j] - x) < overhang:
        if side * (edges[far, j] - x) < (z - edges[far + 1, j]) * abs(edges[4, k]):
            return max(0.0, side * (edges[near, j] - x))
        j += side
    return math.inf


@compiled
def _run_on(count: int, vertical: np.ndarray, ends: np.ndarray, edges: np.ndarray) -> None:
    """Extends pieces below each other at valleys, so that a sliding foot hits no end face."""
    length = edges[2, 0] - edges[0, 0]  # of the current piece, before it is extended
    for k in range(count - 1):
        following = edges[2, k + 1] - edges[0, k + 1]
        joined = ends[1, k] == ends[0, k + 1] and not _is_face(ends[1, k] + 1, vertical)
        if joined and edges[4, k + 1] > edges[4, k] + EPSILON:
            right, left = min(OVERLAP, following), min(OVERLAP, length)
            edges[2, k] += right
            edges[3, k] += right * edges[4, k]
            edges[0, k + 1] -= left
            edges[1, k + 1] -= left * edges[4, k + 1]
        length = following
