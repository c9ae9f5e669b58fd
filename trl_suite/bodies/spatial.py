"""A body in three dimensions: its ids, measurement, observation and placement."""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import Any, NamedTuple

import numpy as np

from trl_suite.actuation.action_map import drive
from trl_suite.arenas import SpatialArena
from trl_suite.bodies.blocks import HEIGHTS, PLACES, SPEEDS, Block, Reflection
from trl_suite.bodies.body import CLEARANCE, MAX_JOINT_SPEED, Body, BodyData, feature_columns
from trl_suite.characters import Character
from trl_suite.engine import native
from trl_suite.motion import quaternion
from trl_suite.motion.layout import QUATERNION, SPIN, VECTOR
from trl_suite.policies.mirror import blocks as mirrored_blocks
from trl_suite.policies.mirror import exchanged
from trl_suite.terrain.spatial import windows as spatial_ground
from trl_suite.terrain.spatial.windows import SAMPLES, SpatialWindows
from trl_suite.util.compiled import compiled

LINK_POSE, LINK_VELOCITY = 7, 6  # numbers of each link in the blocks pose and velocity
_LEVEL = spatial_ground.Capacity(
    level=True, grid=False, boxes=0, belts=0, movers=0, strips=False
)  # of reference motions
MAPS = 'height', 'velocity'  # of the ground: what the blocks terrain and surface have
# Reflection of a map, whose lines are from left to right.
_LINES = np.arange(SAMPLES**2).reshape(SAMPLES, SAMPLES)[::-1].ravel()


class SpatialIds(NamedTuple):
    """A body's ids in a compiled model; links and joints in link order.

    Attributes:
      qpos, dof: addresses of the columns of a pose and of a velocity, as `motion.Layout` has them:
        root, then joints.
      turning: addresses of the joints' rates.
      angles: addresses of the quaternions of ball joints, four each, then of the other joints.
      links, effectors, share, about_com, fall: see `PlanarIds`.
      contact: addresses of the contact sensors of end effectors, (E, sensors per end effector).
      corners: corners of the boxes of all collision geoms.
    """

    qpos: np.ndarray
    dof: np.ndarray
    turning: np.ndarray
    angles: np.ndarray
    links: np.ndarray
    effectors: np.ndarray
    share: np.ndarray
    about_com: bool
    fall: np.ndarray
    contact: np.ndarray
    corners: Corners


class Corners(NamedTuple):
    """Corners of boxes.

    Attributes:
      bodies: body id of the link of each corner, (C,).
      places: positions in the frame of the link, (C, 3) m.
    """

    bodies: np.ndarray
    places: np.ndarray


class SpatialState(NamedTuple):
    """Fields of the physics that spatial bodies are measured from, each (n, ...); see `World`."""

    qpos: np.ndarray
    qvel: np.ndarray
    xpos: np.ndarray
    xquat: np.ndarray
    xipos: np.ndarray
    cvel: np.ndarray
    subtree_com: np.ndarray
    sensordata: np.ndarray


