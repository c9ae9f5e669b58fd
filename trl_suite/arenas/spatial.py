"""An arena whose three-dimensional terrain is drawn anew every episode and never ends."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt
from dm_control import composer, mjcf

from trl_suite.arenas import scene as stage
from trl_suite.arenas.scene import FRICTION, PARKED, SOLIMP, SOLREF
from trl_suite.engine import World, bounds
from trl_suite.terrain import Boxes, SpatialGround, Surroundings, Terrain, capacity
from trl_suite.terrain.spatial.ground import Random
from trl_suite.terrain.spatial.surroundings import ALL, Rows
from trl_suite.terrain.spatial.windows import HALF, VERTICES, SpatialWindows, keep_moving
from trl_suite.util.compiled import compiled, compiled_loop, packed

ELEVATION = 40.0  # m; the most that heights of a grid may differ within a window
BASE = 1.0  # m; of height fields, below their lowest point
FOOT = 0.5  # m; how deep boxes are let into a plane
THICKNESS = 2.0  # m; of boxes without a plane under them
DRIVE = 1e6  # kg; inertia of moving boxes along their way: nothing that they meet stops them
SIZE = 0.1  # m; half sides of unused boxes
SHADES = np.array(
    [[1, 1, 1, 1], [0.74, 0.74, 0.74, 1]], np.float32
)  # of boxes, by turns of 0.5 m along x


class SpatialArena(composer.Arena):
    """Three-dimensional terrain realised by geoms that are posed anew, never recompiled.

    A plane, a height field of 32 m x 32 m, pools of static boxes and of belts, and boxes that slide
    along straight ways: those of them that the terrain calls for. After compiling, `bind` ties the
    arena to a world of n simulations, each with a ground of its own. Queries answer from the
    `Surroundings`, never from the collision geometry.

    Moving boxes are on sliding joints with a huge inertia, so that they move in every substep and push
    and carry with the velocity they have. They are children of the body that has plane and height
    field. Static boxes are the world's own: collision detection goes through all geoms of any other
    body in every substep, and through most of them where a plane without end is among them.
    """

    def _build(self, terrain: Terrain, name: str = 'arena') -> None:  # type: ignore[override]
        super()._build(name=name)
        self.terrain = terrain
        self.capacity = holds = capacity(terrain)
        root = self._mjcf_root
        stage.prepare(root)
        _paint(root)
        # The ground may be hit but hits nothing itself: moving boxes pass through it and each other.
        common = {
            'friction': FRICTION, 'solref': SOLREF, 'solimp': SOLIMP, 'condim': 3, 'contype': 1,
            'conaffinity': 0,
        }  # fmt: skip
        ground = root.worldbody.add('body', name='terrain')
        self.plane = self.field = None
        if holds.level:
            self.plane = ground.add(
                'geom', name='plane', type='plane', size=(0, 0, 1), material='ground', **common
            )
        if holds.grid:
            root.asset.add(
                'hfield', name='field', nrow=VERTICES, ncol=VERTICES,
                size=(HALF, HALF, ELEVATION, BASE),
            )  # fmt: skip
            self.field = ground.add(
                # Turned by a right angle, so that cells are cut into triangles from the back left to
                # the front right, as in the queries; a row then runs along y, the first one ahead.
                'geom', name='field', type='hfield', hfield='field', material='ground',
                quat=(np.sqrt(0.5), 0, 0, np.sqrt(0.5)), **common,
            )  # fmt: skip
        # Laid out along x, so that the bounding volumes made by the compiler fit.
        self.boxes = [
            root.worldbody.add(
                'geom', name=f'box_{i}', type='box', size=(SIZE,) * 3, pos=(SIZE * i, 0, PARKED),
                material='block' if holds.level else 'ground', **common,
            )
            for i in range(holds.boxes)
        ]  # fmt: skip
        self.belts = [
            root.worldbody.add(
                # Unless one belt runs when it is compiled, none ever will.
                'geom', name=f'belt_{i}', type='box', size=(SIZE,) * 3, pos=(SIZE * i, 1, PARKED),
                surfacevel=(1, 0, 0, 0, 0, 0), material='belt', **common,
            )
            for i in range(holds.belts)
        ]  # fmt: skip
        self.movers = []
        for i in range(holds.movers):
            body = ground.add('body', name=f'mover_{i}', pos=(SIZE * i, 2, PARKED))
            body.add(
                'joint', name=f'mover_{i}', type='slide', axis=(1, 0, 0), limited=False,
                armature=DRIVE,
            )  # fmt: skip
            body.add(
                'geom', name=f'mover_{i}', type='box', size=(SIZE,) * 3, mass=1, material='mover',
                **common,
            )  # fmt: skip
            self.movers.append(body)
        self._physics: Any = None

    @property
    def touched(self) -> tuple[dict[str, str], ...]:
        """Attributes of the contact sensors that notice the ground: one of these sensors, or more."""
        static = ({'body2': 'world'},) if self.boxes or self.belts else ()
        return ({'subtree2': 'terrain'}, *static)

    def after_compile(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        self._physics = physics  # to show new height fields to whoever draws

    def bind(self, world: World) -> None:
        """Resolves the arena's geoms in a world and makes room for its n grounds."""
        self._world = world
        self.surroundings = Surroundings(world.n, self.capacity)
        # Geoms of one body are neighbours in the model.
        self._pool = _range(world, self.boxes)
        self._belts = _range(world, self.belts)
        self._plane, self._field = (
            int(world.geom_ids([geom.full_identifier])[0]) if geom is not None else -1
            for geom in (self.plane, self.field)
        )
        names = [body.full_identifier for body in self.movers]
        self._bodies, self._mover_geoms = world.body_ids(names), world.geom_ids(names)
        self._qpos, self._dof = world.joint_addresses(names)
        ground = self.surroundings.arrays
        ground.mover_qpos[:], ground.mover_dof[:] = self._qpos, self._dof
        self._begin = ground.mover_begin
        self._joints = world.models[0].body_jntadr[self._bodies]
        # The solver's tolerance is relative to the mean inertia, that of the drives left out.
        own = np.ones(world.models[0].nv, bool)
        own[self._dof] = False
        self._own = np.flatnonzero(own)
        for model in world.models:
            self._set_inertia(model)
        placed = [*self.boxes[:1], *self.belts[:1], *(body.geom[0] for body in self.movers)]
        placed += [geom for geom in (self.plane, self.field) if geom is not None]
        geoms = world.geom_ids([geom.full_identifier for geom in placed])
        self._placed = np.unique(world.models[0].geom_bodyid[geoms]).astype(int)
        self._geoms = [packed(bounds.geoms(model)) for model in world.models]

    @property
    def grounds(self) -> list[SpatialGround | None]:
        """The ground of each simulation."""
        return self.surroundings.grounds

    def begin_episode(
        self, env_id: int, ground: SpatialGround, xy: npt.ArrayLike = (0.0, 0.0)
    ) -> None:
        """Replaces the ground of one simulation; the caller forwards the world afterwards.

        Args:
          env_id: which simulation; it may be reset before or after.
          ground: the new ground.
          xy: where its character is put, m.
        """
        self.surroundings.begin(env_id, ground, xy)
        self._begin[env_id] = self.surroundings.way[env_id]
        self._world.qpos[env_id, self._qpos] = 0.0
        self._place(env_id)
        self._realise(env_id)

    def follow(self, xy: np.ndarray, env_ids: np.ndarray | None = None) -> None:
        """Keeps ground around characters and boxes moving; called before every control step.

        Args:
          xy: where their roots are, m, (n, 2), or of the given simulations only, (m, 2).
          env_ids: sorted numbers of simulations; None for all.
        """
        changed = self.surroundings.follow(xy, env_ids)
        for env_id in changed:
            self._realise(env_id)
        if len(self._dof):
            env_ids = self._world.all_ids if env_ids is None else env_ids
            sped = np.zeros(len(env_ids), bool)
            _keep_moving(
                env_ids, np.ascontiguousarray(xy, float), self._world.qpos, self._world.qvel,
                self.surroundings.arrays, sped,
            )  # fmt: skip
            changed = sorted({*changed, *env_ids[sped].tolist()})
        if changed:  # contacts of the open step name boxes that now lie elsewhere
            self._world.forward(np.array(changed))

    def height(self, x: np.ndarray, y: np.ndarray, env_ids: Rows = ALL) -> np.ndarray:
        """Heights of the surface in m at points (simulations, k) m, within 12 m of the characters."""
        self._look(env_ids)
        return self.surroundings.height(x, y, env_ids)

    def surface_velocity(self, x: np.ndarray, y: np.ndarray, env_ids: Rows = ALL) -> np.ndarray:
        """Horizontal velocities of the surface in m/s at points (simulations, k) m, (simulations, k, 2)."""
        self._look(env_ids)
        return self.surroundings.velocity(x, y, env_ids)

    def height_map(
        self,
        xy: np.ndarray,
        heading: np.ndarray,
        env_ids: Rows = ALL,
        out: np.ndarray | None = None,
    ) -> np.ndarray:
        """Heights around characters, (simulations, 1024) m; see `Surroundings.height_map`."""
        self._look(env_ids)
        return self.surroundings.height_map(xy, heading, env_ids, out)

    def velocity_map(
        self,
        xy: np.ndarray,
        heading: np.ndarray,
        env_ids: Rows = ALL,
        out: np.ndarray | None = None,
    ) -> np.ndarray:
        """Velocities of the surface, (simulations, 2048) m/s; see `Surroundings.velocity_map`."""
        self._look(env_ids)
        return self.surroundings.velocity_map(xy, heading, env_ids, out)

    def goal(
        self,
        env_id: int,
        random: Random,
        root: npt.ArrayLike,
        rule: str = 'far',
        distance: float = 1.0,
    ) -> np.ndarray:
        """Draws a goal for one simulation, clear of boxes as they now stand; see `SpatialGround.goal`."""
        self._look(env_id)
        ground = self.grounds[env_id]
        assert ground is not None
        movers = None
        if ground.layout.movers is not None:
            movers = self.surroundings.centres(np.array([env_id]))[
                0, : len(ground.layout.movers.speed)
            ]
        return ground.goal(random, root, rule, distance=distance, movers=movers)

    def state(self, env_id: int) -> dict[str, Any]:
        """What is needed to restore the ground of one simulation exactly."""
        self._look(env_id)
        return {**self.surroundings.state(env_id), 'begin': self._begin[env_id].copy()}

    def restore(self, env_id: int, state: Mapping[str, Any]) -> None:
        """Restores the ground of one simulation; the caller restores the world afterwards."""
        if state['ground'] is not None:
            self.surroundings.restore(env_id, state)
            self._begin[env_id] = state['begin']
            self._world.qpos[env_id, self._qpos] = state['way'] - state['begin']
            self._place(env_id)
            self._realise(env_id)

    def _look(self, env_ids: Rows | int) -> None:
        """Sees where the physics has taken moving boxes of some simulations."""
        if len(self._qpos):
            moved = self._world.qpos[env_ids][..., self._qpos]
            self.surroundings.way[env_ids] = self._begin[env_ids] + moved

    def _realise(self, env_id: int) -> None:
        """Poses geoms as the window says."""
        model, around = self._world.models[env_id], self.surroundings
        ground, (x, y) = around.grounds[env_id], around.centre[env_id]
        assert ground is not None
        level, floor = ground.layout.level, 0.0
        if self._plane >= 0:
            floor = PARKED if level is None else level
            place = np.array([x, y, floor])
            if not (around.windowed or len(self._bodies)) and np.array_equal(
                model.geom_pos[self._plane], place
            ):
                return  # nothing but a plane, which lies there already
            model.geom_pos[self._plane] = place
        if self._field >= 0:
            heights = around.grid(env_id)
            lowest, highest = float(heights.min()), float(heights.max())
            if not highest - lowest <= ELEVATION:
                raise ValueError(
                    f'terrain {self.terrain.name!r} rises from {lowest:g} to {highest:g} m within '
                    f'{2 * HALF:g} m; a height grid may rise by {ELEVATION:g} m'
                )
            floor = min(floor, lowest)
            model.geom_pos[self._field] = x, y, lowest
            data = model.hfield_data.reshape(VERTICES, VERTICES)
            np.subtract(heights[::-1], np.float32(lowest), out=data)
            data *= np.float32(1 / ELEVATION)
        boxes, belts = around.boxes[env_id], ground.layout.belts
        if len(boxes.top):
            floor = min(floor, float(boxes.top.min()))
        for pool, used in ((self._pool, boxes), (self._belts, belts and belts.boxes)):
            count = 0
            if used is not None and len(used.top):
                count = len(used.top)
                _pose(model, pool.start, used, level)
            unused = slice(pool.start + count, pool.stop)
            model.geom_pos[unused] = x + HALF, y, floor + PARKED
            model.geom_size[unused] = SIZE
        if belts is not None:
            run = model.geom_surfacevel[self._belts.start :][: len(belts.velocity)]
            cosine, sine = np.cos(belts.boxes.yaw), np.sin(belts.boxes.yaw)
            east, north = belts.velocity.T
            run[:, 0], run[:, 1] = cosine * east + sine * north, cosine * north - sine * east
        bounds.refresh_all(self._placed, self._geoms[env_id])
        if self._field >= 0:
            self._show(model)

    def _place(self, env_id: int) -> None:
        """Puts moving boxes where their ways begin for the physics."""
        if not len(self._bodies):
            return
        model, around, ground = self._world.models[env_id], self.surroundings, self.grounds[env_id]
        assert ground is not None and ground.layout.level is not None
        movers, level = ground.layout.movers, ground.layout.level
        count = 0 if movers is None else len(movers.speed)
        position = np.full((len(self._bodies), 3), PARKED)
        size = np.full((len(self._bodies), 3), SIZE)
        if movers is not None:
            way = self._begin[env_id, :count, None]
            position[:count, :2] = around.start[env_id, :count] + way * around.axis[env_id, :count]
            position[:count, 2] = level + 0.5 * movers.height
            size[:count, :2], size[:count, 2] = movers.half_size, 0.5 * movers.height
            model.jnt_axis[self._joints[:count], :2] = around.axis[env_id, :count]
        model.body_pos[self._bodies], model.geom_size[self._mover_geoms] = position, size
        self._world.qvel[env_id, self._dof] = around.direction[env_id] * around.speed[env_id]

    def _set_inertia(self, model: mujoco.MjModel) -> None:
        if len(self._dof) and len(self._own):
            model.stat.meaninertia = model.dof_M0[self._own].mean()

    def _show(self, model: mujoco.MjModel) -> None:
        """Gives a new height field to the pictures of a physics that has drawn before."""
        try:
            contexts = self._physics and self._physics._contexts
            if not contexts or self._physics.model.ptr is not model:
                return
            with contexts.gl.make_current() as gl:
                gl.call(mujoco.mjr_uploadHField, model, contexts.mujoco.ptr, 0)
        except ReferenceError:  # the physics was freed
            self._physics = None


