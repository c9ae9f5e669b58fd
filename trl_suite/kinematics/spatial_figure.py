"""A character in three dimensions: its sensors, its ids in a compiled model, and its placement."""

from __future__ import annotations

import itertools
import math
from typing import Any, NamedTuple

import numpy as np

from trl_suite.actuation.action_map import ActionMap
from trl_suite.arenas import SpatialArena
from trl_suite.characters import Character
from trl_suite.engine import World, native
from trl_suite.engine.native import Engine
from trl_suite.kinematics.blocks import (
    HEIGHTS,
    PLACES,
    QUATERNION,
    SPEEDS,
    SPIN,
    VECTOR,
    Block,
    Reflection,
)
from trl_suite.kinematics.spatial import (
    LINK_POSE,
    LINK_VELOCITY,
    Measured,
    SpatialBodyData,
    SpatialIds,
    SpatialMeasurement,
    SpatialState,
    control_all,
    empty_measurement,
    measure_all,
)
from trl_suite.motion import quaternion
from trl_suite.policies.mirror import blocks as mirrored_blocks
from trl_suite.policies.mirror import exchanged
from trl_suite.terrain.spatial import windows as spatial_ground
from trl_suite.terrain.spatial.windows import SAMPLES, SpatialWindows, see_movers
from trl_suite.util.compiled import compiled, packed

CLEARANCE = 0.001  # m; between links and ground after the initial placement
# Reflection of a map, whose lines are from left to right.
LINES = np.arange(SAMPLES**2).reshape(SAMPLES, SAMPLES)[::-1].ravel()


