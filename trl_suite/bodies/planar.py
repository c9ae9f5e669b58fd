"""A body in the plane: its ids, measurement, observation and placement on planar ground."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from trl_suite.actuation.action_map import drive
from trl_suite.actuation.muscles import Muscle, optimal_length, rest_length
from trl_suite.arenas import PlanarArena
from trl_suite.bodies.blocks import HEIGHTS, PLACES, SPEEDS, Block, Noise
from trl_suite.bodies.body import CLEARANCE, MAX_JOINT_SPEED, Body, BodyData, feature_columns
from trl_suite.characters import Character
from trl_suite.engine import native
from trl_suite.terrain.planar import windows as planar_ground
from trl_suite.terrain.planar.windows import PlanarWindows
from trl_suite.util.compiled import compiled

_QUARTER_TURN = np.pi / 2  # rad; at smaller pitches a trunk faces +x: no cosine is needed


class PlanarIds(NamedTuple):
    """A body's ids in a compiled model; links and joints in link order.

    Attributes:
      qpos, dof: addresses of x, z, pitch and the joints, (3 + J,).
      turning: addresses of the rates of pitch and joints, (1 + J,).
      links: body ids, the root body first, (L,).
      effectors: body ids of the end effectors, (E,).
      share: mass of each link over the total mass, (L,).
      about_com: whether end effector positions are relative to the centre of mass, not to the root.
      samples: x of observed ground heights, relative to the root, (S,) m.
      fall: addresses of the contact sensors of fall links.
      contact: those of end effectors; empty if they have none.
      rest, scale: length of each observed muscle's tendon at zero strain, and its change per unit of
        strain, m.
    """

    qpos: np.ndarray
    dof: np.ndarray
    turning: np.ndarray
    links: np.ndarray
    effectors: np.ndarray
    share: np.ndarray
    about_com: bool
    samples: np.ndarray
    fall: np.ndarray
    contact: np.ndarray
    rest: np.ndarray
    scale: np.ndarray


class PlanarState(NamedTuple):
    """Fields of the physics that planar bodies are measured from, each (n, ...); see `World`."""

    qpos: np.ndarray
    qvel: np.ndarray
    xpos: np.ndarray
    xipos: np.ndarray
    cvel: np.ndarray
    subtree_com: np.ndarray
    sensordata: np.ndarray
    ten_length: np.ndarray


@compiled
def measure(i: int, body: BodyData) -> None:
    """Measures a body; x of positions in `pose` and `velocity` is ahead of the trunk."""
    ids, state, ground, out = body.ids, body.physics, body.ground, body.measurement
    pitch = state.qpos[i, ids.qpos[2]]
    facing = -1.0 if abs(pitch) > _QUARTER_TURN and math.cos(pitch) < 0.0 else 1.0
    x, z = state.qpos[i, ids.qpos[0]], state.qpos[i, ids.qpos[1]]
    root = ids.links[0]
    com_x, com_z = state.subtree_com[i, root, 0], state.subtree_com[i, root, 2]
    under = planar_ground.height(i, x, ground)
    out.cosine[i] = facing
    out.root[i, 0], out.root[i, 2], out.com[i, 0], out.com[i, 2] = x, z, com_x, com_z
    out.under[i], out.pose[i, 0] = under, z - under

    speed_x = speed_z = 0.0
    for k in range(len(ids.links)):
        link = ids.links[k]
        link_x, link_z = state.xipos[i, link, 0], state.xipos[i, link, 2]
        # Spatial velocities are about the centre of mass of the whole tree: v + w x r.
        spin = state.cvel[i, link, 1]
        v_x = state.cvel[i, link, 3] + (link_z - com_z) * spin
        v_z = state.cvel[i, link, 5] - (link_x - com_x) * spin
        speed_x += v_x * ids.share[k]
        speed_z += v_z * ids.share[k]
        out.pose[i, 1 + 2 * k], out.pose[i, 2 + 2 * k] = (link_x - x) * facing, link_z - z
        out.velocity[i, 2 * k], out.velocity[i, 2 * k + 1] = v_x * facing, v_z
    out.com_velocity[i, 0], out.com_velocity[i, 2] = speed_x, speed_z

    count = len(ids.turning)
    for k in range(count):
        out.features[i, k] = state.qpos[i, ids.qpos[2 + k]]
        out.features[i, count + k] = state.qvel[i, ids.turning[k]]
    column, about = 2 * count, com_x if ids.about_com else state.xpos[i, root, 0]
    for k in range(len(ids.effectors)):
        foot_x = state.xpos[i, ids.effectors[k], 0]
        foot_z = state.xpos[i, ids.effectors[k], 2]
        out.feet[i, k, 0], out.feet[i, k, 2] = foot_x, foot_z
        out.features[i, column] = foot_x - about
        out.features[i, column + 2] = foot_z - planar_ground.height(i, foot_x, ground)
        column += 3
    out.features[i, column], out.features[i, column + 2] = speed_x, speed_z
    out.features[i, column + 3] = z - under
    for k in range(len(ids.contact)):
        out.contact[i, k] = 1.0 if state.sensordata[i, ids.contact[k]] > 0.0 else 0.0
    out.fallen[i] = False
    for sensor in ids.fall:
        if state.sensordata[i, sensor] != 0.0:
            out.fallen[i] = True


@compiled
def observe_body(i: int, columns: Any, body: BodyData, observation: np.ndarray) -> None:
    """Writes the blocks of a body, as `PlanarBody.blocks` describes them."""
    ids, out = body.ids, body.measurement
    x, facing = out.root[i, 0], out.cosine[i]
    if columns.terrain >= 0:
        for k in range(len(ids.samples)):
            level = planar_ground.height(i, x + ids.samples[k] * facing, body.ground)
            observation[i, columns.terrain + k] = level - out.under[i]
    if columns.pose >= 0:
        for k in range(out.pose.shape[1]):
            observation[i, columns.pose + k] = out.pose[i, k]
        for k in range(out.velocity.shape[1]):
            observation[i, columns.velocity + k] = out.velocity[i, k]
    if columns.strain >= 0:
        for k in range(len(ids.rest)):
            stretched = body.physics.ten_length[i, k] - ids.rest[k]
            observation[i, columns.strain + k] = stretched / ids.scale[k]


@compiled
def has_diverged(i: int, limit: float, body: BodyData) -> bool:
    """Returns whether the physics has diverged, a joint exceeds `limit`, rad/s, or the ground was left."""
    ids, physics = body.ids, body.physics
    if native.diverged(i, ids.turning, limit, physics.qvel, body.engine):
        return True
    return planar_ground.is_lost(i, physics.qpos[i, ids.qpos[0]], body.ground)


@compiled
def has_left(i: int, body: BodyData) -> bool:
    """Returns whether a body has left the middle of its ground window, which must then be moved."""
    return planar_ground.has_left(i, body.physics.qpos[i, body.ids.qpos[0]], body.ground)


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
    """Writes controls; returns how many ground windows must be moved. Takes a pack."""
    leaving = 0
    for i in env_ids:
        drive(i, action, body.drive, body.ctrl)
        body.leaving[i] = has_left(i, body)
        leaving += body.leaving[i]
    return leaving


class PlanarBody(Body):
    """A planar character in every simulation of a world; see `Body`."""

    control_all, measure_all = control_all, measure_all  # compiled functions, not methods
    physics_fields = PlanarState
    arena: PlanarArena

    def __init__(
        self,
        character: Character,
        arena: PlanarArena,
        behind: float,
        ahead: float,
        samples: int,
        contact: bool = False,
        muscles: tuple[Muscle, ...] = (),
    ) -> None:
        """Attaches the character and adds a contact sensor for each of its fall links.

        Args:
          character: a planar character; it is attached to the arena and given root joints.
          arena: the arena with its terrain.
          behind: distance behind the root at which the observed ground heights begin, m.
          ahead: distance ahead of the root at which they end, m.
          samples: number of observed ground heights; 0 for none.
          contact: whether to add contact sensors for end effectors too.
          muscles: the muscles whose strain is observed.
        """
        self.character, self.arena, self._muscles = character, arena, muscles
        character.create_root_joints(arena.attach(character))
        self._samples = np.linspace(-behind, ahead, samples)
        spec, ground = character.spec, arena.ground_body
        ends = spec.end_effectors if contact else ()
        self._fall_sensors = [self._add_sensor(n, 'fall', body2=ground) for n in spec.fall_links]
        self._contact_sensors = [self._add_sensor(name, 'contact', body2=ground) for name in ends]
        links = len(character.spec.links)
        self.blocks = (
            Block(
                'terrain', samples, 'm',
                f'ground heights from {behind:g} m behind to {ahead:g} m ahead, relative to the ground under '
                'the root', HEIGHTS,
            ),
            Block(
                'pose', 2 * links + 1, 'm',
                'root height above the ground; then x, z of each link centre from the root', PLACES,
            ),
            Block('velocity', 2 * links, 'm/s', 'x, z velocity of each link centre', SPEEDS),
            Block(
                'strain', len(muscles), '1', 'strain of each muscle fibre', Noise((0.003, 0.01, 0.02)),
            ),
        )  # fmt: skip

    def _resolve(self, about_com: bool) -> PlanarIds:
        world = self._world
        character = self.character
        scope = f'{character.mjcf_model.model}/'
        names = [f'{scope}root_{axis}/' for axis in ('x', 'z', 'pitch')]
        names += [joint.full_identifier for joint in character.joints]
        self.pose_qpos, self.pose_dof = world.joint_addresses(names)
        turning = self.pose_dof[2:].copy()
        self.columns = feature_columns(0, len(turning), len(turning), len(self.effectors))
        return PlanarIds(
            qpos=self.pose_qpos,
            dof=self.pose_dof,
            turning=turning,
            links=self.links,
            effectors=self.effectors,
            share=self._share,
            about_com=about_com,
            samples=self._samples,
            fall=world.sensor_addresses(self._fall_sensors).astype(int),
            contact=world.sensor_addresses(self._contact_sensors).astype(int),
            rest=np.array([rest_length(muscle) for muscle in self._muscles]),
            scale=np.array([optimal_length(muscle) for muscle in self._muscles]),
        )

    def _ground(self) -> PlanarWindows:
        return self.arena.ground

    def recentre(self, env_ids: np.ndarray) -> None:
        self.arena.recentre(env_ids, self._world.qpos[env_ids, self.pose_qpos[0]])

    def place(
        self, env_ids: np.ndarray, poses: np.ndarray, rates: np.ndarray, extents: np.ndarray
    ) -> None:
        """Places the bodies of some simulations on the ground, at x = 0.

        Each is raised until the bounding boxes of all collision geoms are above the ground, at the
        middle and both ends of each; never lowered.

        Args:
          env_ids: indices of simulations, whose physics has been reset.
          poses: x (ignored), z above the ground, pitch and joints in link order, (m, 3 + J); x and
            z are overwritten with those of the placement.
          rates: velocities, (m, 3 + J).
          extents: extents of the collision geoms in these poses, relative to the root, (m, 3, G);
            see `trl_suite.bodies.reference.link_extents`.
        """
        put_down_all(env_ids, poses, rates, extents, self.pack)
        self._world.forward(env_ids)

    def heights(self, env_ids: np.ndarray, places: np.ndarray) -> np.ndarray:
        return self.arena.height(places[:, :1], env_ids)[:, 0]

    def level_ground(self, n: int) -> PlanarWindows:
        ground = planar_ground.empty(n)
        ground.start[:] = 0.0
        return ground


@compiled
def put_down_all(
    env_ids: np.ndarray, poses: np.ndarray, rates: np.ndarray, extents: np.ndarray, body: BodyData
) -> None:
    """Writes poses and velocities of bodies placed at x = 0; see `PlanarBody.place`."""
    ids, physics, ground = body.ids, body.physics, body.ground
    for row in range(len(env_ids)):
        i = env_ids[row]
        height = poses[row, 1] + planar_ground.height(i, 0.0, ground)
        lift = 0.0
        for k in range(extents.shape[2]):
            centre, half = extents[row, 0, k], extents[row, 1, k]
            level = planar_ground.height(i, centre - half, ground)
            level = max(level, planar_ground.height(i, centre, ground))
            level = max(level, planar_ground.height(i, centre + half, ground))
            depth = level - (height + extents[row, 2, k])
            lift = max(lift, depth + CLEARANCE)
        poses[row, 0], poses[row, 1] = 0.0, height + lift
        for k in range(len(ids.qpos)):
            physics.qpos[i, ids.qpos[k]] = poses[row, k]
            physics.qvel[i, ids.dof[k]] = rates[row, k]
