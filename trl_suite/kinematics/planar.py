"""A planar character on planar ground: what every planar task measures, and how it is placed."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from trl_suite.arenas import PlanarArena
from trl_suite.characters import Character
from trl_suite.engine import World
from trl_suite.terrain.planar import windows as planar_ground
from trl_suite.terrain.planar.windows import PlanarWindows
from trl_suite.util.compiled import compiled

CLEARANCE = 0.001  # m; left under every link at the start
_UPRIGHT = np.pi / 2  # rad; beyond it a trunk may point backwards


class PlanarBody(NamedTuple):
    """A character's ids in a compiled model; links and joints in link order.

    Attributes:
      qpos, dof: addresses of x, z, pitch and the joints, (3 + J,).
      links: body ids, the root body first, (L,).
      effectors: body ids of the end effectors, (E,).
      share: of each link in the mass, (L,).
      about_com: whether end effectors are measured from the centre of mass, else from the root.
      samples: where ground heights are observed, ahead of the root, (S,) m.
      fall, contact: addresses of contact sensors of fall links and of end effectors.
      terrain, pose, velocity: where these blocks begin in an observation.
    """

    qpos: np.ndarray
    dof: np.ndarray
    links: np.ndarray
    effectors: np.ndarray
    share: np.ndarray
    about_com: bool
    samples: np.ndarray
    fall: np.ndarray
    contact: np.ndarray
    terrain: int
    pose: int
    velocity: int


class PlanarState(NamedTuple):
    """Fields of the physics that planar tasks read, each (n, ...); see `engine.World`."""

    qpos: np.ndarray
    qvel: np.ndarray
    xpos: np.ndarray
    xipos: np.ndarray
    cvel: np.ndarray
    subtree_com: np.ndarray
    sensordata: np.ndarray
    ten_length: np.ndarray


class PlanarMeasurement(NamedTuple):
    """What `measure` finds beside the observation.

    Attributes:
      facing: 1, or -1 while the trunk points backwards, (n,).
      under: height of the ground under the root, (n,) m.
      height: of the root above it, (n,) m.
      effectors: end effectors: all x ahead of the centre of mass, or of the root, then all z above
        the ground, (n, 2 * E) m.
      com_velocity: of the centre of mass, (n, 2) m/s.
      leaving: whether the window of ground has to be laid anew, (n,).
      waiting: whether ground that a simulation looks back on has to be drawn first, (n,).
    """

    facing: np.ndarray
    under: np.ndarray
    height: np.ndarray
    effectors: np.ndarray
    com_velocity: np.ndarray
    leaving: np.ndarray
    waiting: np.ndarray


@compiled
def facing_of(i: int, body: PlanarBody, state: PlanarState) -> float:
    """Returns 1, or -1 where the trunk points backwards and so looks backwards."""
    pitch = state.qpos[i, body.qpos[2]]
    return -1.0 if abs(pitch) > _UPRIGHT and math.cos(pitch) < 0.0 else 1.0


@compiled
def looks_outside(
    i: int, facing: float, body: PlanarBody, state: PlanarState, ground: PlanarWindows
) -> bool:
    """Whether a character that looks backwards sees ground beyond its window."""
    x = state.qpos[i, body.qpos[0]]
    for sample in body.samples:
        if planar_ground.is_outside(i, x + sample * facing, ground):
            return True
    for effector in body.effectors:
        if planar_ground.is_outside(i, state.xpos[i, effector, 0], ground):
            return True
    return False


@compiled
def must_wait(i: int, body: PlanarBody, state: PlanarState, ground: PlanarWindows) -> bool:
    """Whether `PlanarArena.widen` has to be called before a character can be measured."""
    if ground.is_wide[i]:
        return False
    facing = facing_of(i, body, state)
    return facing < 0.0 and looks_outside(i, facing, body, state, ground)


@compiled
def measure(
    i: int, body: PlanarBody, state: PlanarState, ground: PlanarWindows, observation: np.ndarray,
    found: PlanarMeasurement,
) -> None:  # fmt: skip
    """Writes the blocks terrain, pose and velocity, and what else tasks compare.

    Positions are relative to the root, heights to the ground under it; x is mirrored while the trunk
    points backwards.
    """
    facing = facing_of(i, body, state)
    far = facing < 0.0 and ground.is_wide[i] and looks_outside(i, facing, body, state, ground)
    x, z = state.qpos[i, body.qpos[0]], state.qpos[i, body.qpos[1]]
    root = body.links[0]
    com_x, com_z = state.subtree_com[i, root, 0], state.subtree_com[i, root, 2]
    under = planar_ground.far_height(i, x, ground) if far else planar_ground.height(i, x, ground)
    found.facing[i], found.under[i], found.height[i] = facing, under, z - under

    speed_x = speed_z = 0.0
    observation[i, body.pose] = z - under
    for k in range(len(body.links)):
        link = body.links[k]
        link_x, link_z = state.xipos[i, link, 0], state.xipos[i, link, 2]
        # Spatial velocities are about the centre of mass of the whole tree: v + w x r.
        spin = state.cvel[i, link, 1]
        v_x = state.cvel[i, link, 3] + (link_z - com_z) * spin
        v_z = state.cvel[i, link, 5] - (link_x - com_x) * spin
        speed_x += v_x * body.share[k]
        speed_z += v_z * body.share[k]
        observation[i, body.pose + 1 + 2 * k] = (link_x - x) * facing
        observation[i, body.pose + 2 + 2 * k] = link_z - z
        observation[i, body.velocity + 2 * k] = v_x * facing
        observation[i, body.velocity + 2 * k + 1] = v_z
    found.com_velocity[i, 0], found.com_velocity[i, 1] = speed_x, speed_z

    for k in range(len(body.samples)):
        ahead = x + body.samples[k] * facing
        if far:
            level = planar_ground.far_height(i, ahead, ground)
        else:
            level = planar_ground.height(i, ahead, ground)
        observation[i, body.terrain + k] = level - under
    count = len(body.effectors)
    about = com_x if body.about_com else state.xpos[i, root, 0]
    for k in range(count):
        place = state.xpos[i, body.effectors[k], 0]
        if far:
            level = planar_ground.far_height(i, place, ground)
        else:
            level = planar_ground.height(i, place, ground)
        found.effectors[i, k] = place - about
        found.effectors[i, count + k] = state.xpos[i, body.effectors[k], 2] - level


@compiled
def has_fallen(i: int, body: PlanarBody, state: PlanarState) -> bool:
    """Whether a fall link touches the ground."""
    for sensor in body.fall:
        if state.sensordata[i, sensor] != 0.0:
            return True
    return False


@compiled
def leaves(
    i: int, body: PlanarBody, state: PlanarState, ground: PlanarWindows, found: PlanarMeasurement
) -> bool:
    """Whether a window of ground must be laid anew; notes it."""
    found.leaving[i] = planar_ground.has_left(i, state.qpos[i, body.qpos[0]], ground)
    return found.leaving[i]


class PlanarFigure:
    """One planar character in every simulation of a world.

    Attributes:
      body: its ids, after `bind`; see `PlanarBody`.
      state: the fields of the physics that it is measured by.
      pose_qpos, pose_dof: addresses of x, z, pitch and the joints in link order.
      links, effectors: body ids, in link order.
      geoms: ids of the collision geoms.
    """

    body: PlanarBody
    state: PlanarState

    def __init__(
        self,
        character: Character,
        arena: PlanarArena,
        behind: float,
        ahead: float,
        samples: int,
        contact: bool = False,
    ) -> None:
        """Attaches the character and adds a contact sensor for each of its fall links.

        Args:
          character: a planar character; it is attached to the arena and given root joints.
          arena: where it moves.
          behind: where the line of observed ground heights begins, m behind the root.
          ahead: where it ends, m ahead of the root.
          samples: number of heights on that line; 0 is blind.
          contact: whether to sense the contacts of end effectors too.
        """
        self.character, self.arena = character, arena
        character.create_root_joints(arena.attach(character))
        self._samples = np.linspace(-behind, ahead, samples)
        self._fall_sensors = [self._add_sensor(n, 'fall') for n in character.spec.fall_links]
        ends = character.spec.end_effectors if contact else ()
        self._contact_sensors = [self._add_sensor(name, 'contact') for name in ends]
        links = len(character.spec.links)
        self.blocks = {'terrain': samples, 'pose': 2 * links + 1, 'velocity': 2 * links}

    def _add_sensor(self, link: str, kind: str) -> str:
        """Adds a sensor of the contacts between a link and the ground; returns its name."""
        name = f'{self.character.mjcf_model.model}_{link}_{kind}'
        self.arena.mjcf_model.sensor.add(
            'contact', name=name, body1=self.character.mjcf_model.find('body', link),
            body2=self.arena.ground_body, num=1, data='found',
        )  # fmt: skip
        return name

    def bind(self, world: World, blocks: dict[str, slice], about: str = 'com') -> None:
        """Resolves ids in a compiled world.

        Args:
          world: the simulations.
          blocks: where terrain, pose and velocity lie in what `measure` writes.
          about: from where end effectors are measured, the centre of mass ('com') or the 'root'.
        """
        self._world = world
        self.arena.bind(world)
        character = self.character
        scope = f'{character.mjcf_model.model}/'
        root = world.joint_addresses([f'{scope}root_{axis}/' for axis in ('x', 'z', 'pitch')])
        joints = world.joint_addresses([joint.full_identifier for joint in character.joints])
        self.pose_qpos, self.pose_dof = (
            np.concatenate(addresses) for addresses in zip(root, joints, strict=True)
        )
        self.links = world.body_ids([body.full_identifier for body in character.bodies])
        self.effectors = world.body_ids([b.full_identifier for b in character.end_effectors])
        self.geoms = world.geom_ids([g.full_identifier for g in character.collision_geoms])
        mass = world.models[0].body_mass[self.links]
        self.body = PlanarBody(
            self.pose_qpos, self.pose_dof, self.links, self.effectors, mass / mass.sum(),
            about == 'com', self._samples,
            world.sensor_addresses(self._fall_sensors).astype(int),
            world.sensor_addresses(self._contact_sensors).astype(int),
            blocks['terrain'].start if 'terrain' in blocks else 0, blocks['pose'].start,
            blocks['velocity'].start,
        )  # fmt: skip
        self.state = PlanarState(*(getattr(world, name) for name in PlanarState._fields))

    @property
    def ground(self) -> PlanarWindows:
        """The ground under all simulations, for compiled functions."""
        return self.arena.ground

    def measurement(self) -> PlanarMeasurement:
        """Makes room for what `measure` finds."""
        n = self._world.n
        return PlanarMeasurement(
            np.ones(n), np.zeros(n), np.zeros(n), np.zeros((n, 2 * len(self.effectors))),
            np.zeros((n, 2)), np.zeros(n, bool), np.zeros(n, bool),
        )  # fmt: skip

    def follow(self, env_ids: np.ndarray) -> None:
        """Lays the windows of ground of some simulations anew, about where they are."""
        self.arena.follow_all(env_ids, self._world.qpos[env_ids, self.pose_qpos[0]])

    def place(
        self, env_ids: np.ndarray, poses: np.ndarray, rates: np.ndarray, extents: np.ndarray
    ) -> None:
        """Puts the characters of some simulations at x = 0 onto the ground.

        Each is lifted until every link's bounding box is clear of the ground under its middle and
        its ends; never lowered.

        Args:
          env_ids: which simulations; they are reset.
          poses: x (ignored), z above the ground, pitch and joints in link order, (m, 3 + J); they
            come back with x and z as placed.
          rates: their velocities, (m, 3 + J).
          extents: of the collision geoms in these poses, relative to the root, (m, 3, G); see
            `trl_suite.kinematics.planar_reference.link_extents`.
        """
        world = self._world
        world.reset(env_ids)
        put_down(
            env_ids, poses, rates, extents, self.body, self.arena.ground, world.qpos, world.qvel
        )
        world.forward(env_ids)

    def feet(self) -> np.ndarray:
        """Returns where the end effectors are in the world, x and z, (n, E, 2) m."""
        return self._world.xpos[:, self.effectors, ::2]

    def ground_heights(self, env_id: int, x: np.ndarray) -> np.ndarray:
        """Heights of the ground of one simulation at x (k,), m."""
        return self.arena.height(x[None], slice(env_id, env_id + 1))[0]


@compiled
def put_down(
    env_ids: np.ndarray, poses: np.ndarray, rates: np.ndarray, extents: np.ndarray,
    body: PlanarBody, ground: PlanarWindows, qpos: np.ndarray, qvel: np.ndarray,
) -> None:  # fmt: skip
    """Writes the poses and velocities of characters that stand at x = 0; see `PlanarFigure.place`."""
    for env_id in range(len(env_ids)):
        i = env_ids[env_id]
        height = poses[env_id, 1] + planar_ground.height(i, 0.0, ground)
        lift = 0.0
        for k in range(extents.shape[2]):
            centre, half = extents[env_id, 0, k], extents[env_id, 1, k]
            level = planar_ground.height(i, centre - half, ground)
            level = max(level, planar_ground.height(i, centre, ground))
            level = max(level, planar_ground.height(i, centre + half, ground))
            depth = level - (height + extents[env_id, 2, k])
            lift = max(lift, depth + CLEARANCE)
        poses[env_id, 0], poses[env_id, 1] = 0.0, height + lift
        for k in range(len(body.qpos)):
            qpos[i, body.qpos[k]] = poses[env_id, k]
            qvel[i, body.dof[k]] = rates[env_id, k]