@compiled_loop
def _keep_moving(
    env_ids: np.ndarray, xy: np.ndarray, qpos: np.ndarray, qvel: np.ndarray,
    ground: SpatialWindows, sped: np.ndarray,
) -> None:  # fmt: skip
    for k in range(len(env_ids)):
        sped[k] = keep_moving(env_ids[k], xy[k, 0], xy[k, 1], qpos, qvel, ground)


def _range(world: World, geoms: list[mjcf.Element]) -> slice:
    if not geoms:
        return slice(0, 0)
    first = int(world.geom_ids([geoms[0].full_identifier])[0])
    return slice(first, first + len(geoms))


def _pose(model: mujoco.MjModel, first: int, boxes: Boxes, level: float | None) -> None:
    """Gives geoms the upper faces of boxes, and sides that reach below them."""
    # NumPy's own: the compiled one may differ in the last bit.
    angle = np.arctan(boxes.slope) if boxes.slope.any() else boxes.slope
    _write_boxes(
        *boxes[:4], angle, np.nan if level is None else level, first, SHADES, model.geom_pos,
        model.geom_size, model.geom_quat, model.geom_rgba,
    )  # fmt: skip


@compiled
def _write_boxes(
    middle: np.ndarray,
    half_size: np.ndarray,
    yaw: np.ndarray,
    top: np.ndarray,
    angle: np.ndarray,
    level: float,
    first: int,
    shades: np.ndarray,
    geom_pos: np.ndarray,
    geom_size: np.ndarray,
    geom_quat: np.ndarray,
    geom_rgba: np.ndarray,
) -> None:
    """Poses geoms from the first on; the level is NaN if there is none."""
    for k in range(len(top)):
        geom, half_yaw, half_angle = first + k, 0.5 * yaw[k], 0.5 * angle[k]
        cosine, sine = math.cos(angle[k]), math.sin(angle[k])
        thickness = THICKNESS
        if not math.isnan(level):
            thickness = max((top[k] - level + FOOT) / cosine, FOOT)
        # A tilted box lies below its upper face along the normal of it.
        aside = 0.5 * thickness * sine
        geom_pos[geom, 0] = middle[k, 0] + aside * math.cos(yaw[k])
        geom_pos[geom, 1] = middle[k, 1] + aside * math.sin(yaw[k])
        geom_pos[geom, 2] = top[k] - 0.5 * thickness * cosine
        geom_size[geom, 0], geom_size[geom, 1] = half_size[k, 0] / cosine, half_size[k, 1]
        geom_size[geom, 2] = 0.5 * thickness
        # Turned about z by the yaw after it was turned about y by minus the angle.
        geom_quat[geom, 0] = math.cos(half_yaw) * math.cos(half_angle)
        geom_quat[geom, 1] = math.sin(half_yaw) * math.sin(half_angle)
        geom_quat[geom, 2] = -math.cos(half_yaw) * math.sin(half_angle)
        geom_quat[geom, 3] = math.sin(half_yaw) * math.cos(half_angle)
        shade = math.floor(2 * middle[k, 0]) % 2
        for channel in range(4):
            geom_rgba[geom, channel] = shades[shade, channel]


def _paint(root: mjcf.RootElement) -> None:
    """What the ground looks like."""
    colours = {
        'ground': ((0.47, 0.52, 0.44), (0.42, 0.47, 0.40)),
        'block': ((0.55, 0.53, 0.47), (0.51, 0.49, 0.43)),
        'belt': ((0.34, 0.38, 0.44), (0.42, 0.46, 0.52)),
        'mover': ((0.66, 0.50, 0.30), (0.61, 0.46, 0.27)),
    }
    for name, (light, dark) in colours.items():
        root.asset.add(
            'texture', name=name, type='2d', builtin='checker', width=256, height=256, rgb1=light,
            rgb2=dark,
        )  # fmt: skip
        root.asset.add(
            'material', name=name, texture=name, texuniform=True, reflectance=0, specular=0,
            texrepeat=(1, 1),
        )  # fmt: skip
