"""Windows of the spatial grounds of n simulations, as arrays, and functions of one simulation.

For a point within the window of its simulation, 32 m x 32 m, results equal those of
`SpatialGround`; beyond the window, those of the nearest point of its rim. `Surroundings` fills the
arrays.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from trl_suite.terrain.generators import BORDER
from trl_suite.terrain.spatial.layout import GRID, TURN_DISTANCE
from trl_suite.util.compiled import compiled, compiled_inline, nearest_index

HALF = 16.0  # m; half side of a window
DEPTH = 10.0  # m; where ground ends, the surface is so far below the lowest part of the window
SHIFT = 4.0  # m; window centres are multiples of it; windows of characters farther away are moved
VERTICES = round(2 * HALF / GRID) + 1  # of the height grid of a window, along each axis
SQUARES = (32, 32)  # bins of a window along x and y
STRIPS = (256, 1)  # the same if all boxes reach from the right rim to the left one
ROOM = 8  # entries of `bin_boxes` per bin and box
SAMPLES = 32  # of a map, along each axis
AHEAD = (-1.0, 10.0)  # m; extent of a map along the heading
ASIDE = 5.5  # m; extent to each side
SPEED_ERROR = 0.005  # m/s; deviation above which the speed of moving boxes is restored
REGAINED = 1 / 30  # m/s; at most so much near the character, in each control step

FORWARD = np.linspace(*AHEAD, SAMPLES)  # m; of the samples of a map
RIGHT = np.linspace(-ASIDE, ASIDE, SAMPLES)
_BEHIND = AHEAD[0]
_PER_METRE_AHEAD = (SAMPLES - 1) / (AHEAD[1] - AHEAD[0])  # samples
_PER_METRE_ASIDE = (SAMPLES - 1) / (2 * ASIDE)
_PER_METRE = max(_PER_METRE_AHEAD, _PER_METRE_ASIDE)
_COUNT = SAMPLES * SAMPLES
_FAR_AWAY = TURN_DISTANCE**2
_CELLS_PER_METRE = 1 / GRID
_LAST = VERTICES - 1.0 - 1e-6
# m; maps of characters that are not farther from the centre along an axis end inside the window.
_INSIDE = HALF - math.hypot(AHEAD[1], ASIDE)

# Columns of `SpatialWindows.boxes`: the values of a box fill one cache line of the processor.
X, Y, HALF_X, HALF_Y, COSINE, SINE, TOP, SLOPE = range(8)


class Capacity(NamedTuple):
    """The largest numbers of parts in a window of a terrain."""

    level: bool  # whether there is a plane
    grid: bool  # whether there is a height grid
    boxes: int
    belts: int
    movers: int
    strips: bool  # whether all boxes reach from the right rim to the left one


class SpatialWindows(NamedTuple):
    """Windows of n grounds, with up to B boxes (belts come last) and M moving boxes each.

    Arrays of parts that a terrain does not have are of length 0 along their second axis. The arrays
    are changed in place and never replaced.
    """

    level: np.ndarray  # (n,) m; of the plane, or of a surface DEPTH below all parts
    centre: np.ndarray  # (n, 2) m
    grid: np.ndarray  # (n, VERTICES**2) m, single precision; vertices along x, then along y
    boxes: np.ndarray  # (n, B, 8); the columns above; HALF_X is -1 where there is no box
    box_velocity: np.ndarray  # (n, B, 2) m/s; of belts; (n, 0, 2) if there are none
    bins: np.ndarray  # (n, bins along x, along y, 2) int32; begin and end of each in bin_boxes
    bin_boxes: np.ndarray  # (n, k) int32; for every bin the indices of the boxes that touch it
    mover_start: np.ndarray  # (n, M, 2) m; where the path of a moving box starts
    mover_axis: np.ndarray  # (n, M, 2); unit vector along the path
    mover_length: np.ndarray  # (n, M) m; of the path
    mover_half_size: np.ndarray  # (n, M, 2) m; -1 where there is no box
    mover_top: np.ndarray  # (n, M) m
    mover_speed: np.ndarray  # (n, M) m/s
    mover_distance: np.ndarray  # (n, M) m; from the start of the path; changes as boxes move
    mover_direction: np.ndarray  # (n, M); 1 towards the end of the path, -1 towards its start
    mover_begin: np.ndarray  # (n, M) m; distance from the start of the path at joint position 0
    mover_qpos: np.ndarray  # (M,); addresses of the joints in the physics
    mover_dof: np.ndarray  # (M,)


def empty(n: int, capacity: Capacity) -> SpatialWindows:
    """Allocates n empty windows of a terrain."""
    boxes, movers = capacity.boxes + capacity.belts, capacity.movers
    bins = (STRIPS if capacity.strips else SQUARES) if boxes else (0, 0)
    ground = SpatialWindows(
        level=np.zeros(n),
        centre=np.zeros((n, 2)),
        grid=np.zeros((n, VERTICES**2 if capacity.grid else 0), np.float32),
        boxes=np.zeros((n, boxes, 8)),
        box_velocity=np.zeros((n, boxes if capacity.belts else 0, 2)),
        bins=np.zeros((n, *bins, 2), np.int32),
        bin_boxes=np.zeros((n, ROOM * (bins[0] * bins[1] + boxes)), np.int32),
        mover_start=np.zeros((n, movers, 2)),
        mover_axis=np.zeros((n, movers, 2)),
        mover_length=np.zeros((n, movers)),
        mover_half_size=np.full((n, movers, 2), -1.0),
        mover_top=np.zeros((n, movers)),
        mover_speed=np.zeros((n, movers)),
        mover_distance=np.zeros((n, movers)),
        mover_direction=np.ones((n, movers)),
        mover_begin=np.zeros((n, movers)),
        mover_qpos=np.zeros(movers, int),
        mover_dof=np.zeros(movers, int),
    )
    ground.boxes[:, :, HALF_X] = -1.0
    return ground


# Queries.


@compiled
def height(i: int, x: float, y: float, ground: SpatialWindows) -> float:
    """Returns the height in m of the surface of simulation i at a point, m."""
    return _highest(i, x, y, ground)[0]


@compiled
def velocity(i: int, x: float, y: float, ground: SpatialWindows) -> tuple[float, float]:
    """Returns the horizontal velocity in m/s of the surface of simulation i at a point, m."""
    return _velocity_of(i, _highest(i, x, y, ground)[1], ground)


@compiled
def height_map(
    i: int, x: float, y: float, heading: float, ground: SpatialWindows, out: np.ndarray
) -> None:
    """Writes heights around a character, relative to the surface under it.

    32 x 32 samples in the heading frame: from 1 m behind to 10 m ahead, 5.5 m to each side,
    0.355 m apart. Sample 32 v + u is the u-th from behind of the v-th line from the left.

    Args:
      i: index of the simulation.
      x, y: position of the character, m.
      heading: rad.
      ground: windows of all simulations.
      out: array for the heights in m, (1024,).
    """
    under, far = height(i, x, y, ground), _looks_out(i, x, y, ground)
    cosine, sine = math.cos(heading), math.sin(heading)
    for v in range(SAMPLES):
        for u in range(SAMPLES):
            at_x, at_y = _sample(u, v, x, y, cosine, sine)
            top = height(i, at_x, at_y, ground) if far else _fixed(i, at_x, at_y, ground)[0]
            out[SAMPLES * v + u] = top - under
    for k in range(ground.mover_top.shape[1]):
        begin_u, end_u, begin_v, end_v = _seen_part(i, k, x, y, cosine, sine, ground)
        for v in range(begin_v, end_v):
            for u in range(begin_u, end_u):
                at_x, at_y = _sample(u, v, x, y, cosine, sine)
                out[SAMPLES * v + u] = height(i, at_x, at_y, ground) - under


@compiled
def velocity_map(
    i: int, x: float, y: float, heading: float, ground: SpatialWindows, out: np.ndarray
) -> None:
    """Writes velocities of the surface around a character, relative to the surface under it.

    Arguments are those of `height_map`, but `out` is for velocities in m/s, (2048,): components
    along the heading at the samples of a height map, then components to the right of it.
    """
    belts, movers = ground.box_velocity.shape[1], ground.mover_top.shape[1]
    if belts + movers == 0:
        out[:] = 0.0
        return
    under, far = velocity(i, x, y, ground), _looks_out(i, x, y, ground)
    cosine, sine = math.cos(heading), math.sin(heading)
    still = _turned(0.0, 0.0, under, cosine, sine)
    for v in range(SAMPLES):
        for u in range(SAMPLES):
            ahead, aside = still
            if belts:
                at_x, at_y = _sample(u, v, x, y, cosine, sine)
                if far:
                    east, north = velocity(i, at_x, at_y, ground)
                else:
                    east, north = _velocity_of(i, _fixed(i, at_x, at_y, ground)[1], ground)
                ahead, aside = _turned(east, north, under, cosine, sine)
            out[SAMPLES * v + u], out[_COUNT + SAMPLES * v + u] = ahead, aside
    for k in range(movers):
        begin_u, end_u, begin_v, end_v = _seen_part(i, k, x, y, cosine, sine, ground)
        for v in range(begin_v, end_v):
            for u in range(begin_u, end_u):
                at_x, at_y = _sample(u, v, x, y, cosine, sine)
                east, north = velocity(i, at_x, at_y, ground)
                ahead, aside = _turned(east, north, under, cosine, sine)
                out[SAMPLES * v + u], out[_COUNT + SAMPLES * v + u] = ahead, aside


@compiled_inline
def is_lost(i: int, x: float, y: float, z: float, ground: SpatialWindows) -> bool:
    """Returns whether a character is beyond the edge of the ground or fell below its lowest part."""
    return not (abs(x) < BORDER and abs(y) < BORDER and z > ground.level[i] - DEPTH)


@compiled
def has_left(i: int, x: float, y: float, ground: SpatialWindows) -> bool:
    """Returns whether a character is so far from the centre that its window must be refilled."""
    if ground.grid.shape[1] + ground.boxes.shape[1] == 0:
        return False
    return abs(x - ground.centre[i, 0]) > SHIFT or abs(y - ground.centre[i, 1]) > SHIFT


@compiled_inline
def _is_far(i: int, k: int, x: float, y: float, ground: SpatialWindows) -> bool:
    """Whether moving box k is so far from the character at (x, y) that it may reverse."""
    middle_x, middle_y = _mover_middle(i, k, ground)
    away_x, away_y = middle_x - x, middle_y - y
    return away_x * away_x + away_y * away_y > _FAR_AWAY


@compiled
def turn_movers(i: int, x: float, y: float, ground: SpatialWindows) -> None:
    """Reverses moving boxes that are at an end of their path and far from the character at (x, y).

    Within 5 m of the character they continue straight on, even beyond the end of their path.
    """
    for k in range(ground.mover_top.shape[1]):
        if _is_far(i, k, x, y, ground):
            distance = ground.mover_distance[i, k]
            if distance >= ground.mover_length[i, k]:
                ground.mover_direction[i, k] = -1.0
            elif distance <= 0:
                ground.mover_direction[i, k] = 1.0


@compiled
def see_movers(i: int, qpos: np.ndarray, ground: SpatialWindows) -> None:
    """Updates the positions of moving boxes from qpos, which is that of all simulations."""
    for k in range(ground.mover_top.shape[1]):
        moved = qpos[i, ground.mover_qpos[k]]
        ground.mover_distance[i, k] = ground.mover_begin[i, k] + moved


@compiled
def keep_moving(
    i: int, x: float, y: float, qpos: np.ndarray, qvel: np.ndarray, ground: SpatialWindows
) -> bool:
    """Reverses moving boxes, and restores the speeds of all of them if one deviates.

    Near the character a box regains its speed slowly: if it could not be stopped, two of them would
    squeeze a leg between them with any force.

    Args:
      i: index of the simulation.
      x, y: position of its character, m.
      qpos, qvel: positions and velocities of all simulations; qvel is written.
      ground: windows of all simulations.

    Returns:
      Whether qvel was written; then the physics must be forwarded.
    """
    see_movers(i, qpos, ground)
    turn_movers(i, x, y, ground)
    wrong = False
    for k in range(ground.mover_top.shape[1]):
        speed = ground.mover_direction[i, k] * ground.mover_speed[i, k]
        wrong |= abs(qvel[i, ground.mover_dof[k]] - speed) > SPEED_ERROR
    if wrong:
        for k in range(ground.mover_top.shape[1]):
            speed = ground.mover_direction[i, k] * ground.mover_speed[i, k]
            if not _is_far(i, k, x, y, ground):  # else it may just have reversed
                now = qvel[i, ground.mover_dof[k]]
                speed = min(max(speed, now - REGAINED), now + REGAINED)
            qvel[i, ground.mover_dof[k]] = speed
    return wrong


# Parts of queries.


@compiled_inline
def _fixed(i: int, x: float, y: float, ground: SpatialWindows) -> tuple[float, int]:
    """Height of the static surface at a point of the window, and the index of its box, or -1."""
    top, box = ground.level[i], -1
    if ground.grid.shape[1]:
        on_grid = _on_grid(i, x, y, ground)
        if not on_grid < top:
            top = on_grid
    if ground.boxes.shape[1]:
        columns, lines = ground.bins.shape[1], ground.bins.shape[2]
        column = bin_of(x - (ground.centre[i, 0] - HALF), columns)
        line = bin_of(y - (ground.centre[i, 1] - HALF), lines)
        begin, end = ground.bins[i, column, line, 0], ground.bins[i, column, line, 1]
        for entry in range(begin, end):
            number = ground.bin_boxes[i, entry]
            east, north = x - ground.boxes[i, number, X], y - ground.boxes[i, number, Y]
            cosine, sine = ground.boxes[i, number, COSINE], ground.boxes[i, number, SINE]
            along, across = cosine * east + sine * north, cosine * north - sine * east
            if (
                abs(along) <= ground.boxes[i, number, HALF_X]
                and abs(across) <= ground.boxes[i, number, HALF_Y]
            ):
                upper = ground.boxes[i, number, TOP] + ground.boxes[i, number, SLOPE] * along
                if upper > top:
                    top, box = upper, number
    return top, box


@compiled_inline
def _highest(i: int, x: float, y: float, ground: SpatialWindows) -> tuple[float, int]:
    """As `_fixed`, but anywhere, and with moving boxes, whose indices start at B."""
    centre_x, centre_y = ground.centre[i, 0], ground.centre[i, 1]
    top, box = _fixed(i, _clamped(x, centre_x), _clamped(y, centre_y), ground)
    for k in range(ground.mover_top.shape[1]):
        middle_x, middle_y = _mover_middle(i, k, ground)
        if (
            abs(x - middle_x) <= ground.mover_half_size[i, k, 0]
            and abs(y - middle_y) <= ground.mover_half_size[i, k, 1]
            and ground.mover_top[i, k] > top
        ):
            top, box = ground.mover_top[i, k], ground.boxes.shape[1] + k
    return top, box


@compiled_inline
def _velocity_of(i: int, box: int, ground: SpatialWindows) -> tuple[float, float]:
    """Horizontal velocity of the surface of a box, m/s, by its index as in `_highest`."""
    if box >= ground.boxes.shape[1]:
        k = box - ground.boxes.shape[1]
        speed = ground.mover_direction[i, k] * ground.mover_speed[i, k]
        return speed * ground.mover_axis[i, k, 0], speed * ground.mover_axis[i, k, 1]
    if box >= 0 and ground.box_velocity.shape[1]:
        return ground.box_velocity[i, box, 0], ground.box_velocity[i, box, 1]
    return 0.0, 0.0


@compiled_inline
def _mover_middle(i: int, k: int, ground: SpatialWindows) -> tuple[float, float]:
    """Centre of a moving box, m."""
    distance = ground.mover_distance[i, k]
    return (
        ground.mover_start[i, k, 0] + distance * ground.mover_axis[i, k, 0],
        ground.mover_start[i, k, 1] + distance * ground.mover_axis[i, k, 1],
    )


@compiled_inline
def _on_grid(i: int, x: float, y: float, ground: SpatialWindows) -> float:
    """Height of the grid at a point, m; see `ground.triangles`."""
    u = (x - (ground.centre[i, 0] - HALF)) * _CELLS_PER_METRE
    v = (y - (ground.centre[i, 1] - HALF)) * _CELLS_PER_METRE
    column, u = _cell(u)
    line, v = _cell(v)
    cell = column * VERTICES + line
    # As doubles; Numba's `float` would not convert single precision.
    near, left = np.float64(ground.grid[i, cell]), np.float64(ground.grid[i, cell + 1])
    cell += VERTICES
    front, far = np.float64(ground.grid[i, cell]), np.float64(ground.grid[i, cell + 1])
    # A plane through three vertices and, beyond the diagonal, the offset of the fourth from it.
    off = far + near - front - left
    beyond = u + v - 1.0
    above = near + u * (front - near) + v * (left - near)
    return above + (beyond * off if beyond > 0.0 else 0.0)


@compiled_inline
def _cell(position: float) -> tuple[int, float]:
    """Index of the grid cell at a position, and the position in it, in cells; NaN stays NaN."""
    if position > _LAST:
        position = _LAST
    elif position < 0.0:
        position = 0.0
    cell = int(position) if position > 0.0 else 0
    return cell, position - cell


@compiled_inline
def _looks_out(i: int, x: float, y: float, ground: SpatialWindows) -> bool:
    """Whether a map of a character may reach beyond its window."""
    return abs(x - ground.centre[i, 0]) > _INSIDE or abs(y - ground.centre[i, 1]) > _INSIDE


@compiled_inline
def _clamped(position: float, centre: float) -> float:
    """The position in a window that is nearest to a coordinate, m."""
    if abs(position - centre) > HALF:
        return centre + math.copysign(HALF, position - centre)
    return position


@compiled_inline
def bin_of(distance: float, count: int) -> int:
    """Index of the bin at a distance from the rim of a window, m."""
    return nearest_index(distance * (count / (2 * HALF)), count)


@compiled_inline
def _sample(u: int, v: int, x: float, y: float, cosine: float, sine: float) -> tuple[float, float]:
    """Position of a sample of a map, m."""
    return (
        x + cosine * FORWARD[u] + sine * RIGHT[v],
        y + sine * FORWARD[u] - cosine * RIGHT[v],
    )


@compiled
def _seen_part(
    i: int, k: int, x: float, y: float, cosine: float, sine: float, ground: SpatialWindows
) -> tuple[int, int, int, int]:
    """Samples of a map that may lie on a moving box: begin and end of u, begin and end of v."""
    half_x, half_y = ground.mover_half_size[i, k, 0], ground.mover_half_size[i, k, 1]
    if half_x < 0.0:
        return 0, 0, 0, 0
    middle_x, middle_y = _mover_middle(i, k, ground)
    away_x, away_y = middle_x - x, middle_y - y
    u = (cosine * away_x + sine * away_y - _BEHIND) * _PER_METRE_AHEAD
    v = (sine * away_x - cosine * away_y + ASIDE) * _PER_METRE_ASIDE
    reach = math.hypot(half_x, half_y) * _PER_METRE + 1.0
    if not (-reach < u < SAMPLES + reach and -reach < v < SAMPLES + reach):
        return 0, 0, 0, 0
    return (
        nearest_index(u - reach, SAMPLES),
        nearest_index(u + reach, SAMPLES) + 1,
        nearest_index(v - reach, SAMPLES),
        nearest_index(v + reach, SAMPLES) + 1,
    )


@compiled_inline
def _turned(
    east: float, north: float, under: tuple[float, float], cosine: float, sine: float
) -> tuple[float, float]:
    """A velocity relative to that under the character, along the heading and to the right of it."""
    east, north = east - under[0], north - under[1]
    return cosine * east + sine * north, sine * east - cosine * north
