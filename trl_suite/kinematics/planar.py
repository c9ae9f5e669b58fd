"""A planar character on planar ground: measurements for all planar tasks, and initial placement."""

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

CLEARANCE = 0.001  # m; between links and ground after the initial placement
_UPRIGHT = np.pi / 2  # rad; below this pitch a trunk points forwards


class PlanarBody(NamedTuple):
    """A character's ids in a compiled model; links and joints in link order.

    Attributes:
      qpos, dof: addresses of x, z, pitch and the joints, (3 + J,).
      links: body ids, the root body first, (L,).
      effectors: body ids of the end effectors, (E,).
      share: mass of each link over the total mass, (L,).
      about_com: whether end effector positions are relative to the centre of mass, not to the root.
      samples: x of observed ground heights, relative to the root, (S,) m.
      fall, contact: addresses of contact sensors of fall links and of end effectors.
      terrain, pose, velocity: first columns of these blocks in an observation.
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
    """Results of `measure` in addition to the observation.

    Attributes:
      facing: 1, or -1 while the trunk points backwards, (n,).
      under: height of the ground under the root, (n,) m.
      height: height of the root above the ground, (n,) m.
      effectors: end effectors: all x relative to the centre of mass, or to the root, then all z
        above the ground, (n, 2 * E) m.
      com_velocity: velocity of the centre of mass, (n, 2) m/s.
      leaving: whether the character has left its ground window, which must then be moved, (n,).
      waiting: whether ground outside the window must be drawn before the measurement, (n,).
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
    """Returns 1, or -1 if the trunk points backwards: the terrain is then observed backwards."""
    pitch = state.qpos[i, body.qpos[2]]
    return -1.0 if abs(pitch) > _UPRIGHT and math.cos(pitch) < 0.0 else 1.0


@compiled
def looks_outside(
    i: int, facing: float, body: PlanarBody, state: PlanarState, ground: PlanarWindows
) -> bool:
    """Returns whether ground samples or end effectors of a character are outside its window."""
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
    """Returns whether `PlanarArena.widen` must be called before a character can be measured.

    The terrain is drawn on demand; a character that points backwards may need ground outside its
    window.
    """
    if ground.is_wide[i]:
        return False
    facing = facing_of(i, body, state)
    return facing < 0.0 and looks_outside(i, facing, body, state, ground)


@compiled
def measure(
    i: int, body: PlanarBody, state: PlanarState, ground: PlanarWindows, observation: np.ndarray,
    measurement: PlanarMeasurement,
) -> None:  # fmt: skip
    """Writes the blocks terrain, pose and velocity, and the other measurements.

    Positions are relative to the root, heights to the ground under it; x is mirrored while the trunk
    points backwards.
    """
    facing = facing_of(i, body, state)
    far = facing < 0.0 and ground.is_wide[i] and looks_outside(i, facing, body, state, ground)
    x, z = state.qpos[i, body.qpos[0]], state.qpos[i, body.qpos[1]]
    root = body.links[0]
    com_x, com_z = state.subtree_com[i, root, 0], state.subtree_com[i, root, 2]
    under = planar_ground.far_height(i, x, ground) if far else planar_ground.height(i, x, ground)
    measurement.facing[i], measurement.under[i], measurement.height[i] = facing, under, z - under

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
    measurement.com_velocity[i, 0], measurement.com_velocity[i, 1] = speed_x, speed_z

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
        measurement.effectors[i, k] = place - about
        measurement.effectors[i, count + k] = state.xpos[i, body.effectors[k], 2] - level


@compiled
def has_fallen(i: int, body: PlanarBody, state: PlanarState) -> bool:
    """Returns whether a fall link touches the ground."""
    for sensor in body.fall:
        if state.sensordata[i, sensor] != 0.0:
            return True
    return False


@compiled
def leaves(
    i: int,
    body: PlanarBody,
    state: PlanarState,
    ground: PlanarWindows,
    measurement: PlanarMeasurement,
) -> bool:
    """Writes and returns whether a character has left its ground window, which must be moved."""
    measurement.leaving[i] = planar_ground.has_left(i, state.qpos[i, body.qpos[0]], ground)
    return measurement.leaving[i]


class PlanarFigure:
    """One planar character in every simulation of a world.

    Attributes:
      body: its ids, after `bind`; see `PlanarBody`.
      state: the fields of the physics from which it is measured.
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
          arena: the arena with its terrain.
          behind: distance behind the root at which the observed ground heights begin, m.
          ahead: distance ahead of the root at which they end, m.
          samples: number of observed ground heights; 0 for none.
          contact: whether to add contact sensors for end effectors too.
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
          blocks: slices of terrain, pose and velocity in the array that `measure` writes.
          about: origin of end effector positions, the centre of mass ('com') or the 'root'.
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
        """The ground of all simulations, for compiled functions."""
        return self.arena.ground

    def empty_measurement(self) -> PlanarMeasurement:
        """Allocates the results of `measure`."""
        n = self._world.n
        return PlanarMeasurement(
            np.ones(n), np.zeros(n), np.zeros(n), np.zeros((n, 2 * len(self.effectors))),
            np.zeros((n, 2)), np.zeros(n, bool), np.zeros(n, bool),
        )  # fmt: skip

    def follow(self, env_ids: np.ndarray) -> None:
        """Moves the ground windows of some simulations to the positions of their characters."""
        self.arena.follow_all(env_ids, self._world.qpos[env_ids, self.pose_qpos[0]])

    def place(
        self, env_ids: np.ndarray, poses: np.ndarray, rates: np.ndarray, extents: np.ndarray
    ) -> None:
        """Places the characters of some simulations on the ground, at x = 0.

        Each is raised until the bounding boxes of all collision geoms are above the ground, at the
        middle and both ends of each; never lowered.

        Args:
          env_ids: numbers of simulations, which are reset.
          poses: x (ignored), z above the ground, pitch and joints in link order, (m, 3 + J); x and
            z are overwritten with those of the placement.
          rates: velocities, (m, 3 + J).
          extents: extents of the collision geoms in these poses, relative to the root, (m, 3, G);
            see `trl_suite.kinematics.planar_reference.link_extents`.
        """
        world = self._world
        world.reset(env_ids)
        put_down(
            env_ids, poses, rates, extents, self.body, self.arena.ground, world.qpos, world.qvel
        )
        world.forward(env_ids)

    def feet(self) -> np.ndarray:
        """Returns world positions of the end effectors, x and z, (n, E, 2) m."""
        return self._world.xpos[:, self.effectors, ::2]

    def ground_heights(self, env_id: int, x: np.ndarray) -> np.ndarray:
        """Returns heights of the ground of one simulation at x (k,), m."""
        return self.arena.height(x[None], slice(env_id, env_id + 1))[0]


@compiled
def put_down(
    env_ids: np.ndarray, poses: np.ndarray, rates: np.ndarray, extents: np.ndarray,
    body: PlanarBody, ground: PlanarWindows, qpos: np.ndarray, qvel: np.ndarray,
) -> None:  # fmt: skip
    """Writes poses and velocities of characters placed at x = 0; see `PlanarFigure.place`."""
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
        for k in range(len(body.qpos)):
            qpos[i, body.qpos[k]] = poses[row, k]
            qvel[i, body.dof[k]] = rates[row, k]