@compiled
def measure(i: int, body: BodyData) -> None:
    """Measures a body: pose and velocity in the heading frame, heights above the current ground.

    Quaternions have w >= 0; velocities of centres are relative to the ground under the root.
    """
    ids, state, ground, out = body.ids, body.physics, body.ground, body.measurement
    spatial_ground.see_movers(i, state.qpos, ground)
    root = ids.links[0]
    root_x, root_y, root_z = state.xpos[i, root, 0], state.xpos[i, root, 1], state.xpos[i, root, 2]
    com_x, com_y = state.subtree_com[i, root, 0], state.subtree_com[i, root, 1]
    com_z = state.subtree_com[i, root, 2]
    w, x = state.xquat[i, root, 0], state.xquat[i, root, 1]
    y, z = state.xquat[i, root, 2], state.xquat[i, root, 3]
    heading = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    cosine, sine = math.cos(heading), math.sin(heading)
    half_cosine, half_sine = math.cos(0.5 * heading), -math.sin(0.5 * heading)  # of -heading
    under = spatial_ground.height(i, root_x, root_y, ground)
    drift_x = drift_y = 0.0  # velocity of the ground under the root, m/s
    if ground.box_velocity.shape[1] + ground.mover_top.shape[1] > 0:
        drift_x, drift_y = spatial_ground.velocity(i, root_x, root_y, ground)
    out.root[i, 0], out.root[i, 1], out.root[i, 2] = root_x, root_y, root_z
    out.com[i, 0], out.com[i, 1], out.com[i, 2] = com_x, com_y, com_z
    out.heading[i], out.cosine[i], out.sine[i] = heading, cosine, sine
    out.under[i] = under
    out.pose[i, 0] = root_z - under

    speed_x = speed_y = speed_z = 0.0
    for k in range(len(ids.links)):
        link = ids.links[k]
        centre_x, centre_y = state.xipos[i, link, 0], state.xipos[i, link, 1]
        centre_z = state.xipos[i, link, 2]
        spin_x, spin_y = state.cvel[i, link, 0], state.cvel[i, link, 1]
        spin_z = state.cvel[i, link, 2]
        # Spatial velocities are about the centre of mass of the whole tree: v + w x r.
        arm_x, arm_y, arm_z = centre_x - com_x, centre_y - com_y, centre_z - com_z
        v_x = state.cvel[i, link, 3] + (spin_y * arm_z - spin_z * arm_y)
        v_y = state.cvel[i, link, 4] + (spin_z * arm_x - spin_x * arm_z)
        v_z = state.cvel[i, link, 5] + (spin_x * arm_y - spin_y * arm_x)
        speed_x += v_x * ids.share[k]
        speed_y += v_y * ids.share[k]
        speed_z += v_z * ids.share[k]

        column = 1 + LINK_POSE * k
        away_x, away_y = centre_x - root_x, centre_y - root_y
        out.pose[i, column] = cosine * away_x + sine * away_y
        out.pose[i, column + 1] = cosine * away_y - sine * away_x
        out.pose[i, column + 2] = centre_z - root_z
        w, x = state.xquat[i, link, 0], state.xquat[i, link, 1]
        y, z = state.xquat[i, link, 2], state.xquat[i, link, 3]
        turned_w, turned_x = half_cosine * w - half_sine * z, half_cosine * x - half_sine * y
        turned_y, turned_z = half_cosine * y + half_sine * x, half_cosine * z + half_sine * w
        if k == 0:
            out.features[i, 0], out.features[i, 1] = turned_w, turned_x
            out.features[i, 2], out.features[i, 3] = turned_y, turned_z
        sign = -1.0 if turned_w < 0.0 else 1.0
        out.pose[i, column + 3], out.pose[i, column + 4] = sign * turned_w, sign * turned_x
        out.pose[i, column + 5], out.pose[i, column + 6] = sign * turned_y, sign * turned_z
        column = LINK_VELOCITY * k
        v_x, v_y = v_x - drift_x, v_y - drift_y
        out.velocity[i, column] = cosine * v_x + sine * v_y
        out.velocity[i, column + 1] = cosine * v_y - sine * v_x
        out.velocity[i, column + 2] = v_z
        out.velocity[i, column + 3] = cosine * spin_x + sine * spin_y
        out.velocity[i, column + 4] = cosine * spin_y - sine * spin_x
        out.velocity[i, column + 5] = spin_z
    out.com_velocity[i, 0], out.com_velocity[i, 1] = speed_x, speed_y
    out.com_velocity[i, 2] = speed_z

    column = 4 + len(ids.angles)
    for k in range(len(ids.angles)):
        out.features[i, 4 + k] = state.qpos[i, ids.angles[k]]
    for k in range(3):
        out.features[i, column + k] = out.velocity[i, 3 + k]
    for k in range(len(ids.turning)):
        out.features[i, column + 3 + k] = state.qvel[i, ids.turning[k]]
    features = column + 3 + len(ids.turning)
    middle_x, middle_y = (com_x, com_y) if ids.about_com else (root_x, root_y)
    for k in range(len(ids.effectors)):
        foot = ids.effectors[k]
        foot_x, foot_y = state.xpos[i, foot, 0], state.xpos[i, foot, 1]
        foot_z = state.xpos[i, foot, 2]
        out.feet[i, k, 0], out.feet[i, k, 1], out.feet[i, k, 2] = foot_x, foot_y, foot_z
        away_x, away_y = foot_x - middle_x, foot_y - middle_y
        out.features[i, features] = cosine * away_x + sine * away_y
        out.features[i, features + 1] = cosine * away_y - sine * away_x
        level = spatial_ground.height(i, foot_x, foot_y, ground)
        out.features[i, features + 2] = foot_z - level
        features += 3
        touching = 0.0
        for sensor in ids.contact[k]:
            if state.sensordata[i, sensor] > 0.0:
                touching = 1.0
        out.contact[i, k] = touching
    for k in range(3):
        out.features[i, features + k] = out.com_velocity[i, k]
    out.features[i, features + 3] = root_z - under
    out.fallen[i] = False
    for sensor in ids.fall:
        if state.sensordata[i, sensor] != 0.0:
            out.fallen[i] = True


