"""The three-dimensional ground of one episode: its surface, start places and goals."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from trl_suite.terrain.generators import LONGEST, draw3d
from trl_suite.terrain.parameters import Terrain
from trl_suite.terrain.planar.ground import seed_sequence
from trl_suite.terrain.spatial.layout import GRID, Boxes, Layout

TRAIL_SPAN = 40.0  # m; characters start on a trail within a square of this half side at the origin
TRAIL_PAD = 1.0  # m; distance of these starts from the rim of the square
TRAIL_OFFSET = 0.4  # of the width; largest lateral distance of goals from the middle of a trail
START_ROOM = 1.0  # m; half side of the square around a start that must be clear
GOAL_SPREAD = 3.0  # m; largest distance of a goal along x and along y
LEAST_AHEAD = 1.0  # m; least distance of a goal that is straight ahead
TRIES = 1000  # places tried before the origin is used
FAR_APART, AREA = 1e3, 1e5  # m, m^2; points with a larger spread are queried one by one
RULES = ('far', 'near')

Random = np.random.Generator | np.random.RandomState


class SpatialGround:
    """Unbounded ground of one episode.

    It depends on the seed only. Its queries are exact everywhere, but for one ground at a time;
    `Surroundings` queries the grounds of many characters at once.

    Attributes:
      type: the terrain type.
      parameters: a value for every parameter of the type.
      layout: the generator's result.
    """

    def __init__(
        self,
        terrain: Terrain,
        seed: int | np.random.SeedSequence | np.random.Generator,
        *,
        terrain_level: float = 0.0,
    ) -> None:
        """Generates the ground; arguments and errors are those of a `PlanarGround`."""
        if not terrain.spatial:
            raise ValueError(
                f'terrain {terrain.name!r} ({terrain.type}) is planar; a SpatialGround needs '
                'three-dimensional terrain'
            )
        self._draw(terrain.type, terrain.parameters(terrain_level), seed_sequence(seed))

    def _draw(
        self, type_: str, parameters: Mapping[str, float], sequence: np.random.SeedSequence
    ) -> None:
        self.layout: Layout = draw3d(type_, parameters, np.random.default_rng(sequence))
        self.type: str = type_
        self.parameters: dict[str, float] = dict(parameters)
        self._seed = sequence.entropy, tuple(sequence.spawn_key)

    def state(self) -> dict[str, Any]:
        """Returns what `from_state` needs: type, parameters and seed."""
        entropy, spawn_key = copy.copy(self._seed[0]), self._seed[1]
        return {
            'type': self.type,
            'parameters': dict(self.parameters),
            'entropy': entropy,
            'spawn_key': spawn_key,
        }

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> SpatialGround:
        """Returns the ground that had this `state`."""
        ground = cls.__new__(cls)
        sequence = np.random.SeedSequence(state['entropy'], spawn_key=state['spawn_key'])
        ground._draw(state['type'], state['parameters'], sequence)
        return ground

    def __reduce__(self) -> tuple[Any, ...]:
        return SpatialGround.from_state, (self.state(),)

    def height(
        self, x: npt.ArrayLike, y: npt.ArrayLike, movers: np.ndarray | None = None
    ) -> np.ndarray:
        """Heights of the surface at points, m; -inf where there is no ground.

        Args:
          x, y: m, of one shape.
          movers: centres of the moving boxes, m, (k, 2); their initial ones if None.

        Raises:
          ValueError: a point is not finite, or further than LONGEST from the origin.
        """
        x, y = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
        if not (np.abs(x) <= LONGEST).all() or not (np.abs(y) <= LONGEST).all():
            raise ValueError(f'points must be finite and within {LONGEST:g} m of 0')
        shape, x, y = x.shape, x.ravel(), y.ravel()
        spread = [np.ptp(part) for part in (x, y) if x.size > 1]
        if spread and (max(spread) > FAR_APART or math.prod(spread) > AREA):
            each = [self.height(*point, movers) for point in zip(x, y, strict=True)]
            return np.reshape(each, shape)
        layout = self.layout
        heights = np.full(len(x), -np.inf if layout.level is None else layout.level)
        if not len(x):
            return heights.reshape(shape)
        if layout.grid is not None:
            np.maximum(heights, self._on_grid(x, y), out=heights)
        points = np.stack([x, y], 1)
        parts = [layout.boxes_in(points.min(0), points.max(0))]
        if layout.belts is not None:
            parts.append(layout.belts.boxes)
        if layout.movers is not None:
            parts.append(self.movers(movers))
        for boxes in parts:
            np.maximum(heights, boxes.heights(x, y).max(1, initial=-np.inf), out=heights)
        return heights.reshape(shape)

    def movers(self, centres: np.ndarray | None = None) -> Boxes:
        """The moving boxes as `Boxes`; `centres` are `movers` of `height`."""
        movers, level = self.layout.movers, self.layout.level
        assert movers is not None and level is not None
        if centres is None:
            centres = movers.start + movers.phase[:, None] * (movers.end - movers.start)
        zeros = np.zeros(len(centres))
        return Boxes(centres, movers.half_size, zeros, level + movers.height, zeros)

    def _on_grid(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Heights of the grid at points (k,)."""
        i, j = (np.floor(part / GRID).astype(int) for part in (x, y))
        u, v = x / GRID - i, y / GRID - j
        along_x, along_y = (np.arange(part.min(), part.max() + 2) for part in (i, j))
        heights = self.layout.vertices(along_x, along_y)
        i, j = i - along_x[0], j - along_y[0]
        corners = np.empty((len(x), 2, 2))
        for a in (0, 1):
            for b in (0, 1):
                corners[:, a, b] = heights[i + a, j + b]
        return triangles(corners, u, v)

    def spawn(self, random: Random) -> tuple[float, float, float]:
        """Draws the start of a character: x, y (m) and heading (rad).

        The position depends on the layout's place: at the origin along x; anywhere in a square (24
        m to each side among blocks and pillars, 12 m among moving boxes and belts) where 2 m x 2 m
        are clear; or on the middle of a trail, along it. The number of random draws varies.
        """
        layout = self.layout
        if layout.place == 'trail':
            trail = layout.trail
            assert trail is not None
            count = trail.leave(TRAIL_SPAN)
            points = np.concatenate([trail.start[:count], trail.end[:count]], 1)
            inside = np.flatnonzero((np.abs(points) <= TRAIL_SPAN - TRAIL_PAD).all(1))
            k = inside[int(random.uniform() * len(inside))]
            x, y = trail.start[k] + random.uniform() * (trail.end[k] - trail.start[k])
            return float(x), float(y), float(trail.heading[k])
        if layout.place == 'clear':
            x, y, _ = self._clear(random, START_ROOM, None)
            return x, y, random.uniform(-math.pi, math.pi)
        return 0.0, 0.0, 0.0

    def goal(
        self,
        random: Random,
        root: npt.ArrayLike,
        rule: str = 'far',
        movers: np.ndarray | None = None,
    ) -> np.ndarray:
        """Draws a goal on the ground.

        The position depends on the layout's place: near the character (rule `far`: within 3 m along
        x and along y; `near`: 1 to 3 m ahead along x, at y = 0); anywhere clear, as a
        start; or on the trail, 1 to 10 segments of 2 m beyond the one nearest to the character
        (`near`: 1 segment).

        Args:
          random: source of randomness.
          root: position of the character, (2,) m.
          rule: one of `RULES`.
          movers: centres of the moving boxes, m, (k, 2); their initial ones if None.

        Returns:
          The point, (3,) m.

        Raises:
          ValueError: unknown rule.
        """
        if rule not in RULES:
            raise ValueError(f'rule must be one of {", ".join(RULES)}, not {rule!r}')
        layout = self.layout
        root = np.asarray(root, float)
        if layout.place == 'trail':
            trail = layout.trail
            assert trail is not None
            ahead = 1 + int(random.uniform() * (10 if rule == 'far' else 1))
            middle = 0.5 * (trail.start + trail.end)
            nearest = int(np.linalg.norm(middle - root, axis=1).argmin())
            trail.extend(nearest + ahead + 1)
            k = min(nearest + ahead, len(trail.start) - 1)
            along = random.uniform() * (trail.end[k] - trail.start[k])
            aside = trail.width[k] * random.uniform(-TRAIL_OFFSET, TRAIL_OFFSET)
            heading = trail.heading[k]
            x, y = (
                trail.start[k] + along + aside * np.array([-math.sin(heading), math.cos(heading)])
            )
        elif layout.place == 'clear':
            x, y, found = self._clear(random, layout.goal_room, movers)
            if found and layout.grid is None and layout.level is not None:
                return np.array([x, y, layout.level])
        elif rule == 'far':
            x, y = root + [random.uniform(-GOAL_SPREAD, GOAL_SPREAD) for _ in range(2)]
        else:
            x, y = root[0] + random.uniform(LEAST_AHEAD, GOAL_SPREAD), 0.0
        height = float(self.height(x, y, movers))
        return np.array([x, y, height if math.isfinite(height) else 0.0])  # beyond the ground

    def _clear(
        self, random: Random, room: float, movers: np.ndarray | None
    ) -> tuple[float, float, bool]:
        """Draws a place that is clear of boxes and belts; returns x, y and whether it found one."""
        layout, span = self.layout, self.layout.span
        others = [] if layout.belts is None else [layout.belts.boxes]
        if layout.movers is not None:
            others.append(self.movers(movers))
        for _ in range(TRIES):
            x, y = random.uniform(-span, span), random.uniform(-span, span)
            low, high = (x - room, y - room), (x + room, y + room)
            if layout.is_clear(low, high) and not any(
                boxes.touching(low, high).any() for boxes in others
            ):
                return x, y, True
        return 0.0, 0.0, False


def triangles(corners: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Heights in cells of a grid: two triangles whose common edge runs from (0, 1) to (1, 0).

    Args:
      corners: heights at (0, 0), (0, 1), (1, 0), (1, 1) of each cell, (k, 2, 2).
      u, v: coordinates of the points in their cells, in [0, 1], (k,).
    """
    over = u + v > 1
    near = np.where(over, corners[:, 1, 1], corners[:, 0, 0])
    along_u = np.where(over, corners[:, 0, 1], corners[:, 1, 0])
    along_v = np.where(over, corners[:, 1, 0], corners[:, 0, 1])
    u, v = np.where(over, 1 - u, u), np.where(over, 1 - v, v)
    return near + u * (along_u - near) + v * (along_v - near)
