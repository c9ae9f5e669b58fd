"""The ground around n characters: windows of their grounds, queried in batches."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from trl_suite.terrain.parameters import Terrain
from trl_suite.terrain.planar.generators import BORDER
from trl_suite.terrain.spatial import index
from trl_suite.terrain.spatial import windows as spatial_ground
from trl_suite.terrain.spatial.ground import SpatialGround
from trl_suite.terrain.spatial.layout import GRID, NO_BOXES, Boxes
from trl_suite.terrain.spatial.windows import (
    DEPTH,
    HALF,
    SAMPLES,
    SHIFT,
    VERTICES,
    Capacity,
    SpatialWindows,
)
from trl_suite.util.compiled import compiled, packed

PROBES = 6  # random grounds from which the number of boxes of a window is estimated
SPARE = 1.3  # factor applied to the largest number of boxes in these grounds

EnvIds = slice | np.ndarray
ALL = slice(None)


def capacity(terrain: Terrain) -> Capacity:
    """Estimates the capacity that windows of a terrain need, from a few fixed seeds."""
    found, counts, finite, strips = [], [], True, True
    for terrain_level in range(max(1, len(terrain.parameter_sets))):
        for seed in range(PROBES):
            layout = SpatialGround(terrain, seed, terrain_level=terrain_level).layout
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
    """Windows of n grounds, 32 m x 32 m around each character, for queries over a batch axis.

    A query covers all characters at once. Within the window its result equals that of
    `SpatialGround`; beyond the window, that of the nearest point of its rim. `follow` keeps every
    character near enough to the centre that its height map lies inside the window.

    Attributes:
      arrays: the windows, for the compiled functions of one simulation in
        `trl_suite.terrain.spatial.windows`.
      pack: the same as one argument, see `trl_suite.util.compiled.packed`.
      grounds: grounds of each character.
      boxes: boxes of each window, sorted by x.
      centre: centres of the windows, m, (n, 2).
      distance: distances of moving boxes from the start of their paths, m, (n, M).
      direction: 1 where they move towards the end, -1 towards the start, (n, M).
      start, axis, length, half_size, speed: fields of the moving boxes and their paths; see `Movers`.
    """

    def __init__(self, n: int, capacity: Capacity) -> None:
        self.n, self.capacity = n, capacity
        self.grounds: list[SpatialGround | None] = [None] * n
        self.boxes: list[Boxes] = [NO_BOXES] * n
        self.arrays: SpatialWindows = spatial_ground.empty(n, capacity)
        self.pack = packed(self.arrays)
        self._numbers = np.arange(n)
        ground = self.arrays
        self.centre, self.distance, self.direction = (
            ground.centre, ground.mover_distance, ground.mover_direction,
        )  # fmt: skip
        self.start, self.axis, self.length = (
            ground.mover_start, ground.mover_axis, ground.mover_length,
        )  # fmt: skip
        self.half_size, self.speed = ground.mover_half_size, ground.mover_speed

    @property
    def windowed(self) -> bool:
        """Whether the terrain has any part that needs windows."""
        return self.capacity.grid or self.capacity.boxes + self.capacity.belts > 0

    @property
    def moving(self) -> bool:
        """Whether any surface can move."""
        return self.capacity.belts > 0 or self.capacity.movers > 0

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
        belts = 0 if layout.belts is None else len(layout.belts.velocity)
        movers = 0 if layout.movers is None else len(layout.movers.speed)
        if (
            (layout.level is not None) > capacity.level
            or (layout.grid is not None) > capacity.grid
            or belts > capacity.belts
            or movers > capacity.movers
        ):
            raise ValueError(
                f'a ground of type {ground.type!r} has more parts than {capacity}, the capacity estimated '
                f'from {PROBES} samples; a generator must return the same kinds of parts in every episode'
            )
        arrays = self.arrays
        self.grounds[env_id] = ground
        arrays.level[env_id] = 0.0 if layout.level is None else layout.level
        self.half_size[env_id], self.speed[env_id] = -1.0, 0.0
        if layout.movers is not None:
            part = layout.movers
            self.start[env_id, :movers], self.axis[env_id, :movers] = part.start, part.axis
            self.length[env_id, :movers], self.speed[env_id, :movers] = part.length, part.speed
            self.half_size[env_id, :movers] = part.half_size
            arrays.mover_top[env_id, :movers] = arrays.level[env_id] + part.height
            self.distance[env_id, :movers] = part.phase * part.length
            self.direction[env_id, :movers] = part.direction
        self._lay(env_id, np.round(np.asarray(xy, float) / SHIFT) * SHIFT)

    def follow(self, xy: np.ndarray, env_ids: np.ndarray | None = None) -> list[int]:
        """Moves the windows of characters that are more than 4 m from their centres.

        Args:
          xy: positions of the characters, m, (n, 2), or of the given simulations only.
          env_ids: sorted indices of simulations; None for all.

        Returns:
          The simulations whose windows were refilled. Those of a character beyond `BORDER` stay
          where they are: its episode ends in the next step.
        """
        if not self.windowed:
            return []
        moved = np.abs(xy - (self.centre if env_ids is None else self.centre[env_ids]))
        if not moved.max(initial=0.0) > SHIFT:
            return []
        far = np.flatnonzero((moved.max(1) > SHIFT) & (np.abs(xy).max(1) < BORDER))
        leaving = (far if env_ids is None else env_ids[far]).tolist()
        for env_id, centre in zip(leaving, np.round(xy[far] / SHIFT) * SHIFT, strict=True):
            self._lay(env_id, centre)
        return leaving

    def advance(self, dt: float, xy: np.ndarray, env_ids: EnvIds = ALL) -> None:
        """Advances the moving boxes, for use without a physics engine.

        Args:
          dt: duration, s.
          xy: positions of the characters of these simulations, m.
          env_ids: indices of the simulations.
        """
        self.distance[env_ids] += self.direction[env_ids] * self.speed[env_ids] * dt
        self.turn(xy, env_ids)

    def turn(self, xy: np.ndarray, env_ids: EnvIds = ALL) -> None:
        """Reverses moving boxes that are at an end of their path and far from their character.

        Within 5 m of the character they continue straight on, even beyond the end of their path.
        """
        env_ids = self._numbers[env_ids]
        _turn_all(env_ids, positions(xy, len(env_ids)), self.pack)

    def centres(self, env_ids: EnvIds = ALL) -> np.ndarray:
        """Centres of the moving boxes, m, (simulations, M, 2)."""
        return self.start[env_ids] + self.distance[env_ids][..., None] * self.axis[env_ids]

    def grid(self, env_id: int) -> np.ndarray:
        """The height grid of a window, along x, then y, m, (VERTICES, VERTICES)."""
        return self.arrays.grid[env_id].reshape(VERTICES, VERTICES)

    # Queries.

    def height(self, x: np.ndarray, y: np.ndarray, env_ids: EnvIds = ALL) -> np.ndarray:
        """Heights of the surface at points (simulations, k), m."""
        out = np.empty(np.shape(x))
        self._points(_heights, x, y, env_ids, out)
        return out

    def velocity(self, x: np.ndarray, y: np.ndarray, env_ids: EnvIds = ALL) -> np.ndarray:
        """Horizontal surface velocities at points (simulations, k), m/s, (simulations, k, 2)."""
        out = np.zeros((*np.shape(x), 2))
        if self.moving:
            self._points(_velocities, x, y, env_ids, out)
        return out

    def height_map(
        self,
        xy: np.ndarray,
        heading: np.ndarray,
        env_ids: EnvIds = ALL,
        out: np.ndarray | None = None,
    ) -> np.ndarray:
        """Heights around characters, relative to the surface under them.

        32 x 32 samples in the heading frame: from 1 m behind to 10 m ahead, 5.5 m to each side,
        0.355 m apart. Sample 32 v + u is the u-th from behind of the v-th line from the left.

        Args:
          xy: positions of the characters, m, (simulations, 2).
          heading: rad, (simulations,).
          env_ids: indices of the simulations.
          out: array for the result, (simulations, 1024).

        Returns:
          Heights in m, (simulations, 1024).
        """
        out = np.empty((len(xy), SAMPLES**2)) if out is None else out
        self._maps(_height_maps, 1, xy, heading, env_ids, out)
        return out

    def velocity_map(
        self,
        xy: np.ndarray,
        heading: np.ndarray,
        env_ids: EnvIds = ALL,
        out: np.ndarray | None = None,
    ) -> np.ndarray:
        """Velocities of the surface around characters, relative to the surface under them.

        Arguments are those of `height_map`.

        Returns:
          Velocities in m/s, (simulations, 2048): components along the heading at the samples of a
          height map, then components to the right of it.
        """
        out = np.empty((len(xy), 2 * SAMPLES**2)) if out is None else out
        self._maps(_velocity_maps, 2, xy, heading, env_ids, out)
        return out

    def _points(
        self,
        query: Callable[..., None],
        x: npt.ArrayLike,
        y: npt.ArrayLike,
        env_ids: EnvIds,
        out: np.ndarray,
    ) -> None:
        """Calls a compiled loop over points."""
        env_ids = self._numbers[env_ids]
        x, y = np.ascontiguousarray(x, float), np.ascontiguousarray(y, float)
        if x.ndim != 2 or x.shape != y.shape or len(x) != len(env_ids):
            raise ValueError(
                f'x and y have shapes {x.shape} and {y.shape}; expected ({len(env_ids)}, k)'
            )
        query(env_ids, x, y, self.pack, out)

    def _maps(
        self,
        query: Callable[..., None],
        maps: int,
        xy: npt.ArrayLike,
        heading: npt.ArrayLike,
        env_ids: EnvIds,
        out: np.ndarray,
    ) -> None:
        """Calls a compiled loop over maps."""
        env_ids = self._numbers[env_ids]
        xy, heading = np.ascontiguousarray(xy, float), np.ascontiguousarray(heading, float)
        count = len(env_ids)
        expected = (count, 2), (count,), (count, maps * SAMPLES**2)
        if (xy.shape, heading.shape, out.shape) != expected:
            raise ValueError(
                f'xy, heading and out have shapes {xy.shape}, {heading.shape} and {out.shape}; '
                f'expected {expected[0]}, {expected[1]} and {expected[2]}'
            )
        query(env_ids, xy, heading, self.pack, out)

    # State.

    def state(self, env_id: int) -> dict[str, Any]:
        """Returns the state from which `restore` restores the surroundings of one character."""
        ground = self.grounds[env_id]
        if ground is None:
            return {'ground': None}
        return {
            'ground': ground.state(),
            'centre': self.centre[env_id].tolist(),
            'distance': self.distance[env_id].copy(),
            'direction': self.direction[env_id].copy(),
        }

    def restore(self, env_id: int, state: Mapping[str, Any]) -> None:
        """Restores the surroundings of one character."""
        if state['ground'] is not None:
            self.begin(env_id, SpatialGround.from_state(state['ground']), state['centre'])
            self.distance[env_id], self.direction[env_id] = state['distance'], state['direction']

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
        index.fill(env_id, boxes, layout.belts, arrays)


def positions(xy: npt.ArrayLike, count: int) -> np.ndarray:
    """Returns horizontal positions of characters for compiled functions, (count, 2).

    Raises:
      ValueError: they have another shape.
    """
    xy = np.ascontiguousarray(xy, float)
    if xy.shape != (count, 2):
        raise ValueError(f'xy has shape {xy.shape}; expected {(count, 2)}')
    return xy


@compiled
def _turn_all(env_ids: np.ndarray, xy: np.ndarray, ground: SpatialWindows) -> None:
    for k in range(len(env_ids)):
        spatial_ground.turn_movers(env_ids[k], xy[k, 0], xy[k, 1], ground)


@compiled
def _heights(
    env_ids: np.ndarray, x: np.ndarray, y: np.ndarray, ground: SpatialWindows, out: np.ndarray
) -> None:
    for k in range(len(env_ids)):
        for p in range(x.shape[1]):
            out[k, p] = spatial_ground.height(env_ids[k], x[k, p], y[k, p], ground)


@compiled
def _velocities(
    env_ids: np.ndarray, x: np.ndarray, y: np.ndarray, ground: SpatialWindows, out: np.ndarray
) -> None:
    for k in range(len(env_ids)):
        for p in range(x.shape[1]):
            east, north = spatial_ground.velocity(env_ids[k], x[k, p], y[k, p], ground)
            out[k, p, 0], out[k, p, 1] = east, north


@compiled
def _height_maps(
    env_ids: np.ndarray,
    xy: np.ndarray,
    heading: np.ndarray,
    ground: SpatialWindows,
    out: np.ndarray,
) -> None:
    for k in range(len(env_ids)):
        spatial_ground.height_map(env_ids[k], xy[k, 0], xy[k, 1], heading[k], ground, out[k])


@compiled
def _velocity_maps(
    env_ids: np.ndarray,
    xy: np.ndarray,
    heading: np.ndarray,
    ground: SpatialWindows,
    out: np.ndarray,
) -> None:
    for k in range(len(env_ids)):
        spatial_ground.velocity_map(env_ids[k], xy[k, 0], xy[k, 1], heading[k], ground, out[k])