class SpatialFigure:
    """One character in every simulation of a world.

    Attributes:
      body: its ids, after `bind`; see `SpatialIds`.
      state: the fields of the physics from which it is measured.
      measurement: the last measurement.
      data: all of these for compiled functions.
      pose_qpos, pose_dof: addresses of the columns of a pose and of a velocity.
      links: body ids, in link order.
      blocks: the observation blocks of the body.
    """

    body: SpatialIds
    state: SpatialState
    measurement: SpatialMeasurement
    data: SpatialBodyData
    fields: tuple[str, ...] = ('xquat',)  # further fields of MjData to bind, see `World`

    def __init__(
        self, character: Character, arena: SpatialArena, terrain_observation: bool
    ) -> None:
        """Attaches the character; adds contact sensors for its fall links and end effectors.

        Args:
          character: a spatial character; it is attached to the arena and given a free joint.
          arena: the arena with its terrain.
          terrain_observation: whether ground heights around it are observed, 32 x 32 samples.
        """
        self.character, self.arena, self.terrain_observation = character, arena, terrain_observation
        (self._root,) = character.create_root_joints(arena.attach(character))
        self._sensors = {
            kind: [self._add_sensors(name, kind) for name in names]
            for kind, names in (
                ('fall', character.spec.fall_links),
                ('contact', character.spec.end_effectors),
            )
        }
        self.blocks = body_blocks(character, terrain_observation)

    def _add_sensors(self, link: str, kind: str) -> list[str]:
        """Adds sensors of the contacts between a link and the ground; returns their names."""
        names = []
        for i, ground in enumerate(self.arena.touched):
            names.append(f'{self.character.mjcf_model.model}_{link}_{kind}_{i}')
            self.arena.mjcf_model.sensor.add(
                'contact', name=names[-1], body1=self.character.mjcf_model.find('body', link),
                num=1, data='found', **ground,
            )  # fmt: skip
        return names

    def bind(self, world: World, action_map: ActionMap, about: str = 'com') -> None:
        """Resolves ids in a compiled world.

        Args:
          world: the simulations.
          action_map: the map from actions to the actuators of the joints.
          about: origin of end effector positions, the centre of mass ('com') or the 'root'.
        """
        self._world = world
        self.arena.bind(world)
        character, model = self.character, world.models[0]
        names = [self._root.full_identifier, *(j.full_identifier for j in character.joints)]
        qpos, dof = world.joint_addresses(names)
        ball = character.spherical
        sizes, rates = np.where(ball, 4, 1), np.where(ball, 3, 1)
        self.pose_qpos = _addresses(qpos, [7, *sizes])
        self.pose_dof = _addresses(dof, [6, *rates])
        self.links = world.body_ids([body.full_identifier for body in character.bodies])
        mass = model.body_mass[self.links]
        fall, contact = (
            world.sensor_addresses([*itertools.chain(*names)]).astype(int)
            for names in self._sensors.values()
        )
        self.body = SpatialIds(
            self.pose_qpos, self.pose_dof, self.pose_dof[6:].copy(),
            _addresses(qpos[1:][ball], sizes[ball]), qpos[1:][~ball], self.links,
            world.body_ids([b.full_identifier for b in character.end_effectors]),
            mass / mass.sum(), about == 'com', fall,
            contact.reshape(len(self._sensors['contact']), len(self.arena.touched)),
        )  # fmt: skip
        self.state = SpatialState(*(getattr(world, name) for name in SpatialState._fields))
        self.measurement = empty_measurement(world.n, self.body)
        self._pack = packed(Measured(self.body, self.state, self.ground, self.measurement))
        # The controls are consecutive.
        scope = f'{character.mjcf_model.model}/'
        first = int(world.control_addresses([scope + action_map.actuators[0]])[0])
        self.data = SpatialBodyData(
            engine=world.engine,
            ids=self.body,
            physics=self.state,
            ground=self.ground,
            drive=action_map.drive(first),
            ctrl=world.ctrl,
            measurement=self.measurement,
            leaving=np.zeros(world.n, bool),
        )
        self._data_pack = packed(self.data)
        geoms = world.geom_ids([g.full_identifier for g in character.collision_geoms])
        signs = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3, indexing='ij'), axis=-1).reshape(8, 3)
        boxes = model.geom_aabb[geoms, None]  # centres and half sizes, in the geoms' frames
        corners = quaternion.rotate(
            model.geom_quat[geoms, None], boxes[..., :3] + signs * boxes[..., 3:]
        )
        corners += model.geom_pos[geoms, None]  # in the links' frames
        bodies = np.repeat(model.geom_bodyid[geoms], 8).astype(int)
        self._corners = packed(Corners(bodies, corners.reshape(-1, 3)))

    @property
    def ground(self) -> SpatialWindows:
        """The ground of all simulations, for compiled functions."""
        return self.arena.surroundings.arrays

    @property
    def effectors(self) -> np.ndarray:
        """Body ids of the end effectors, in link order."""
        return self.body.effectors

    def control(self, env_ids: np.ndarray, action: np.ndarray) -> None:
        """Writes the controls of some simulations; moves ground windows, so that images show them.

        Args:
          env_ids: indices of simulations.
          action: actions of all simulations, (n, k), in [-1, 1].
        """
        if control_all(env_ids, action, self._data_pack):
            self.recentre(env_ids[self.data.leaving[env_ids]])

    def measure(self, env_ids: np.ndarray | None = None) -> SpatialMeasurement:
        """Measures the characters of some simulations, or of all; returns `measurement`."""
        measure_all(self._world.all_ids if env_ids is None else env_ids, self._pack)
        return self.measurement

    def recentre(self, env_ids: np.ndarray) -> None:
        """Moves the ground windows of some simulations to the positions of their characters."""
        self.arena.recentre(env_ids, self._world.xpos[env_ids, self.links[0], :2])

    def place(
        self, env_ids: np.ndarray, poses: np.ndarray, rates: np.ndarray, spawns: np.ndarray
    ) -> None:
        """Places the characters of some simulations on the ground.

        Each is raised until the corners of all its bounding boxes are above the ground; never
        lowered.

        Args:
          env_ids: indices of simulations whose physics has been reset.
          poses: free root, with z above the ground, then joints in link order, (m, columns of a
            pose).
          rates: velocities, (m, columns of a velocity).
          spawns: displacement x, y (m) and rotation about z (rad) of these poses, (m, 3).
        """
        world = self._world
        put_down_all(env_ids, poses, rates, spawns, self._corners, self._pack, world.pack)


def body_blocks(character: Character, terrain_observation: bool) -> tuple[Block, ...]:
    """Returns the blocks terrain, pose and velocity of a character, as `measure` gives them."""
    spec = character.spec
    names = list(spec.links)
    links = exchanged(len(names), [(names.index(a), names.index(b)) for a, b in spec.mirror])
    index, sign = mirrored_blocks(links, (*VECTOR, *QUATERNION))
    return (
        Block(
            'terrain', SAMPLES**2 if terrain_observation else 0, 'm',
            'ground heights relative to the ground under the root, 32 lines from left to right (5.5 m to '
            'each side), each with 32 points from 1 m behind to 10 m ahead', HEIGHTS,
            Reflection(LINES, np.ones(len(LINES))),
        ),
        Block(
            'pose', LINK_POSE * len(names) + 1, 'm, 1',
            'root height above the ground; then for each link, in the order of Links, the position of its '
            'centre from the root (3) and its orientation (wxyz)', PLACES,
            Reflection(np.append(0, 1 + index), np.append(1.0, sign)),
        ),
        Block(
            'velocity', LINK_VELOCITY * len(names), 'm/s, rad/s',
            'for each link the velocity of its centre relative to the ground under the root (3), and its '
            'angular velocity (3)', SPEEDS, Reflection(*mirrored_blocks(links, (*VECTOR, *SPIN))),
        ),
    )  # fmt: skip


