"""An arena with unbounded planar terrain, which is generated in every episode."""

from __future__ import annotations

import contextlib
import math
from typing import Any

import numpy as np
from dm_control import composer

from trl_suite.arenas import boxes, scene
from trl_suite.arenas.boxes import Boxes
from trl_suite.arenas.scene import CONTACTS, PARKED
from trl_suite.engine import World
from trl_suite.terrain import GENERATORS, SPACING, PlanarGround, Terrain
from trl_suite.terrain.planar import windows as planar_ground
from trl_suite.terrain.planar.windows import (
    ADVANCE,
    AHEAD,
    BEFORE,
    BEHIND,
    VERTICES,
    PlanarWindows,
)
from trl_suite.util.compiled import compiled, packed

PROBES = 6  # random windows from which the size of the pool of boxes is estimated
LINE_PROBES = 10  # windows to each side, 240 m, for that estimate if ground is a function of x
SPARE = 1.3  # factor applied to the largest number of boxes in these windows
EDGE = 0.82  # brightness of the edges of the ground, and so of its sides
COARSEST = 0.1  # m; largest tolerance for merging pieces if the pool is too small

_WINDOW = BEHIND + AHEAD + 1  # vertices that have boxes


class PlanarArena(composer.Arena):
    """Planar terrain as a pool of static boxes, which are moved and resized without recompiling.

    After compiling, `bind` connects the arena to a world of n simulations. Each has its own
    `PlanarGround`; queries of heights use its arrays, not the collision geometry.
    """

    def _build(  # type: ignore[override]
        self, terrain: Terrain, name: str = 'arena', look: scene.Look = scene.OLIVE
    ) -> None:
        super()._build(name=name)
        self.terrain = terrain
        root = self._mjcf_root
        scene.prepare(root, look)
        # The checker spans the width of the ground once, and its edge has the colour of the sides,
        # so that sides of overlapping tilted boxes cannot be told apart.
        edge = [EDGE * part for part in look.ground[1]]
        scene.paint(root, 'ground', look.ground, 2, mark='edge', markrgb=edge)
        # A default class, since formatting the attributes of each box takes most of the time.
        ground_class = root.default.add('default', dclass='ground')
        shape = {'type': 'box', 'size': (0.1, boxes.HALF_WIDTH, 0.1), 'material': 'ground'}
        ground_class.geom.set_attributes(**shape, **CONTACTS)
        self.boxes = [
            # In the world body: the engine tests all geoms of any other body in every substep.
            # Spread along x, so that the compiler's bounding volumes are useful.
            root.worldbody.add(
                'geom', dclass=ground_class, name=f'terrain_{i}', pos=(0.1 * i, 0, PARKED)
            )
            for i in range(_pool_size(terrain))
        ]

    @property
    def ground_body(self) -> str:
        """Name of the body that contains the ground, for contact sensors."""
        return 'world'

    def bind(self, world: World) -> None:
        """Resolves the arena's geoms in a world and allocates the windows of its n grounds."""
        self._world = world
        # Geoms of one body are adjacent in the model.
        first = int(world.geom_ids([self.boxes[0].full_identifier])[0])
        pool = slice(first, first + len(self.boxes))
        self._pools = [
            packed(Boxes(model.geom_pos[pool], model.geom_size[pool], model.geom_quat[pool]))
            for model in world.models
        ]
        self.grounds: list[PlanarGround | None] = [None] * world.n
        self.ground = planar_ground.empty(world.n)
        self._ground = packed(self.ground)

    def begin_episode(self, env_id: int, strip: PlanarGround) -> None:
        """Replaces the ground of one simulation; the caller forwards the world afterwards."""
        self.grounds[env_id] = strip
        self._lay(env_id, 0)

    def recentre(self, env_ids: np.ndarray, x: np.ndarray) -> None:
        """Moves the windows of some simulations to their characters, whose roots are at x, m, (m,)."""
        for env_id, root in zip(env_ids.tolist(), x.tolist(), strict=True):
            # Window centres are multiples of ADVANCE, however far a character has moved.
            self._lay(env_id, round(root / (ADVANCE * SPACING)) * ADVANCE)
        # Existing contacts refer to boxes that have moved.
        self._world.forward(env_ids)

    def height(self, x: np.ndarray, env_ids: slice | np.ndarray = slice(None)) -> np.ndarray:
        """Heights of the ground in m at x (simulations, k) m, linear between the vertices.

        Exact within 18 m of the centre of a window; characters are within about 3 m of it.
        """
        env_ids, x = self._world.all_ids[env_ids], np.ascontiguousarray(x, float)
        if x.ndim != 2 or len(x) != len(env_ids):
            raise ValueError(f'x has shape {x.shape}; expected ({len(env_ids)}, k)')
        found = np.empty(x.shape)
        _heights(env_ids, x, self._ground, found)
        return found

    def state(self, env_id: int) -> dict[str, Any]:
        """Returns the state from which `restore` restores the ground of one simulation exactly."""
        strip = self.grounds[env_id]
        if strip is None:
            return {'strip': None}
        return {'strip': strip.state(), 'centre': int(self.ground.start[env_id]) + BEHIND}

    def restore(self, env_id: int, state: dict[str, Any]) -> None:
        """Restores the ground of one simulation; the caller forwards the world afterwards."""
        if state['strip'] is not None:
            self.grounds[env_id] = PlanarGround.from_state(state['strip'])
            self._lay(env_id, state['centre'])

    def _lay(self, env_id: int, centre: int) -> None:
        """Fills a window around the vertex with index `centre`, and poses its boxes."""
        strip = self.grounds[env_id]
        assert strip is not None
        start = centre - BEHIND
        heights, vertical = strip.window(start - BEFORE, VERTICES)
        if not _fill(env_id, start, heights, vertical, self._ground):
            return  # at a reset onto the same ground, e.g. flat: boxes need not move
        tolerance = boxes.TOLERANCE
        surface = heights[BEFORE:], vertical[BEFORE:]
        pieces = boxes.cut(start, *surface, tolerance, _kink(strip))
        while pieces.number > len(self.boxes):  # a coarser surface is better than one with holes
            tolerance *= 2
            if tolerance > COARSEST:
                self.ground.start[env_id] = np.nan
                raise ValueError(
                    f'terrain {self.terrain.name!r} needs {pieces.number} boxes for '
                    f'{(BEHIND + AHEAD) * SPACING:g} m; expected at most {len(self.boxes)}, as '
                    'estimated from a few windows; distribute its features more evenly'
                )
            pieces = boxes.cut(start, *surface, tolerance, _kink(strip))
        end = (start + BEHIND + AHEAD) * SPACING
        boxes.pose(pieces, surface[1], boxes.angles(pieces), end, self._pools[env_id])
        self._world.set_const(env_id, ground_only=True)