@compiled
def observe_body(i: int, columns: Any, body: BodyData, observation: np.ndarray) -> None:
    """Writes the blocks terrain, surface, pose and velocity of a body; see `body_blocks`."""
    out = body.measurement
    x, y, heading = out.root[i, 0], out.root[i, 1], out.heading[i]
    if columns.terrain >= 0:
        block = observation[i, columns.terrain : columns.terrain + SAMPLES * SAMPLES]
        spatial_ground.height_map(i, x, y, heading, body.ground, block)
    if columns.surface >= 0:
        block = observation[i, columns.surface : columns.surface + 2 * SAMPLES * SAMPLES]
        spatial_ground.velocity_map(i, x, y, heading, body.ground, block)
    if columns.pose >= 0:
        for k in range(out.pose.shape[1]):
            observation[i, columns.pose + k] = out.pose[i, k]
        for k in range(out.velocity.shape[1]):
            observation[i, columns.velocity + k] = out.velocity[i, k]


@compiled
def has_diverged(i: int, limit: float, body: BodyData) -> bool:
    """Returns whether the physics has diverged, a joint exceeds `limit`, rad/s, or the ground was left."""
    ids, physics = body.ids, body.physics
    root = physics.xpos[i, ids.links[0]]
    if native.diverged(i, ids.turning, limit, physics.qvel, body.engine):
        return True
    return spatial_ground.is_lost(i, root[0], root[1], root[2], body.ground)


@compiled
def measure_all(env_ids: np.ndarray, stepped: bool, body: BodyData) -> None:
    """Measures and observes bodies; see `Body.measure`. Takes a pack."""
    for i in env_ids:
        if stepped:
            body.diverged[i] = has_diverged(i, MAX_JOINT_SPEED, body)
            if body.diverged[i]:
                continue
        measure(i, body)
        observe_body(i, body.columns, body, body.observation)


@compiled
def control_all(env_ids: np.ndarray, action: np.ndarray, body: BodyData) -> int:
    """Writes controls and drives moving boxes; returns how many ground windows must be moved.

    To move a window drives its boxes as well. Takes a pack.
    """
    leaving, root = 0, body.ids.links[0]
    for i in env_ids:
        drive(i, action, body.drive, body.ctrl)
        x, y = body.physics.xpos[i, root, 0], body.physics.xpos[i, root, 1]
        body.leaving[i] = spatial_ground.has_left(i, x, y, body.ground)
        if body.leaving[i]:
            leaving += 1
        elif spatial_ground.keep_moving(i, x, y, body.physics.qpos, body.physics.qvel, body.ground):
            native.forward(i, body.engine)
    return leaving


