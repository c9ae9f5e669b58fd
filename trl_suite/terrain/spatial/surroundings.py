"""The ground around n characters: windows of their grounds, queried in batches."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from trl_suite.terrain.generators import BORDER
from trl_suite.terrain.parameters import Terrain
from trl_suite.terrain.spatial import windows as spatial_ground
from trl_suite.terrain.spatial.ground import SpatialGround
from trl_suite.terrain.spatial.layout import GRID, NO_BOXES, Belts, Boxes, Layout
from trl_suite.terrain.spatial.windows import (
    COSINE,
    DEPTH,
    HALF,
    HALF_X,
    HALF_Y,
    SHIFT,
    SINE,
    SLOPE,
    TOP,
    VERTICES,
    Capacity,
    SpatialWindows,
    X,
    Y,
    bin_of,
)
from trl_suite.util.compiled import compiled, packed

PROBES = 6  # random grounds from which the number of boxes of a window is estimated
SPARE = 1.3  # factor applied to the largest number of boxes in these grounds

EnvIds = slice | np.ndarray
ALL = slice(None)


def capacity(terrain: Terrain) -> Capacity:
    """Estimates the capacity that windows of a terrain need, from a few fixed seeds."""
    found, counts, totals, strips = [], [], set(), True
    for terrain_level in range(max(1, len(terrain.parameter_sets))):
        for seed in range(PROBES):
            layout = SpatialGround(terrain, seed, terrain_level=terrain_level).layout
            # Of boxes that are not a function there are no more than this, if it is always the same.
            totals.add(len(layout.boxes.top) if isinstance(layout.boxes, Boxes) else -1)
            for centre in ((0.0, 0.0), (SHIFT * seed, -SHIFT * seed)):
                low, high = np.array(centre) - HALF, np.array(centre) + HALF
                boxes = layout.boxes_in(low, high)
                counts.append(len(boxes.top))
                beside = np.abs(boxes.position[:, 1] - centre[1]) + HALF - boxes.extent()[:, 1]
                strips &= layout.belts is None and bool((beside <= 0).all())
            if isinstance(layout.boxes, Boxes):
                counts.append(len(layout.boxes.top))
            found.append(_parts(layout))
    most, least = max(counts), min(counts)
    if (len(totals) > 1 or totals == {-1}) and most:
        most = min(round(SPARE * most) + PROBES, most + 3 * (most - least) + 3)
    largest = Capacity(*(max(part) for part in zip(*found, strict=True)))
    return largest._replace(boxes=most, strips=strips)


def _parts(layout: Layout) -> Capacity:
    """The parts of a layout, other than boxes."""
    return Capacity(
        level=layout.level is not None,
        grid=layout.grid is not None,
        boxes=0,
        belts=0 if layout.belts is None else len(layout.belts.velocity),
        movers=0 if layout.movers is None else len(layout.movers.speed),
        strips=False,
    )


class Surroundings:
    """Windows of n grounds, 32 m x 32 m around each character, for queries over a batch axis.

    Within a window, results of queries equal those of `SpatialGround`; beyond it, those of the
    nearest point of its rim. `recentre` keeps every character near enough to the centre that its
    height map lies inside the window.

    Attributes:
      arrays: the windows, for the compiled functions of one simulation in
        `trl_suite.terrain.spatial.windows`, such as `height_map` and `velocity_map`.
      pack: the same as one argument, see `trl_suite.util.compiled.packed`.
      grounds: grounds of each character.
      boxes: boxes of each window, sorted by x.
    """

    def __init__(self, n: int, capacity: Capacity) -> None:
        self.capacity = capacity
        self.grounds: list[SpatialGround | None] = [None] * n
        self.boxes: list[Boxes] = [NO_BOXES] * n
        self.arrays: SpatialWindows = spatial_ground.empty(n, capacity)
        self.pack = packed(self.arrays)
        self._all_ids = np.arange(n)

    @property
    def windowed(self) -> bool:
        """Whether the terrain has any part that needs windows."""
        return self.capacity.grid or self.capacity.boxes + self.capacity.belts > 0

    def begin(self, env_id: int, ground: SpatialGround, xy: npt.ArrayLike = (0.0, 0.0)) -> None:
        """Assigns a new ground to a character, with moving boxes at their initial places.

        Args:
          env_id: index of the simulation.
          ground: ground whose terrain fits the capacity given to the constructor.
          xy: position of the character, m.

        Raises:
          ValueError: the ground has parts that the capacity does not provide for.
        """
        layout, capacity = ground.layout, self.capacity
        parts = _parts(layout)
        if any(part > most for part, most in zip(parts, capacity, strict=True)):
            raise ValueError(
                f'a ground of type {ground.type!r} has more parts than {capacity}, the capacity estimated '
                f'from {PROBES} samples; a generator must return the same kinds of parts in every episode, '
                'and as many belts and moving boxes'
            )
        arrays = self.arrays
        self.grounds[env_id] = ground
        arrays.level[env_id] = 0.0 if layout.level is None else layout.level
        arrays.mover_half_size[env_id], arrays.mover_speed[env_id] = -1.0, 0.0
        if layout.movers is not None:
            part, some = layout.movers, (env_id, slice(parts.movers))
            arrays.mover_start[some], arrays.mover_axis[some] = part.start, part.axis
            arrays.mover_length[some], arrays.mover_speed[some] = part.length, part.speed
            arrays.mover_half_size[some] = part.half_size
            arrays.mover_top[some] = arrays.level[env_id] + part.height
            arrays.mover_distance[some] = part.phase * part.length
            arrays.mover_direction[some] = part.direction
        self._lay(env_id, np.round(np.asarray(xy, float) / SHIFT) * SHIFT)

    def recentre(self, env_ids: np.ndarray, xy: np.ndarray) -> list[int]:
        """Moves the windows of characters that are more than 4 m from their centres.

        Args:
          env_ids: sorted indices of simulations, (m,).
          xy: positions of their characters, (m, 2) m.

        Returns:
          The simulations whose windows were refilled. Those of a character beyond `BORDER` stay
          where they are: its episode ends in the next step.
        """
        if not self.windowed:
            return []
        moved = np.abs(xy - self.arrays.centre[env_ids]).max(1)
        far = np.flatnonzero((moved > SHIFT) & (np.abs(xy).max(1) < BORDER))
        for env_id, centre in zip(env_ids[far], np.round(xy[far] / SHIFT) * SHIFT, strict=True):
            self._lay(env_id, centre)
        return env_ids[far].tolist()

    def centres(self, env_ids: EnvIds = ALL) -> np.ndarray:
        """Centres of the moving boxes, m, (simulations, M, 2)."""
        ground = self.arrays
        moved = ground.mover_distance[env_ids][..., None] * ground.mover_axis[env_ids]
        return ground.mover_start[env_ids] + moved

    def height(self, x: np.ndarray, y: np.ndarray, env_ids: EnvIds = ALL) -> np.ndarray:
        """Heights of the surface at points (simulations, k), m."""
        env_ids = self._all_ids[env_ids]
        x, y = np.ascontiguousarray(x, float), np.ascontiguousarray(y, float)
        for name, array in (('x', x), ('y', y)):
            if array.shape != (shape := (len(env_ids), *np.shape(x)[-1:])):
                raise ValueError(f'{name} has shape {array.shape}; expected {shape}')
        out = np.empty(x.shape)
        _heights(env_ids, x, y, self.pack, out)
        return out

    def state(self, env_id: int) -> dict[str, Any]:
        """Returns the state from which `restore` restores the surroundings of one character."""
        ground = self.grounds[env_id]
        if ground is None:
            return {'ground': None}
        return {
            'ground': ground.state(),
            'centre': self.arrays.centre[env_id].tolist(),
            'distance': self.arrays.mover_distance[env_id].copy(),
            'direction': self.arrays.mover_direction[env_id].copy(),
        }

    def restore(self, env_id: int, state: Mapping[str, Any]) -> None:
        """Restores the surroundings of one character."""
        if state['ground'] is not None:
            self.begin(env_id, SpatialGround.from_state(state['ground']), state['centre'])
            self.arrays.mover_distance[env_id] = state['distance']
            self.arrays.mover_direction[env_id] = state['direction']

    def _lay(self, env_id: int, centre: np.ndarray) -> None:
        """Fills a window."""
        ground = self.grounds[env_id]
        assert ground is not None
        layout = ground.layout
        arrays = self.arrays
        arrays.centre[env_id] = centre
        low, high = centre - HALF, centre + HALF
        boxes, some = NO_BOXES, self.capacity.boxes + self.capacity.belts > 0
        if some:
            boxes = layout.boxes_in(low, high)
        if layout.grid is not None:
            i, j = (np.arange(VERTICES) + round(edge / GRID) for edge in low.tolist())
            arrays.grid[env_id] = layout.vertices(i, j).reshape(-1)
        if layout.level is None:
            lowest = boxes.top - np.abs(boxes.slope) * boxes.half_size[:, 0]
            if layout.grid is not None:
                lowest = arrays.grid[env_id]
            arrays.level[env_id] = lowest.min(initial=0.0) - DEPTH
        if self.capacity.grid and layout.grid is None:
            arrays.grid[env_id] = arrays.level[env_id]
        if not some:
            return
        if len(boxes.top) > self.capacity.boxes:  # boxes at the rim may be missing
            gap = np.abs(boxes.position - centre) - boxes.extent()
            nearest = np.argsort(gap.max(1), kind='stable')[: self.capacity.boxes]
            boxes = boxes.select(nearest)
        self.boxes[env_id] = boxes = boxes.select(np.argsort(boxes.position[:, 0], kind='stable'))
        _fill(env_id, boxes, layout.belts, arrays)


@compiled
def _heights(
    env_ids: np.ndarray, x: np.ndarray, y: np.ndarray, ground: SpatialWindows, out: np.ndarray
) -> None:
    for k in range(len(env_ids)):
        for p in range(x.shape[1]):
            out[k, p] = spatial_ground.height(env_ids[k], x[k, p], y[k, p], ground)


def _fill(i: int, boxes: Boxes, belts: Belts | None, ground: SpatialWindows) -> None:
    """Replaces the boxes and belts of window i, whose centre is set already, and sorts them into bins.

    A query then tests only the boxes near its point. There are at most as many boxes as were allocated.
    """
    ground.boxes[i, :, HALF_X] = -1.0
    _put(i, 0, boxes, ground)
    if belts is not None:
        first = ground.boxes.shape[1] - len(belts.velocity)
        _put(i, first, belts.boxes, ground)
        ground.box_velocity[i, first:] = belts.velocity
    _sort(i, ground)


@compiled
def _put(i: int, first: int, boxes: Boxes, ground: SpatialWindows) -> None:
    """Writes boxes from index `first` on."""
    for k in range(len(boxes.top)):
        of = ground.boxes[i, first + k]
        of[X], of[Y] = boxes.position[k, 0], boxes.position[k, 1]
        of[HALF_X], of[HALF_Y] = boxes.half_size[k, 0], boxes.half_size[k, 1]
        of[COSINE], of[SINE] = math.cos(boxes.yaw[k]), math.sin(boxes.yaw[k])
        of[TOP], of[SLOPE] = boxes.top[k], boxes.slope[k]


@compiled
def _sort(i: int, ground: SpatialWindows) -> None:
    """Lists for each bin of a window the boxes that touch it, in ascending order."""
    bins, entries = ground.bins[i], ground.bin_boxes[i]
    boxes, columns, lines = ground.boxes.shape[1], bins.shape[0], bins.shape[1]
    bins[:] = 0
    for number in range(boxes):
        first, last, begin, end = _touched(i, number, ground)
        for column in range(first, last):
            for line in range(begin, end):
                bins[column, line, 1] += 1
    total = 0
    for column in range(columns):
        for line in range(lines):
            count = bins[column, line, 1]
            bins[column, line, 0] = bins[column, line, 1] = total
            total += count
    if total <= len(entries):
        for number in range(boxes):
            first, last, begin, end = _touched(i, number, ground)
            for column in range(first, last):
                for line in range(begin, end):
                    entries[bins[column, line, 1]] = number
                    bins[column, line, 1] += 1
    else:  # many large boxes: every bin lists all of them
        bins[:, :, 0], bins[:, :, 1] = 0, boxes
        for number in range(boxes):
            entries[number] = number
    for number in range(boxes):
        of = ground.boxes[i, number]
        across = abs(of[Y] - ground.centre[i, 1])
        if of[SINE] == 0.0 and across + HALF <= of[HALF_Y]:
            of[HALF_Y] = np.inf  # spans the window, so it extends beyond it


@compiled
def _touched(i: int, number: int, ground: SpatialWindows) -> tuple[int, int, int, int]:
    """The bins that a box touches: begin and end along x, begin and end along y."""
    of = ground.boxes[i, number]
    length, width = of[HALF_X], of[HALF_Y]
    if length < 0.0:
        return 0, 0, 0, 0
    cosine, sine = abs(of[COSINE]), abs(of[SINE])
    half_x, half_y = cosine * length + sine * width, sine * length + cosine * width
    x, y = of[X] - (ground.centre[i, 0] - HALF), of[Y] - (ground.centre[i, 1] - HALF)
    columns, lines = ground.bins.shape[1], ground.bins.shape[2]
    return (
        bin_of(x - half_x, columns),
        bin_of(x + half_x, columns) + 1,
        bin_of(y - half_y, lines),
        bin_of(y + half_y, lines) + 1,
    )