def _addresses(starts: np.ndarray, sizes: Any) -> np.ndarray:
    """Returns the concatenated addresses of blocks with these starts and sizes."""
    blocks = [start + np.arange(size) for start, size in zip(starts, sizes, strict=True)]
    return np.concatenate(blocks) if blocks else np.zeros(0, int)


class Corners(NamedTuple):
    """Corners of the boxes of a character.

    Attributes:
      bodies: body id of the link of each corner, (C,).
      places: positions in the frame of the link, (C, 3) m.
    """

    bodies: np.ndarray
    places: np.ndarray


@compiled
def put_down(
    i: int, row: int, poses: np.ndarray, rates: np.ndarray, spawns: np.ndarray, corners: Corners,
    measured: Measured, engine: Engine,
) -> None:  # fmt: skip
    """Places the character of simulation i, from row `row` of poses, rates and spawns.

    See `SpatialFigure.place`.
    """
    body, physics, ground = measured.body, measured.state, measured.ground
    for k in range(len(body.qpos)):
        physics.qpos[i, body.qpos[k]] = poses[row, k]
    for k in range(len(body.dof)):
        physics.qvel[i, body.dof[k]] = rates[row, k]
    angle = spawns[row, 2]
    cosine, sine = math.cos(angle), math.sin(angle)
    x, y = poses[row, 0], poses[row, 1]
    x, y = spawns[row, 0] + (cosine * x - sine * y), spawns[row, 1] + (sine * x + cosine * y)
    see_movers(i, physics.qpos, ground)
    z = poses[row, 2] + spatial_ground.height(i, x, y, ground)
    columns = body.qpos
    physics.qpos[i, columns[0]], physics.qpos[i, columns[1]] = x, y
    physics.qpos[i, columns[2]] = z
    half_cosine, half_sine = math.cos(angle / 2), math.sin(angle / 2)
    q_w, q_x, q_y, q_z = poses[row, 3], poses[row, 4], poses[row, 5], poses[row, 6]
    physics.qpos[i, columns[3]] = half_cosine * q_w - half_sine * q_z
    physics.qpos[i, columns[4]] = half_cosine * q_x - half_sine * q_y
    physics.qpos[i, columns[5]] = half_cosine * q_y + half_sine * q_x
    physics.qpos[i, columns[6]] = half_cosine * q_z + q_w * half_sine
    v_x, v_y = rates[row, 0], rates[row, 1]
    physics.qvel[i, body.dof[0]] = cosine * v_x - sine * v_y
    physics.qvel[i, body.dof[1]] = sine * v_x + cosine * v_y
    native.forward(i, engine)

    depth = -math.inf
    for k in range(len(corners.bodies)):
        link = corners.bodies[k]
        w, a = physics.xquat[i, link, 0], physics.xquat[i, link, 1]
        b, c = physics.xquat[i, link, 2], physics.xquat[i, link, 3]
        x, y, z = corners.places[k, 0], corners.places[k, 1], corners.places[k, 2]
        across_x, across_y = 2 * (b * z - c * y), 2 * (c * x - a * z)
        across_z = 2 * (a * y - b * x)
        at_x = physics.xpos[i, link, 0] + ((x + w * across_x) + (b * across_z - c * across_y))
        at_y = physics.xpos[i, link, 1] + ((y + w * across_y) + (c * across_x - a * across_z))
        at_z = physics.xpos[i, link, 2] + ((z + w * across_z) + (a * across_y - b * across_x))
        depth = max(depth, spatial_ground.height(i, at_x, at_y, ground) - at_z)
    physics.qpos[i, columns[2]] += max(depth + CLEARANCE, 0.0)
    native.forward(i, engine)


@compiled
def put_down_all(
    env_ids: np.ndarray, poses: np.ndarray, rates: np.ndarray, spawns: np.ndarray,
    corners: Corners, measured: Measured, engine: Engine,
) -> None:  # fmt: skip
    """Places characters on the ground; takes packs."""
    for row in range(len(env_ids)):
        put_down(env_ids[row], row, poses, rates, spawns, corners, measured, engine)