class SpatialBody(Body):
    """A three-dimensional character in every simulation of a world; see `Body`."""

    fields = ('xquat',)
    control_all, measure_all = control_all, measure_all  # compiled functions, not methods
    physics_fields = SpatialState
    arena: SpatialArena

    def __init__(
        self, character: Character, arena: SpatialArena, terrain_observation: Collection[str]
    ) -> None:
        """Attaches the character; adds contact sensors for its fall links and end effectors.

        Args:
          character: a spatial character; it is attached to the arena and given a free joint.
          arena: the arena with its terrain.
          terrain_observation: maps of the ground that are observed, of `MAPS`.
        """
        self.character, self.arena = character, arena
        (self._root,) = character.create_root_joints(arena.attach(character))
        self._sensors = {
            kind: [
                self._add_sensor(link, f'{kind}_{i}', **ground)
                for link in links
                for i, ground in enumerate(arena.touched)
            ]
            for kind, links in (
                ('fall', character.spec.fall_links),
                ('contact', character.spec.end_effectors),
            )
        }
        self.blocks = body_blocks(character, terrain_observation)

    def _resolve(self, about_com: bool) -> SpatialIds:
        world = self._world
        character = self.character
        names = [self._root.full_identifier, *(j.full_identifier for j in character.joints)]
        qpos, dof = world.joint_addresses(names)
        ball = character.spherical
        sizes, rates = np.where(ball, 4, 1), np.where(ball, 3, 1)
        self.pose_qpos = _addresses(qpos, [7, *sizes])
        self.pose_dof = _addresses(dof, [6, *rates])
        balls = _addresses(qpos[1:][ball], sizes[ball])
        fall, contact = (
            world.sensor_addresses(names).astype(int) for names in self._sensors.values()
        )
        hinges, turning = np.count_nonzero(~ball), self.pose_dof[3:].size
        self.columns = feature_columns(4 + len(balls), int(hinges), turning, len(self.effectors))
        return SpatialIds(
            qpos=self.pose_qpos,
            dof=self.pose_dof,
            turning=self.pose_dof[6:].copy(),
            angles=np.concatenate([balls, qpos[1:][~ball]]),
            links=self.links,
            effectors=self.effectors,
            share=self._share,
            about_com=about_com,
            fall=fall,
            contact=contact.reshape(-1, len(self.arena.touched)),
            corners=self._corners(),
        )

    def _ground(self) -> SpatialWindows:
        return self.arena.surroundings.arrays

    def _corners(self) -> Corners:
        model = self._world.models[0]
        signs = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3, indexing='ij'), axis=-1).reshape(8, 3)
        boxes = model.geom_aabb[self.geoms, None]  # centres and half sizes, in the geoms' frames
        places = quaternion.rotate(
            model.geom_quat[self.geoms, None], boxes[..., :3] + signs * boxes[..., 3:]
        )
        places += model.geom_pos[self.geoms, None]  # in the links' frames
        bodies = np.repeat(model.geom_bodyid[self.geoms], 8).astype(int)
        return Corners(bodies, places.reshape(-1, 3))

    def recentre(self, env_ids: np.ndarray) -> None:
        self.arena.recentre(env_ids, self._world.xpos[env_ids, self.links[0], :2])

    def place(
        self, env_ids: np.ndarray, poses: np.ndarray, rates: np.ndarray, spawns: np.ndarray
    ) -> None:
        """Places the bodies of some simulations on the ground.

        Each is raised until the corners of all its bounding boxes are above the ground; never
        lowered.

        Args:
          env_ids: indices of simulations whose physics has been reset.
          poses: free root, with z above the ground, then joints in link order, (m, columns of a
            pose).
          rates: velocities, (m, columns of a velocity).
          spawns: displacement x, y (m) and rotation about z (rad) of these poses, (m, 3).
        """
        put_down_all(env_ids, poses, rates, spawns, self.pack)

    def heights(self, env_ids: np.ndarray, places: np.ndarray) -> np.ndarray:
        return self.arena.height(places[:, :1], places[:, 1:], env_ids)[:, 0]

    def level_ground(self, n: int) -> SpatialWindows:
        ground = spatial_ground.empty(n, _LEVEL)
        ground.level[:] = 0.0
        return ground


