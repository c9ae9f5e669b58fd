"""An arena with unbounded planar terrain, which is generated in every episode."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from dm_control import composer, mjcf

from trl_suite.arenas import boxes, scene
from trl_suite.arenas.boxes import Boxes
from trl_suite.arenas.scene import FRICTION, PARKED, SOLIMP, SOLREF
from trl_suite.engine import World
from trl_suite.terrain import GENERATORS, SPACING, PlanarGround, Terrain
from trl_suite.terrain.planar import windows as planar_ground
from trl_suite.terrain.planar.generators import BORDER
from trl_suite.terrain.planar.windows import BEFORE, PlanarWindows
from trl_suite.util.compiled import compiled, packed

BEHIND, AHEAD = 6.0, 18.0  # m; extent of the window of boxes around its centre
ADVANCE = 6.0  # m; window centres are multiples of it
PROBES = 6  # random windows from which the size of the pool of boxes is estimated
LINE_PROBES = 10  # windows to each side, 240 m, for that estimate if ground is a function of x
SPARE = 1.3  # factor applied to the largest number of boxes in these windows
EDGE = 0.82  # brightness of the edges of the ground, and so of its sides
COARSEST = 0.1  # m; largest tolerance for merging pieces if the pool is too small

_BEHIND, _AHEAD, _ADVANCE = (round(length / SPACING) for length in (BEHIND, AHEAD, ADVANCE))
_WINDOW = _BEHIND + _AHEAD + 1  # vertices that have boxes
_VERTICES = BEFORE + _WINDOW
_CELLS_PER_METRE = 1 / SPACING
_REACH = 0.5 * ADVANCE + SPACING  # m; distance from the centre beyond which a window is moved


class PlanarArena(composer.Arena):
    """Planar terrain as a pool of static boxes, which are moved and resized without recompiling.

    After compiling, `bind` connects the arena to a world of n simulations. Each has its own
    `PlanarGround`; height and slope queries use its arrays, not the collision geometry.
    """

    def _build(  # type: ignore[override]
        self, terrain: Terrain, name: str = 'arena', look: scene.Look = scene.OLIVE
    ) -> None:
        super()._build(name=name)
        self.terrain = terrain
        root = self._mjcf_root
        scene.prepare(root, look)
        _paint(root, look)
        # A default class, since formatting the attributes of each box takes most of the time.
        ground_class = root.default.add('default', dclass='ground')
        ground_class.geom.set_attributes(
            type='box', size=(0.1, boxes.HALF_WIDTH, 0.1), friction=FRICTION, solref=SOLREF,
            solimp=SOLIMP, condim=3, material='ground',
        )  # fmt: skip
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
        self.ground = planar_ground.empty(world.n, _VERTICES, _REACH)
        self._ground = packed(self.ground)
        self._numbers = np.arange(world.n)

    def begin_episode(self, env_id: int, strip: PlanarGround) -> None:
        """Replaces the ground of one simulation; the caller forwards the world afterwards."""
        self.grounds[env_id] = strip
        self._lay(env_id, 0)

    def follow(self, x: np.ndarray, env_ids: np.ndarray | None = None) -> None:
        """Moves windows where necessary, so that there is ground under and ahead of characters.

        Args:
          x: positions of their roots, m, (n, 1), or of the given simulations only, (m, 1).
          env_ids: sorted indices of simulations; None for all.
        """
        env_ids = self._numbers if env_ids is None else env_ids
        far = np.abs(x[:, 0] - self.ground.centre[env_ids]) > self.ground.reach
        far &= np.abs(x[:, 0]) < BORDER
        if far.any():
            self.follow_all(env_ids[far], x[far, 0])

    def follow_all(self, env_ids: np.ndarray, x: np.ndarray) -> None:
        """Moves the windows of some simulations, whose roots are at x, m, (m,)."""
        for env_id, root in zip(env_ids.tolist(), x.tolist(), strict=True):
            # Window centres are multiples of ADVANCE, however far a character has moved.
            self._lay(env_id, round(root / ADVANCE) * _ADVANCE)
        # Existing contacts refer to boxes that have moved.
        self._world.forward(env_ids)

    def height(self, x: np.ndarray, env_ids: slice | np.ndarray = slice(None)) -> np.ndarray:
        """Heights of the ground in m at x (simulations, k) m, linear between the vertices.

        `follow` keeps characters inside their windows; for points beyond these see `look_far`.
        """
        return self._ask(_heights, x, env_ids)

    def look_far(self, x: np.ndarray, heights: np.ndarray) -> None:
        """Corrects results of `height` for simulations with points beyond their windows.

        Args:
          x: the argument of `height` for all simulations, m, (n, k).
          heights: its result, (n, k); corrected in place. Exact up to one window length beyond the
            window; only diverged simulations have points farther away.
        """
        u = x * _CELLS_PER_METRE
        u -= self.ground.start[:, None]
        if u.min() >= -BEFORE and u.max() < _WINDOW - 1:
            return
        far = np.flatnonzero((u.min(1) < -BEFORE) | (u.max(1) >= _WINDOW - 1))
        for env_id in far.tolist():
            self.widen(env_id)
        heights[far] = self._ask(_far_heights, x[far], far)

    def widen(self, env_id: int) -> None:
        """Fills the wide window of one simulation: one window length more to each side."""
        strip, ground = self.grounds[env_id], self.ground
        if strip is None or ground.is_wide[env_id]:
            return
        start = int(ground.start[env_id]) - BEFORE - _VERTICES
        ground.wide[env_id] = strip.window(start, 3 * _VERTICES + 1)[0]
        ground.is_wide[env_id] = True

    def slope(self, x: np.ndarray, env_ids: slice | np.ndarray = slice(None)) -> np.ndarray:
        """Slopes dh/dx of the ground at x (simulations, k) m."""
        return self._ask(_slopes, x, env_ids)

    def _ask(
        self, query: Callable[..., None], x: np.ndarray, env_ids: slice | np.ndarray
    ) -> np.ndarray:
        """Calls a compiled loop over points (simulations, k)."""
        env_ids, x = self._numbers[env_ids], np.ascontiguousarray(x, float)
        if x.ndim != 2 or len(x) != len(env_ids):
            raise ValueError(f'x has shape {x.shape}; expected ({len(env_ids)}, k)')
        found = np.empty(x.shape)
        query(env_ids, x, self._ground, found)
        return found

    def state(self, env_id: int) -> dict[str, Any]:
        """Returns the state from which `restore` restores the ground of one simulation exactly."""
        strip = self.grounds[env_id]
        if strip is None:
            return {'strip': None}
        return {'strip': strip.state(), 'centre': int(self.ground.start[env_id]) + _BEHIND}

    def restore(self, env_id: int, state: dict[str, Any]) -> None:
        """Restores the ground of one simulation; the caller forwards the world afterwards."""
        if state['strip'] is not None:
            self.grounds[env_id] = PlanarGround.from_state(state['strip'])
            self._lay(env_id, state['centre'])

    def _lay(self, env_id: int, centre: int) -> None:
        """Fills a window around vertex number `centre`, and poses its boxes."""
        strip = self.grounds[env_id]
        assert strip is not None
        start = centre - _BEHIND
        heights, vertical = strip.window(start - BEFORE, _VERTICES)
        if is_laid(env_id, centre, heights, vertical, self._ground):
            return  # the window has equal vertices, as on flat ground: boxes need not move
        tolerance = boxes.TOLERANCE
        surface = heights[BEFORE:], vertical[BEFORE:]
        pieces = boxes.cut(start, *surface, tolerance)
        while pieces.number > len(self.boxes):  # a coarser surface is better than one with holes
            tolerance *= 2
            if tolerance > COARSEST:
                raise ValueError(
                    f'terrain {self.terrain.name!r} needs {pieces.number} boxes for '
                    f'{BEHIND + AHEAD:g} m; expected at most {len(self.boxes)}, as estimated from {PROBES} '
                    'random windows; distribute its features more evenly'
                )
            pieces = boxes.cut(start, *surface, tolerance)
        lay(
            env_id, centre, heights, vertical, pieces.number, pieces.level, pieces.ends, pieces.edges,
            boxes.angles(pieces), self._ground, self._pools[env_id],
        )  # fmt: skip
        self._world.set_const(env_id)


@compiled
def is_laid(
    i: int, centre: int, heights: np.ndarray, vertical: np.ndarray, ground: PlanarWindows
) -> bool:
    """Moves the centre of a window; returns whether it contains these vertices already."""
    ground.centre[i] = centre * SPACING
    ground.is_wide[i] = False
    if ground.start[i] != centre - _BEHIND:
        return False
    for k in range(len(heights)):
        if ground.heights[i, k] != heights[k] or ground.vertical[i, k] != vertical[k]:
            return False
    return True


@compiled
def lay(
    i: int,
    centre: int,
    heights: np.ndarray,
    vertical: np.ndarray,
    count: int,
    level: bool,
    ends: np.ndarray,
    edges: np.ndarray,
    angle: np.ndarray,
    ground: PlanarWindows,
    pool: Boxes,
) -> None:
    """Writes vertices to the window of a simulation, and poses the boxes of their pieces."""
    ground.start[i] = centre - _BEHIND
    for k in range(len(heights)):
        ground.heights[i, k], ground.vertical[i, k] = heights[k], vertical[k]
        if k > 0:
            ground.rises[i, k - 1] = heights[k] - heights[k - 1]
    boxes.pose(count, level, vertical[BEFORE:], ends, edges, angle, pool)
    position, half_size = pool.position, pool.half_size
    for k in range(count, len(position)):  # unused boxes
        position[k, 0], position[k, 1], position[k, 2] = (centre + _AHEAD) * SPACING, 0.0, PARKED
        half_size[k, 0] = half_size[k, 1] = half_size[k, 2] = 0.1


@compiled
def _heights(env_ids: np.ndarray, x: np.ndarray, ground: PlanarWindows, out: np.ndarray) -> None:
    for k in range(len(env_ids)):
        for p in range(x.shape[1]):
            out[k, p] = planar_ground.height(env_ids[k], x[k, p], ground)


@compiled
def _far_heights(
    env_ids: np.ndarray, x: np.ndarray, ground: PlanarWindows, out: np.ndarray
) -> None:
    for k in range(len(env_ids)):
        for p in range(x.shape[1]):
            out[k, p] = planar_ground.far_height(env_ids[k], x[k, p], ground)


@compiled
def _slopes(env_ids: np.ndarray, x: np.ndarray, ground: PlanarWindows, out: np.ndarray) -> None:
    for k in range(len(env_ids)):
        for p in range(x.shape[1]):
            out[k, p] = planar_ground.slope(env_ids[k], x[k, p], ground)


def _pool_size(terrain: Terrain) -> int:
    """Estimates the number of boxes that a window of a terrain needs, from a few fixed seeds."""
    generator, windows = GENERATORS.get(terrain.type), range(PROBES)
    if generator is not None and generator.line is not None:
        windows = range(-LINE_PROBES, LINE_PROBES)  # every episode has the same ground
    most = 0
    for terrain_level in range(max(1, len(terrain.parameter_sets))):
        for k in windows:
            window = PlanarGround(terrain, abs(k), terrain_level=terrain_level).window(
                k * _WINDOW, _WINDOW
            )
            most = max(most, boxes.cut(k * _WINDOW, *window).number)
    return round(SPARE * most) + PROBES


def _paint(root: mjcf.RootElement, look: scene.Look) -> None:
    """Adds the texture and the material of the ground."""
    light, dark = look.ground
    # The checker spans the width of the ground once, and its edge has the colour of the sides, so
    # that sides of overlapping tilted boxes cannot be told apart.
    root.asset.add(
        'texture', name='ground', type='2d', builtin='checker', mark='edge', width=256, height=256,
        rgb1=light, rgb2=dark, markrgb=[EDGE * part for part in dark],
    )  # fmt: skip
    root.asset.add(
        'material', name='ground', texture='ground', texuniform=True, reflectance=0, specular=0,
        texrepeat=(2, 2),
    )  # fmt: skip
