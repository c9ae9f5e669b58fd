"""An arena whose planar terrain is drawn anew every episode and never ends."""

from __future__ import annotations

from typing import Any

import numpy as np
from dm_control import composer, mjcf

from trl_suite.arenas import boxes, stage
from trl_suite.arenas.stage import FRICTION, PARKED, SOLIMP, SOLREF
from trl_suite.engine import World
from trl_suite.terrain import GENERATORS, SPACING, Strip, Terrain
from trl_suite.terrain.planar_ground import PlanarGround

BEHIND, AHEAD = 6.0, 18.0  # m; extent of the window of boxes about where it was laid
ADVANCE = 6.0  # m; travel after which the window is laid anew
PROBES = 6  # draws by which the pool of boxes is sized
LINE_PROBES = 10  # windows to each side, 240 m, by which it is where ground is a function of x
SPARE = 1.3  # times the most boxes of any probe
COARSEST = 0.1  # m; tolerance up to which pieces are merged if the pool should not suffice

_BEHIND, _AHEAD, _ADVANCE = (round(length / SPACING) for length in (BEHIND, AHEAD, ADVANCE))
_WINDOW = _BEHIND + _AHEAD + 1  # vertices
_CELLS_PER_METRE = 1 / SPACING
_REACH = 0.5 * ADVANCE + SPACING  # m; from the centre of a window to where it is laid anew