def body_blocks(character: Character, maps: Collection[str]) -> tuple[Block, ...]:
    """Returns the blocks terrain, surface, pose and velocity of a character, as `observe_body` writes them.

    Args:
      character: the character.
      maps: the maps of the ground that are observed, of `MAPS`.
    """
    spec = character.spec
    names = list(spec.links)
    links = exchanged(len(names), [(names.index(a), names.index(b)) for a, b in spec.mirror])
    index, sign = mirrored_blocks(links, (*VECTOR, *QUATERNION))
    return (
        Block(
            'terrain', SAMPLES**2 if 'height' in maps else 0, 'm',
            'ground heights relative to the ground under the root, 32 lines from left to right (5.5 m to '
            'each side), each with 32 points from 1 m behind to 10 m ahead', HEIGHTS,
            Reflection(_LINES, np.ones(len(_LINES))),
        ),
        Block(
            'surface', 2 * SAMPLES**2 if 'velocity' in maps else 0, 'm/s',
            'velocity of the ground relative to that under the root, on 32 lines from left to right (5.5 m to '
            'each side), each with 32 points from 1 m behind to 10 m ahead: first all components ahead, then '
            'all components to the right',
            HEIGHTS._replace(bias=(0.0, 0.0, 0.0)),
            Reflection(np.append(_LINES, SAMPLES**2 + _LINES), np.repeat([1.0, -1.0], SAMPLES**2)),
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


@compiled
def put_down_all(
    env_ids: np.ndarray, poses: np.ndarray, rates: np.ndarray, spawns: np.ndarray, body: BodyData
) -> None:
    """Places bodies on the ground; see `SpatialBody.place`. Takes a pack."""
    ids, physics, ground, corners = body.ids, body.physics, body.ground, body.ids.corners
    for row in range(len(env_ids)):
        i = env_ids[row]
        for k in range(len(ids.qpos)):
            physics.qpos[i, ids.qpos[k]] = poses[row, k]
        for k in range(len(ids.dof)):
            physics.qvel[i, ids.dof[k]] = rates[row, k]
        angle = spawns[row, 2]
        cosine, sine = math.cos(angle), math.sin(angle)
        x, y = poses[row, 0], poses[row, 1]
        x, y = spawns[row, 0] + (cosine * x - sine * y), spawns[row, 1] + (sine * x + cosine * y)
        spatial_ground.see_movers(i, physics.qpos, ground)
        z = poses[row, 2] + spatial_ground.height(i, x, y, ground)
        columns = ids.qpos
        physics.qpos[i, columns[0]], physics.qpos[i, columns[1]] = x, y
        physics.qpos[i, columns[2]] = z
        half_cosine, half_sine = math.cos(angle / 2), math.sin(angle / 2)
        q_w, q_x, q_y, q_z = poses[row, 3], poses[row, 4], poses[row, 5], poses[row, 6]
        physics.qpos[i, columns[3]] = half_cosine * q_w - half_sine * q_z
        physics.qpos[i, columns[4]] = half_cosine * q_x - half_sine * q_y
        physics.qpos[i, columns[5]] = half_cosine * q_y + half_sine * q_x
        physics.qpos[i, columns[6]] = half_cosine * q_z + q_w * half_sine
        v_x, v_y = rates[row, 0], rates[row, 1]
        physics.qvel[i, ids.dof[0]] = cosine * v_x - sine * v_y
        physics.qvel[i, ids.dof[1]] = sine * v_x + cosine * v_y
        native.forward(i, body.engine)

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
        native.forward(i, body.engine)
