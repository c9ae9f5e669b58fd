"""An arena with unbounded three-dimensional terrain, which is generated in every episode."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt
from dm_control import composer, mjcf

from trl_suite.arenas import scene
from trl_suite.arenas.scene import CONTACTS, PARKED
from trl_suite.engine import World
from trl_suite.terrain import Boxes, SpatialGround, Surroundings, Terrain, capacity
from trl_suite.terrain.spatial.ground import Random
from trl_suite.terrain.spatial.surroundings import ALL, EnvIds
from trl_suite.terrain.spatial.windows import HALF, VERTICES, SpatialWindows, keep_moving
from trl_suite.util.compiled import compiled, nearest_index

ELEVATION = 40.0  # m; largest difference of heights of a grid within a window
BASE = 1.0  # m; thickness of height fields below their lowest point
FOOT = 0.5  # m; depth to which boxes extend below a plane
THICKNESS = 2.0  # m; of boxes without a plane under them
# kg; inertia of moving boxes along their path. With `windows.REGAINED` they push with up to 2000 N in the
# long run, and yield if a leg is caught between two of them.
DRIVE = 2000.0
SIZE = 0.1  # m; half sides of unused boxes
SHADES = np.array(
    [[1, 1, 1, 1], [0.74, 0.74, 0.74, 1]], np.float32
)  # of boxes, alternating every 0.5 m along x
COLOURS = {
    'block': ((0.55, 0.53, 0.47), (0.51, 0.49, 0.43)),
    'belt': ((0.34, 0.38, 0.44), (0.42, 0.46, 0.52)),
    'mover': ((0.66, 0.50, 0.30), (0.61, 0.46, 0.27)),
}


class SpatialArena(composer.Arena):
    """Three-dimensional terrain as geoms, which are moved and resized without recompiling.

    The geoms are a plane, a height field of 32 m x 32 m, pools of static boxes and of belts, and
    boxes that slide along straight paths, as far as the terrain needs them. After compiling, `bind`
    connects the arena to a world of n simulations, each with its own ground. Queries use the
    `Surroundings`, not the collision geometry.

    Moving boxes have slide joints with a huge inertia, so that they move in every substep, and push
    and carry with their actual velocity. They are children of the body with the plane and the
    height field. Static boxes belong to the world body: collision detection tests all geoms of any
    other body in every substep, or most of them if that body also has an infinite plane.
    """

    def _build(  # type: ignore[override]
        self, terrain: Terrain, name: str = 'arena', look: scene.Look = scene.OLIVE
    ) -> None:
        super()._build(name=name)
        self.terrain = terrain
        self.capacity = holds = capacity(terrain)
        root = self._mjcf_root
        scene.prepare(root, look)
        for name, colours in {'ground': look.ground, **COLOURS}.items():
            scene.paint(root, name, colours)
        # Parts of the ground do not collide with each other: moving boxes pass through them.
        # A default class, since formatting the attributes of each box takes most of the time.
        ground_class = root.default.add('default', dclass='ground')
        masks = {'contype': 1, 'conaffinity': 0}
        ground_class.geom.set_attributes(type='box', size=(SIZE,) * 3, **CONTACTS, **masks)

        def add(body: mjcf.Element, name: str, material: str, **attributes: Any) -> mjcf.Element:
            return body.add('geom', dclass=ground_class, name=name, material=material, **attributes)

        ground = root.worldbody.add('body', name='terrain')
        self.plane = self.field = None
        if holds.level:
            self.plane = add(ground, 'plane', 'ground', type='plane', size=(0, 0, 1))
        if holds.grid:
            size = (HALF, HALF, ELEVATION, BASE)
            root.asset.add('hfield', name='field', nrow=VERTICES, ncol=VERTICES, size=size)
            # Rotated by 90 degrees, so that cells are split into triangles from back left to front
            # right, as in queries; a row of data is then along y, the first one ahead.
            turn = (np.sqrt(0.5), 0, 0, np.sqrt(0.5))
            self.field = add(ground, 'field', 'ground', type='hfield', hfield='field', quat=turn)
        # Spread along x, so that the compiler's bounding volumes are useful.
        world, block = root.worldbody, 'block' if holds.level else 'ground'
        self.boxes = [
            add(world, f'box_{i}', block, pos=(SIZE * i, 0, PARKED)) for i in range(holds.boxes)
        ]
        moving = (1, 0, 0, 0, 0, 0)  # the compiler enables surface velocities only if one is not 0
        self.belts = [
            add(world, f'belt_{i}', 'belt', pos=(SIZE * i, 1, PARKED), surfacevel=moving)
            for i in range(holds.belts)
        ]
        self.movers = []
        for i in range(holds.movers):
            body = ground.add('body', name=f'mover_{i}', pos=(SIZE * i, 2, PARKED))
            slide = {'type': 'slide', 'axis': (1, 0, 0), 'limited': False, 'armature': DRIVE}
            body.add('joint', name=f'mover_{i}', **slide)
            add(body, f'mover_{i}', 'mover', mass=1)
            self.movers.append(body)
        self._physics: Any = None

    @property
    def touched(self) -> tuple[dict[str, str], ...]:
        """Attributes of contact sensors for the ground: one or more sensors are necessary."""
        static = ({'body2': 'world'},) if self.boxes or self.belts else ()
        return ({'subtree2': 'terrain'}, *static)

    def after_compile(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        self._physics = physics  # for updates of height fields in its rendering contexts

    def bind(self, world: World) -> None:
        """Resolves the arena's geoms in a world and allocates the windows of its n grounds."""
        self._world = world
        self.surroundings = Surroundings(world.n, self.capacity)
        # Geoms of one body are adjacent in the model.
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
        # The solver's tolerance is relative to the mean inertia, here without that of moving boxes.
        own = np.ones(world.models[0].nv, bool)
        own[self._dof] = False
        self._own = np.flatnonzero(own)
        for model in world.models:
            self.set_inertia(model)

    @property
    def grounds(self) -> list[SpatialGround | None]:
        """The ground of each simulation."""
        return self.surroundings.grounds

    def begin_episode(
        self, env_id: int, ground: SpatialGround, xy: npt.ArrayLike = (0.0, 0.0)
    ) -> None:
        """Replaces the ground of one simulation; the caller forwards the world afterwards.

        Args:
          env_id: index of the simulation, which may be reset before or after this call.
          ground: the new ground.
          xy: start position of its character, m.
        """
        self.surroundings.begin(env_id, ground, xy)
        self._begin[env_id] = self.surroundings.arrays.mover_distance[env_id]
        self._world.qpos[env_id, self._qpos] = 0.0
        self._place(env_id)
        self._realise(env_id)

    def recentre(self, env_ids: np.ndarray, xy: np.ndarray) -> None:
        """Moves windows that characters have left, and keeps boxes moving.

        Args:
          env_ids: sorted indices of simulations, (m,).
          xy: positions of the roots of their characters, (m, 2) m.

        Raises:
          ValueError: positions of another shape.
        """
        xy = np.ascontiguousarray(xy, float)
        if xy.shape != (len(env_ids), 2):
            raise ValueError(f'xy has shape {xy.shape}; expected {(len(env_ids), 2)}')
        changed = self.surroundings.recentre(env_ids, xy)
        for env_id in changed:
            self._realise(env_id)
        if len(self._dof):
            sped = np.zeros(len(env_ids), bool)
            _keep_moving(
                env_ids, xy, self._world.qpos, self._world.qvel, self.surroundings.pack, sped
            )
            changed = sorted({*changed, *env_ids[sped].tolist()})
        if changed:  # existing contacts refer to boxes that have moved
            self._world.forward(np.array(changed))

    def seen(self, env_ids: EnvIds | int = ALL) -> Surroundings:
        """Returns the surroundings, whose moving boxes are where the physics of simulations has them."""
        if len(self._qpos):
            moved = self._world.qpos[env_ids][..., self._qpos]
            self.surroundings.arrays.mover_distance[env_ids] = self._begin[env_ids] + moved
        return self.surroundings

    def height(self, x: np.ndarray, y: np.ndarray, env_ids: EnvIds = ALL) -> np.ndarray:
        """Heights of the surface in m at points (simulations, k) m, within 12 m of the characters."""
        return self.seen(env_ids).height(x, y, env_ids)

    def goal(
        self,
        env_id: int,
        random: Random,
        root: npt.ArrayLike,
        rule: str = 'far',
    ) -> np.ndarray:
        """Draws a goal for one simulation, clear of boxes at present; see `SpatialGround.goal`."""
        ground = self.grounds[env_id]
        assert ground is not None
        return ground.goal(random, root, rule, self.mover_centres(env_id))

    def mover_centres(self, env_id: int) -> np.ndarray | None:
        """Returns the present centres of one simulation's moving boxes, (k, 2) m; None if there are none."""
        ground, centres = self.grounds[env_id], self.seen(env_id).centres(np.array([env_id]))[0]
        assert ground is not None
        return ground.layout.movers and centres[: len(ground.layout.movers.speed)]

    def state(self, env_id: int) -> dict[str, Any]:
        """Returns the state from which `restore` restores the ground of one simulation exactly."""
        return {**self.seen(env_id).state(env_id), 'begin': self._begin[env_id].copy()}

    def restore(self, env_id: int, state: Mapping[str, Any]) -> None:
        """Restores the ground of one simulation; the caller restores the world afterwards."""
        if state['ground'] is not None:
            self.surroundings.restore(env_id, state)
            self._begin[env_id] = state['begin']
            self._world.qpos[env_id, self._qpos] = state['distance'] - state['begin']
            self._place(env_id)
            self._realise(env_id)

    def _realise(self, env_id: int) -> None:
        """Poses the geoms of a simulation as in its window."""
        model, around = self._world.models[env_id], self.surroundings
        ground, (x, y) = around.grounds[env_id], around.arrays.centre[env_id]
        assert ground is not None
        level, floor = ground.layout.level, 0.0
        if self._plane >= 0:
            floor = PARKED if level is None else level
            place = np.array([x, y, floor])
            if not (around.windowed or len(self._bodies)) and np.array_equal(
                model.geom_pos[self._plane], place
            ):
                return  # only a plane, which is in place already
            model.geom_pos[self._plane] = place
        if self._field >= 0:
            heights = around.arrays.grid[env_id].reshape(VERTICES, VERTICES)
            lowest, highest = float(heights.min()), float(heights.max())
            if not highest - lowest <= ELEVATION:
                raise ValueError(
                    f'terrain {self.terrain.name!r} rises from {lowest:g} to {highest:g} m within '
                    f'{2 * HALF:g} m; expected a difference of at most {ELEVATION:g} m'
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
        self._world.set_const(env_id, ground_only=not len(self._bodies))
        if self._field >= 0:
            self._show(model)

    def _place(self, env_id: int) -> None:
        """Sets the places of moving boxes at joint position 0, their axes, sizes and speeds."""
        if not len(self._bodies):
            return
        model, ground = self._world.models[env_id], self.grounds[env_id]
        around = self.surroundings.arrays
        assert ground is not None and ground.layout.level is not None
        movers, level = ground.layout.movers, ground.layout.level
        count = 0 if movers is None else len(movers.speed)
        position = np.full((len(self._bodies), 3), PARKED)
        size = np.full((len(self._bodies), 3), SIZE)
        if movers is not None:
            moved = self._begin[env_id, :count, None]
            axis = around.mover_axis[env_id, :count]
            position[:count, :2] = around.mover_start[env_id, :count] + moved * axis
            position[:count, 2] = level + 0.5 * movers.height
            size[:count, :2], size[:count, 2] = movers.half_size, 0.5 * movers.height
            model.jnt_axis[self._joints[:count], :2] = axis
        model.body_pos[self._bodies], model.geom_size[self._mover_geoms] = position, size
        speed = around.mover_direction[env_id] * around.mover_speed[env_id]
        self._world.qvel[env_id, self._dof] = speed

    def set_inertia(self, model: mujoco.MjModel) -> None:
        """Leaves moving boxes out of the mean inertia."""
        if len(self._dof) and len(self._own):
            model.stat.meaninertia = model.dof_M0[self._own].mean()

    def _show(self, model: mujoco.MjModel) -> None:
        """Uploads a new height field to the rendering contexts of the physics, if there are any."""
        try:
            contexts = self._physics and self._physics._contexts
            if not contexts or contexts.gl.terminated or self._physics.model.ptr is not model:
                return
            with contexts.gl.make_current() as gl:
                gl.call(mujoco.mjr_uploadHField, model, contexts.mujoco.ptr, 0)
        except ReferenceError:  # the physics was freed
            self._physics = None


@compiled
def _keep_moving(
    env_ids: np.ndarray,
    xy: np.ndarray,
    qpos: np.ndarray,
    qvel: np.ndarray,
    ground: SpatialWindows,
    sped: np.ndarray,
) -> None:
    for k in range(len(env_ids)):
        sped[k] = keep_moving(env_ids[k], xy[k, 0], xy[k, 1], qpos, qvel, ground)


def _range(world: World, geoms: list[mjcf.Element]) -> slice:
    if not geoms:
        return slice(0, 0)
    first = int(world.geom_ids([geoms[0].full_identifier])[0])
    return slice(first, first + len(geoms))


def _pose(model: mujoco.MjModel, first: int, boxes: Boxes, level: float | None) -> None:
    """Poses geoms so that their upper faces are those of boxes."""
    # By NumPy: the compiled function may differ in the last bit.
    angle = np.arctan(boxes.slope) if boxes.slope.any() else boxes.slope
    geoms = model.geom_pos, model.geom_size, model.geom_quat, model.geom_rgba
    _write_boxes(*boxes[:4], angle, np.nan if level is None else level, first, SHADES, *geoms)


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
    """Poses geoms from index `first` on; the level is NaN if there is none."""
    for k in range(len(top)):
        geom, half_yaw, half_angle = first + k, 0.5 * yaw[k], 0.5 * angle[k]
        cosine, sine = math.cos(angle[k]), math.sin(angle[k])
        thickness = THICKNESS
        if not math.isnan(level):
            thickness = max((top[k] - level + FOOT) / cosine, FOOT)
        # The centre of a tilted box is below its upper face, along the normal of that face.
        aside = 0.5 * thickness * sine
        geom_pos[geom, 0] = middle[k, 0] + aside * math.cos(yaw[k])
        geom_pos[geom, 1] = middle[k, 1] + aside * math.sin(yaw[k])
        geom_pos[geom, 2] = top[k] - 0.5 * thickness * cosine
        geom_size[geom, 0], geom_size[geom, 1] = half_size[k, 0] / cosine, half_size[k, 1]
        geom_size[geom, 2] = 0.5 * thickness
        # Rotated about y by minus the angle, then about z by the yaw.
        geom_quat[geom, 0] = math.cos(half_yaw) * math.cos(half_angle)
        geom_quat[geom, 1] = math.sin(half_yaw) * math.sin(half_angle)
        geom_quat[geom, 2] = -math.cos(half_yaw) * math.sin(half_angle)
        geom_quat[geom, 3] = math.sin(half_yaw) * math.cos(half_angle)
        shade = nearest_index(np.floor(2 * middle[k, 0]) % 2.0, len(shades))
        for channel in range(4):
            geom_rgba[geom, channel] = shades[shade, channel]