class PlanarTerrain(composer.Arena):
    """Planar terrain realised by a pool of static boxes that are posed anew, never recompiled.

    After compiling, `bind` ties the arena to a world of n simulations. Each has its own strip;
    height and slope queries answer from the strips' arrays, never from the collision geometry.
    """

    def _build(self, terrain: Terrain, name: str = 'arena') -> None:  # type: ignore[override]
        super()._build(name=name)
        self.terrain = terrain
        root = self._mjcf_root
        stage.prepare(root)
        _paint(root)
        self.boxes = [
            # In the world's own body: of any other body all geoms are gone through in every substep.
            root.worldbody.add(
                'geom', name=f'terrain_{i}', type='box', size=(0.1, boxes.HALF_WIDTH, 0.1),
                # Laid out along x, so that the bounding volumes made by the compiler fit.
                pos=(0.1 * i, 0, PARKED), friction=FRICTION, solref=SOLREF, solimp=SOLIMP,
                condim=3, material='ground',
            )
            for i in range(_pool_size(terrain))
        ]  # fmt: skip

    @property
    def ground_body(self) -> str:
        """Name of the body that carries the ground, for contact sensors."""
        return 'world'

    def bind(self, world: World) -> None:
        """Resolves the arena's geoms in a world and makes room for its n strips."""
        self._world = world
        # Geoms of one body are neighbours in the model.
        first = int(world.geom_ids([self.boxes[0].full_identifier])[0])
        pool = slice(first, first + len(self.boxes))
        self._placed = [
            (model.geom_pos[pool], model.geom_size[pool], model.geom_quat[pool])
            for model in world.models
        ]
        self.strips: list[Strip | None] = [None] * world.n
        # Of every cell its first height and the rise to the next, m.
        heights, rises = np.zeros((2, world.n, _WINDOW))
        self.ground = PlanarGround(
            np.full(world.n, np.nan), np.zeros(world.n), _REACH, heights, rises,
            np.zeros((world.n, _WINDOW), bool), np.zeros((world.n, 3 * _WINDOW + 1)),
            np.zeros(world.n, bool),
        )  # fmt: skip
        self._offset = np.arange(world.n)[:, None] * _WINDOW
        self._start, self._centre = self.ground.start[:, None], self.ground.centre[:, None]
        self._heights, self._rises = heights, rises
        self._vertical = self.ground.vertical

    def begin_episode(self, row: int, strip: Strip) -> None:
        """Replaces the ground of one simulation; the caller forwards the world afterwards."""
        self.strips[row] = strip
        self._lay(row, 0)

    def follow(self, x: np.ndarray, rows: np.ndarray | None = None) -> None:
        """Keeps ground under and ahead of characters.

        Args:
          x: where their roots are, m, (n, 1), or of the given rows only, (m, 1).
          rows: sorted numbers of simulations; None for all.
        """
        moved = x - (self._centre if rows is None else self._centre[rows])
        if np.vdot(moved, moved) > _REACH**2:  # the cheap test; by rows only if it may be so
            far = (np.abs(moved) > _REACH).nonzero()[0]
            if not len(far):
                return
            leaving = far if rows is None else rows[far]
            for row, root in zip(leaving.tolist(), x[far, 0].tolist(), strict=True):
                # The window starts at multiples of the advance, however far a row has jumped.
                self._lay(row, round(root / ADVANCE) * _ADVANCE)
            # Contacts of the open step name boxes that now lie elsewhere.
            self._world.forward(leaving)

    def height(self, x: np.ndarray, rows: slice | np.ndarray = slice(None)) -> np.ndarray:
        """Heights of the ground in m at x (rows, k) m, exact between the strip's vertices."""
        u = x * _CELLS_PER_METRE
        u -= self._start[rows]
        whole = np.floor(u)
        u -= whole
        cell = whole.astype(np.int64)
        if self._world.n > 1:
            cell += self._offset[rows]
        # Clipping only guards rows whose physics broke down; `follow` keeps the others inside, but
        # for what lies far behind them: see `look_far`.
        u *= self._rises.take(cell, mode='clip')
        u += self._heights.take(cell, mode='clip')
        return u

    def look_far(self, x: np.ndarray, heights: np.ndarray) -> None:
        """Puts right what `height` gave where rows ask beyond their boxes.

        Args:
          x: as given to `height` for all rows, m, (n, k).
          heights: what it returned, (n, k). True up to the length of a window beyond the boxes;
            further away is only who has broken down.
        """
        u = x * _CELLS_PER_METRE
        u -= self._start
        if u.min() >= 0 and u.max() < _WINDOW - 1:
            return
        for row in np.flatnonzero((u.min(1) < 0) | (u.max(1) >= _WINDOW - 1)).tolist():
            strip, start = self.strips[row], self._start[row, 0]
            assert strip is not None
            low, high = (start - _WINDOW) * SPACING, (start + 2 * _WINDOW) * SPACING
            heights[row] = strip.height(np.clip(x[row], low, high))

    def follow_all(self, env_ids: np.ndarray, x: np.ndarray) -> None:
        """Lays the windows anew of some simulations, whose roots are at x (m,), m."""
        for env_id, root in zip(env_ids.tolist(), x.tolist(), strict=True):
            # The window starts at multiples of the advance, however far a character has jumped.
            self._lay(env_id, round(root / ADVANCE) * _ADVANCE)
        # Contacts of the open step name boxes that now lie elsewhere.
        self._world.forward(env_ids)

    def widen(self, env_id: int) -> None:
        """Draws the ground up to the length of a window beyond the window of one simulation."""
        strip, start = self.strips[env_id], int(self.ground.start[env_id])
        assert strip is not None
        heights, _ = strip.window(start - _WINDOW, 3 * _WINDOW + 1)
        self.ground.wide[env_id], self.ground.is_wide[env_id] = heights, True

    def slope(self, x: np.ndarray, rows: slice | np.ndarray = slice(None)) -> np.ndarray:
        """Slopes dh/dx of the ground at x (rows, k) m."""
        cell = np.floor(x * _CELLS_PER_METRE - self._start[rows]).astype(np.int64)
        return self._rises.take(cell + self._offset[rows], mode='clip') / SPACING

    def state(self, row: int) -> dict[str, Any]:
        """What is needed to restore the ground of one simulation exactly."""
        strip = self.strips[row]
        if strip is None:
            return {'strip': None}
        return {'strip': strip.state(), 'centre': int(self._start[row, 0]) + _BEHIND}

    def restore(self, row: int, state: dict[str, Any]) -> None:
        """Restores the ground of one simulation; the caller forwards the world afterwards."""
        if state['strip'] is not None:
            self.strips[row] = Strip.from_state(state['strip'])
            self._lay(row, state['centre'])

    def _lay(self, row: int, centre: int) -> None:
        """Realises the strip around a vertex as boxes."""
        strip = self.strips[row]
        assert strip is not None
        self.ground.is_wide[row] = False
        start = centre - _BEHIND
        heights, vertical = strip.window(start, _WINDOW)
        self._centre[row] = centre * SPACING
        if (
            self._start[row, 0] == start
            and (self._heights[row] == heights).all()
            and (self._vertical[row] == vertical).all()
        ):
            return  # as on flat ground: the boxes lie already
        tolerance = boxes.TOLERANCE
        pieces = boxes.from_profile(start, heights, vertical, tolerance)
        while len(pieces.position) > len(self.boxes):  # coarser, rather than with holes
            tolerance *= 2
            if tolerance > COARSEST:
                raise ValueError(
                    f'terrain {self.terrain.name!r} needs {len(pieces.position)} boxes for '
                    f'{BEHIND + AHEAD:g} m, where {PROBES} draws led to expect no more than '
                    f'{len(self.boxes)}: its features must be spread more evenly'
                )
            pieces = boxes.from_profile(start, heights, vertical, tolerance)
        self._start[row], self._vertical[row] = start, vertical
        self._heights[row] = heights
        np.subtract(heights[1:], heights[:-1], out=self._rises[row, :-1])
        count = len(pieces.position)
        position, half_size, quaternion = self._placed[row]
        position[:count], position[count:] = (
            pieces.position, ((centre + _AHEAD) * SPACING, 0, PARKED),
        )  # fmt: skip
        half_size[:count], half_size[count:] = pieces.half_size, 0.1
        quaternion[:count] = pieces.quaternion
        self._world.set_const(row)


def _pool_size(terrain: Terrain) -> int:
    """How many boxes a window of a terrain may take, from a few fixed draws."""
    generator, windows = GENERATORS.get(terrain.type), range(PROBES)
    if generator is not None and generator.line is not None:
        windows = range(-LINE_PROBES, LINE_PROBES)  # it is always the same, and nowhere alike
    most = 0
    for blend in range(max(1, len(terrain.parameter_sets))):
        for k in windows:
            window = Strip(terrain, abs(k), blend=blend).window(k * _WINDOW, _WINDOW)
            most = max(most, len(boxes.from_profile(k * _WINDOW, *window).position))
    return round(SPARE * most) + PROBES


def _paint(root: mjcf.RootElement) -> None:
    """What the ground looks like."""
    # The checker spans the width of the strip once and its edge has the colour of the sides: where
    # tilted boxes overlap, their sides look like one.
    root.asset.add(
        'texture', name='ground', type='2d', builtin='checker', mark='edge', width=256, height=256,
        rgb1=(0.47, 0.52, 0.44), rgb2=(0.42, 0.47, 0.40), markrgb=(0.36, 0.38, 0.33),
    )  # fmt: skip
    root.asset.add(
        'material', name='ground', texture='ground', texuniform=True, reflectance=0, specular=0,
        texrepeat=(2, 2),
    )  # fmt: skip