@compiled
def _fill(
    i: int, start: int, heights: np.ndarray, vertical: np.ndarray, ground: PlanarWindows
) -> bool:
    """Writes the vertices of a window; returns whether it had other ones."""
    changed = start != ground.start[i]
    ground.start[i] = start
    for k in range(VERTICES):
        changed |= heights[k] != ground.heights[i, k] or vertical[k] != ground.vertical[i, k]
        ground.heights[i, k], ground.vertical[i, k] = heights[k], vertical[k]
        if k > 0:
            ground.rises[i, k - 1] = heights[k] - heights[k - 1]
    return changed


@compiled
def _heights(env_ids: np.ndarray, x: np.ndarray, ground: PlanarWindows, out: np.ndarray) -> None:
    for k in range(len(env_ids)):
        for p in range(x.shape[1]):
            out[k, p] = planar_ground.height(env_ids[k], x[k, p], ground)


def _kink(strip: PlanarGround) -> float:
    """Change of slope at which boxes end, see `boxes.cut`."""
    return boxes.KINK if strip.parameters.get('FaceLength') else math.inf


def _pool_size(terrain: Terrain) -> int:
    """Estimates the number of boxes that a window of a terrain needs, from a few fixed seeds."""
    generator, windows = GENERATORS.get(terrain.type), range(PROBES)
    if generator is not None and generator.line is not None:
        windows = range(-LINE_PROBES, LINE_PROBES)  # every episode has the same ground
    most = 0
    sets = max(1, len(terrain.parameter_sets))
    # Between two sets there may be features that are merged in one of them, where they have no height.
    for terrain_level in (*range(sets), *np.arange(sets - 1) + 0.01, *np.arange(sets - 1) + 0.5):
        # A generator may refuse parameters between those of two sets.
        allowed = contextlib.suppress(ValueError) if terrain_level % 1 else contextlib.nullcontext()
        with allowed:
            for k in windows:
                strip = PlanarGround(terrain, abs(k), terrain_level=terrain_level)
                start = k * _WINDOW
                pieces = boxes.cut(start, *strip.window(start, _WINDOW), kink=_kink(strip))
                most = max(most, pieces.number)
    return round(SPARE * most) + PROBES
