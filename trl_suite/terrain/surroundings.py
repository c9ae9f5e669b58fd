"""What n characters stand on and see: windows of their grounds, queried all at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from trl_suite.terrain.ground import Ground
from trl_suite.terrain.index import HALF, BoxIndex
from trl_suite.terrain.layout import GRID, NO_BOXES, TURN_DISTANCE, Boxes
from trl_suite.terrain.parameters import Terrain

SHIFT = 4.0  # m; windows are centred on multiples of it, and laid anew beyond it
VERTICES = round(2 * HALF / GRID) + 1  # of a window, along each axis
PROBES = 6  # draws by which the number of boxes of a window is foreseen
SPARE = 1.3  # times the most boxes of any probe
SAMPLES = 32  # of a map, along each axis
AHEAD = (-1.0, 10.0)  # m; along the heading, from where to where a map reaches
ASIDE = 5.5  # m; to each side
_SPACING = (AHEAD[1] - AHEAD[0]) / (SAMPLES - 1), 2 * ASIDE / (SAMPLES - 1)  # m
_FORWARD = np.linspace(*AHEAD, SAMPLES)
_RIGHT = np.linspace(-ASIDE, ASIDE, SAMPLES)[:, None]
_CHUNK = 16  # rows whose maps are made at once: they fit into the processor's cache
_CELLS_PER_METRE = 1 / GRID
_LAST = VERTICES - 1.0 - 1e-6
_CORNERS = (0, VERTICES, 1, VERTICES + 1)  # of a cell: near, along x, along y, far

Rows = slice | np.ndarray
ALL = slice(None)


class Capacity(NamedTuple):
    """The most that a window of a terrain holds."""

    level: bool  # whether there is a plane
    grid: bool  # whether there is a height grid
    boxes: int
    belts: int
    movers: int
    strips: bool  # whether all boxes reach from the right rim to the left one


def capacity(terrain: Terrain) -> Capacity:
    """Foresees what windows of a terrain hold, from a few fixed draws."""
    found, counts, finite, strips = [], [], True, True
    for blend in range(max(1, len(terrain.parameter_sets))):
        for seed in range(PROBES):
            layout = Ground(terrain, seed, blend=blend).layout
            finite &= isinstance(layout.boxes, Boxes)
            for centre in ((0.0, 0.0), (SHIFT * seed, -SHIFT * seed)):
                low, high = np.array(centre) - HALF, np.array(centre) + HALF
                boxes = layout.boxes_in(low, high)
                counts.append(len(boxes.top))
                beside = np.abs(boxes.position[:, 1] - centre[1]) + HALF - boxes.extent()[:, 1]
                strips &= layout.belts is None and bool((beside <= 0).all())
            if isinstance(layout.boxes, Boxes):
                counts.append(len(layout.boxes.top))
            found.append(
                Capacity(
                    layout.level is not None,
                    layout.grid is not None,
                    0,
                    0 if layout.belts is None else len(layout.belts.velocity),
                    0 if layout.movers is None else len(layout.movers.speed),
                    False,
                )
            )
    most, least = max(counts), min(counts)
    if not finite and most:
        most = min(round(SPARE * most) + PROBES, most + 3 * (most - least) + 3)
    largest = Capacity(*(max(part) for part in zip(*found, strict=True)))
    return largest._replace(boxes=most, strips=strips)


class Surroundings:
    """Windows of n grounds, 32 m x 32 m about each character, for queries over a batch axis.

    A query answers for all characters at once, exactly as `Ground` would, as long as it stays within
    the window; beyond it, it answers for the rim. `follow` keeps every character so near the middle
    that all it sees in a map lies inside.

    Attributes:
      grounds: of each character.
      centre: middles of the windows, m, (n, 2).
      boxes: in each window, in order of x.
      way: how far moving boxes are from the start of their ways, m, (n, M).
      direction: 1 where they go towards the end, -1 towards the start, (n, M).
      start, axis, length, half_size, speed: of their ways and of themselves; see `Movers`.
    """

    def __init__(self, n: int, capacity: Capacity) -> None:
        self.n, self.capacity = n, capacity
        self.grounds: list[Ground | None] = [None] * n
        self.boxes: list[Boxes] = [NO_BOXES] * n
        self.centre = np.zeros((n, 2))
        self._row = np.arange(n)[:, None]
        self._level = np.full((n, 1), -np.inf)
        self._low = np.zeros((n, 2))  # corner of the window, m
        if capacity.grid:
            self._grid = np.zeros((n, VERTICES * VERTICES), np.float32)  # along x, then y
        self._index = BoxIndex(n, capacity.boxes, capacity.belts, capacity.strips)
        movers = (n, capacity.movers)
        self.start, self.axis, self.half_size = np.zeros((3, *movers, 2))
        self.length, self.speed, self.way, self._mover_top = np.zeros((4, *movers))
        self.direction = np.ones(movers)

    @property
    def windowed(self) -> bool:
        """Whether there is anything that a window must be laid for."""
        return self.capacity.grid or self.capacity.boxes + self.capacity.belts > 0

    @property
    def moving(self) -> bool:
        """Whether any surface may move."""
        return self.capacity.belts > 0 or self.capacity.movers > 0

    def begin(self, row: int, ground: Ground, xy: npt.ArrayLike = (0.0, 0.0)) -> None:
        """Puts a character on another ground, moving boxes as they begin.

        Args:
          row: which character.
          ground: of a terrain like the one whose capacity this was made for.
          xy: where the character is, m.

        Raises:
          ValueError: the ground is of another kind than the probes led to expect.
        """
        layout, capacity = ground.layout, self.capacity
        belts = 0 if layout.belts is None else len(layout.belts.velocity)
        movers = 0 if layout.movers is None else len(layout.movers.speed)
        if (
            (layout.level is not None) > capacity.level
            or (layout.grid is not None) > capacity.grid
            or belts > capacity.belts
            or movers > capacity.movers
        ):
            raise ValueError(
                f'a ground of type {ground.type!r} holds more than {capacity}, which {PROBES} draws '
                'led to expect: its generator must make the same kinds of things every time'
            )
        self.grounds[row] = ground
        self._level[row] = -np.inf if layout.level is None else layout.level
        self.half_size[row], self.speed[row] = -1.0, 0.0
        if layout.movers is not None:
            part = layout.movers
            self.start[row, :movers], self.axis[row, :movers] = part.start, part.axis
            self.length[row, :movers], self.speed[row, :movers] = part.length, part.speed
            self.half_size[row, :movers] = part.half_size
            self._mover_top[row, :movers] = self._level[row] + part.height
            self.way[row, :movers] = part.phase * part.length
            self.direction[row, :movers] = part.direction
        self._lay(row, np.round(np.asarray(xy, float) / SHIFT) * SHIFT)

    def follow(self, xy: np.ndarray, rows: np.ndarray | None = None) -> list[int]:
        """Keeps the windows about the characters.

        Args:
          xy: where they are, m, (n, 2), or of the given rows only.
          rows: sorted numbers of characters; None for all.

        Returns:
          Whose windows were laid anew.
        """
        if not self.windowed:
            return []
        moved = np.abs(xy - (self.centre if rows is None else self.centre[rows]))
        if not moved.max(initial=0.0) > SHIFT:
            return []
        far = np.flatnonzero(moved.max(1) > SHIFT)
        leaving = (far if rows is None else rows[far]).tolist()
        for row, centre in zip(leaving, np.round(xy[far] / SHIFT) * SHIFT, strict=True):
            self._lay(row, centre)
        return leaving

    def advance(self, dt: float, xy: np.ndarray, rows: Rows = ALL) -> None:
        """Moves moving boxes, where no physics does.

        Args:
          dt: s.
          xy: where the characters of the rows are, m.
          rows: which ones.
        """
        self.way[rows] += self.direction[rows] * self.speed[rows] * dt
        self.turn(xy, rows)

    def turn(self, xy: np.ndarray, rows: Rows = ALL) -> None:
        """Turns moving boxes round that are at an end of their way and far from their character.

        Nearer than 5 m they go straight on, beyond the end if need be, until they are not.
        """
        away = self.centres(rows) - xy[:, None]
        far = np.square(away).sum(2) > TURN_DISTANCE**2
        way, direction = self.way[rows], self.direction[rows]
        direction = np.where(far & (way <= 0), 1.0, direction)
        self.direction[rows] = np.where(far & (way >= self.length[rows]), -1.0, direction)

    def centres(self, rows: Rows = ALL) -> np.ndarray:
        """Middles of the moving boxes, m, (rows, M, 2)."""
        return self.start[rows] + self.way[rows][..., None] * self.axis[rows]

    def grid(self, row: int) -> np.ndarray:
        """The height grid of a window, along x, then y, m, (VERTICES, VERTICES)."""
        return self._grid[row].reshape(VERTICES, VERTICES)

    # Queries.

    def height(self, x: np.ndarray, y: np.ndarray, rows: Rows = ALL) -> np.ndarray:
        """Heights of the surface at points (rows, k), m."""
        return self._look(x, y, rows)[0]

    def velocity(self, x: np.ndarray, y: np.ndarray, rows: Rows = ALL) -> np.ndarray:
        """Horizontal velocities of the surface at points (rows, k), m/s, (rows, k, 2)."""
        if not self.moving:
            return np.zeros((*x.shape, 2))
        velocity = self._look(x, y, rows, np.zeros((2, *x.shape)))[1]
        assert velocity is not None
        return np.moveaxis(velocity, 0, 2)

    def height_map(
        self,
        xy: np.ndarray,
        heading: np.ndarray,
        rows: Rows = ALL,
        out: np.ndarray | None = None,
    ) -> np.ndarray:
        """Heights around characters, relative to the surface under them.

        32 x 32 samples in the heading frame: from 1 m behind to 10 m ahead, 5.5 m to each side,
        0.355 m apart. Sample 32 v + u is the u-th from behind of the v-th line from the left.

        Args:
          xy: where the characters are, m, (rows, 2).
          heading: rad, (rows,).
          rows: which characters.
          out: where to write, (rows, 1024).

        Returns:
          Heights in m, (rows, 1024).
        """
        out = np.empty((len(xy), SAMPLES**2)) if out is None else out
        under = self.height(xy[:, :1], xy[:, 1:], rows)
        for part, chosen in self._chunks(rows, len(xy)):
            heights, _ = self._map(xy[part], heading[part], chosen, None)
            np.subtract(heights, under[part], out=out[part])
        return out

    def velocity_map(
        self,
        xy: np.ndarray,
        heading: np.ndarray,
        rows: Rows = ALL,
        out: np.ndarray | None = None,
    ) -> np.ndarray:
        """Velocities of the surface around characters, relative to the surface under them.

        Arguments are those of `height_map`.

        Returns:
          Velocities in m/s, (rows, 2048): along the heading at the samples of a height map, then
          to the right of it.
        """
        count = SAMPLES**2
        out = np.empty((len(xy), 2 * count)) if out is None else out
        if not self.moving:
            out[...] = 0.0
            return out
        under = self.velocity(xy[:, :1], xy[:, 1:], rows)
        for part, chosen in self._chunks(rows, len(xy)):
            velocity = np.zeros((2, len(xy[part]), count))
            self._map(xy[part], heading[part], chosen, velocity)
            x, y = velocity
            x -= under[part, :, 0]
            y -= under[part, :, 1]
            cosine, sine = np.cos(heading[part])[:, None], np.sin(heading[part])[:, None]
            np.add(cosine * x, sine * y, out=out[part, :count])
            np.subtract(sine * x, cosine * y, out=out[part, count:])
        return out

    def _chunks(self, rows: Rows, count: int) -> Sequence[tuple[slice, Rows]]:
        parts = [slice(i, min(i + _CHUNK, count)) for i in range(0, count, _CHUNK)]
        if isinstance(rows, slice):
            first = rows.indices(self.n)[0]  # rows of a slice are neighbours
            return [(part, slice(first + part.start, first + part.stop)) for part in parts]
        return [(part, rows[part]) for part in parts]

    def _map(
        self, xy: np.ndarray, heading: np.ndarray, rows: Rows, velocity: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Heights at the samples of maps, (rows, 1024); adds velocities, (2, rows, 1024)."""
        count = len(xy)
        cosine, sine = np.cos(heading)[:, None, None], np.sin(heading)[:, None, None]
        x, y = xy[:, :1, None], xy[:, 1:, None]
        points_x = ((x + cosine * _FORWARD) + sine * _RIGHT).reshape(count, -1)
        points_y = ((y + sine * _FORWARD) - cosine * _RIGHT).reshape(count, -1)
        heights, velocity = self._look(points_x, points_y, rows, velocity, movers=False)
        if not self.capacity.movers:
            return heights, velocity
        # Where in the map the boxes are, in samples; of those in reach only the samples nearby.
        centres, half = self.centres(rows), self.half_size[rows]
        away = centres - xy[:, None]
        u = (cosine[..., 0] * away[..., 0] + sine[..., 0] * away[..., 1] - AHEAD[0]) / _SPACING[0]
        v = (sine[..., 0] * away[..., 0] - cosine[..., 0] * away[..., 1] + ASIDE) / _SPACING[1]
        reach = np.hypot(half[..., 0], half[..., 1]) / min(_SPACING)
        near = (np.abs(u - 0.5 * (SAMPLES - 1)) < 0.5 * SAMPLES + reach) & (half[..., 0] >= 0)
        near &= np.abs(v - 0.5 * (SAMPLES - 1)) < 0.5 * SAMPLES + reach
        row, box = np.nonzero(near)
        if not len(row):
            return heights, velocity
        tops = self._mover_top[rows][row, box]
        order = np.argsort(tops, kind='stable')  # of two boxes at a sample the higher is put last
        row, box, tops = row[order], box[order], tops[order]
        patch = np.arange(int(2 * reach[row, box].max()) + 2)
        first_u = np.ceil(u[row, box] - reach[row, box]).astype(int)
        first_v = np.ceil(v[row, box] - reach[row, box]).astype(int)
        i = (first_u[:, None] + patch)[:, None, :]
        j = (first_v[:, None] + patch)[:, :, None]
        inside = (i >= 0) & (i < SAMPLES) & (j >= 0) & (j < SAMPLES)
        sample = row[:, None, None] * SAMPLES**2 + np.where(inside, SAMPLES * j + i, 0)
        middle, half = centres[row, box][:, None, None], half[row, box][:, None, None]
        inside &= np.abs(points_x.ravel()[sample] - middle[..., 0]) <= half[..., 0]
        inside &= np.abs(points_y.ravel()[sample] - middle[..., 1]) <= half[..., 1]
        top = np.broadcast_to(tops[:, None, None], inside.shape)
        inside &= top > heights.ravel()[sample]
        hit = sample[inside]
        heights.ravel()[hit] = top[inside]
        if velocity is not None:
            speed = (self.direction[rows] * self.speed[rows])[row, box]
            for axis in (0, 1):
                along = np.broadcast_to(
                    (speed * self.axis[rows][row, box, axis])[:, None, None], inside.shape
                )
                velocity[axis].ravel()[hit] = along[inside]
        return heights, velocity

    def _look(
        self,
        x: np.ndarray,
        y: np.ndarray,
        rows: Rows,
        velocity: np.ndarray | None = None,
        movers: bool = True,
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Heights at points (rows, k); puts velocities of what moves into (2, rows, k)."""
        heights = np.empty(x.shape)
        if self.capacity.grid:
            self._on_grid(x, y, rows, heights)
            if self.capacity.level:
                np.maximum(heights, self._level[rows], out=heights)
        else:
            heights[...] = self._level[rows]
        if self.capacity.boxes + self.capacity.belts:
            self._index.cover(x, y, self._low[rows], self._row[rows], heights, velocity)
        if movers and self.capacity.movers:
            centres, half = self.centres(rows), self.half_size[rows]
            inside = np.abs(x[..., None] - centres[:, None, :, 0]) <= half[:, None, :, 0]
            inside &= np.abs(y[..., None] - centres[:, None, :, 1]) <= half[:, None, :, 1]
            tops = np.where(inside, self._mover_top[rows][:, None], -np.inf)
            best = tops.argmax(2)
            top = np.take_along_axis(tops, best[..., None], 2)[..., 0]
            above = top > heights
            np.copyto(heights, top, where=above)
            if velocity is not None:
                speed = self.direction[rows] * self.speed[rows]
                for axis in (0, 1):
                    along = np.take_along_axis(speed * self.axis[rows][..., axis], best, 1)
                    np.copyto(velocity[axis], along, where=above)
        return heights, velocity

    def _on_grid(self, x: np.ndarray, y: np.ndarray, rows: Rows, heights: np.ndarray) -> None:
        """Writes heights of the grid at points (rows, k); see `ground.triangles`."""
        corner = self._low[rows]
        u, v = x - corner[:, :1], y - corner[:, 1:]
        u *= _CELLS_PER_METRE
        v *= _CELLS_PER_METRE
        np.clip(u, 0, _LAST, out=u)
        np.clip(v, 0, _LAST, out=v)
        i, j = u.astype(np.int32), v.astype(np.int32)
        u -= i
        v -= j
        i *= VERTICES
        i += j
        if self.n > 1:
            i += (self._row[rows] * VERTICES**2).astype(np.int32)
        # A plane through three vertices and, beyond the diagonal, what the fourth is off it.
        grid = self._grid.reshape(-1)
        base, along, aside, far = (
            grid[offset:].take(i, mode='clip').astype(float) for offset in _CORNERS
        )
        far += base
        far -= along
        far -= aside
        along -= base
        aside -= base
        beyond = u + v
        beyond -= 1
        np.maximum(beyond, 0, out=beyond)
        u *= along
        v *= aside
        beyond *= far
        np.add(base, u, out=heights)
        heights += v
        heights += beyond

    # State.

    def state(self, row: int) -> dict[str, Any]:
        """What is needed to restore the surroundings of one character exactly."""
        ground = self.grounds[row]
        if ground is None:
            return {'ground': None}
        return {
            'ground': ground.state(),
            'centre': self.centre[row].tolist(),
            'way': self.way[row].copy(),
            'direction': self.direction[row].copy(),
        }

    def restore(self, row: int, state: Mapping[str, Any]) -> None:
        """Restores the surroundings of one character."""
        if state['ground'] is not None:
            self.begin(row, Ground.from_state(state['ground']), state['centre'])
            self.way[row], self.direction[row] = state['way'], state['direction']

    def _lay(self, row: int, centre: np.ndarray) -> None:
        """Fills a window."""
        ground = self.grounds[row]
        assert ground is not None
        layout = ground.layout
        self.centre[row] = centre
        low, high = centre - HALF, centre + HALF
        self._low[row] = low
        if self.capacity.grid:
            if layout.grid is None:
                self._grid[row] = self._level[row]
            else:
                i, j = (np.arange(VERTICES) + round(edge / GRID) for edge in low.tolist())
                self._grid[row] = layout.vertices(i, j).reshape(-1)
        if not self.capacity.boxes + self.capacity.belts:
            return
        boxes = layout.boxes_in(low, high)
        if len(boxes.top) > self.capacity.boxes:  # those at the rim may be missing
            gap = np.abs(boxes.position - centre) - boxes.extent()
            nearest = np.argsort(gap.max(1), kind='stable')[: self.capacity.boxes]
            boxes = boxes.select(nearest)
        self.boxes[row] = boxes = boxes.select(np.argsort(boxes.position[:, 0], kind='stable'))
        self._index.fill(row, low, boxes, layout.belts)
