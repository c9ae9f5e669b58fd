"""A planar character: its sensors, its ids in a compiled model, and its placement."""

from __future__ import annotations

import numpy as np

from trl_suite.actuation.action_map import ActionMap
from trl_suite.arenas import PlanarArena
from trl_suite.characters import Character
from trl_suite.engine import World
from trl_suite.kinematics.blocks import HEIGHTS, PLACES, SPEEDS, Block
from trl_suite.kinematics.planar import (
    PlanarBodyData,
    PlanarIds,
    PlanarState,
    control_all,
    empty_measurement,
)
from trl_suite.terrain.planar import windows as planar_ground
from trl_suite.terrain.planar.windows import PlanarWindows
from trl_suite.util.compiled import compiled, packed

CLEARANCE = 0.001  # m; between links and ground after the initial placement


class PlanarFigure:
    """One planar character in every simulation of a world.

    Attributes:
      body: its ids, after `bind`; see `PlanarIds`.
      state: the fields of the physics from which it is measured.
      measurement: the last measurement.
      data: all of these for compiled functions, if `bind` was given an action map.
      pose_qpos, pose_dof: addresses of x, z, pitch and the joints in link order.
      links, effectors: body ids, in link order.
      geoms: ids of the collision geoms.
      blocks: the observation blocks of the body.
    """

    body: PlanarIds
    state: PlanarState
    data: PlanarBodyData

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
        # As `trl_suite.kinematics.planar.measure` writes them.
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
        )  # fmt: skip

    def _add_sensor(self, link: str, kind: str) -> str:
        """Adds a sensor of the contacts between a link and the ground; returns its name."""
        name = f'{self.character.mjcf_model.model}_{link}_{kind}'
        self.arena.mjcf_model.sensor.add(
            'contact', name=name, body1=self.character.mjcf_model.find('body', link),
            body2=self.arena.ground_body, num=1, data='found',
        )  # fmt: skip
        return name

    def bind(
        self,
        world: World,
        blocks: dict[str, slice],
        about: str = 'com',
        action_map: ActionMap | None = None,
    ) -> None:
        """Resolves ids in a compiled world.

        Args:
          world: the simulations.
          blocks: slices of terrain, pose and velocity in the array that `measure` writes.
          about: origin of end effector positions, the centre of mass ('com') or the 'root'.
          action_map: the map from actions to the actuators of the joints, for `control`.
        """
        self._world = world
        self.arena.bind(world)
        self._ground = packed(self.arena.ground)
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
        self.body = PlanarIds(
            self.pose_qpos, self.pose_dof, self.links, self.effectors, mass / mass.sum(),
            about == 'com', self._samples,
            world.sensor_addresses(self._fall_sensors).astype(int),
            world.sensor_addresses(self._contact_sensors).astype(int),
            blocks['terrain'].start if 'terrain' in blocks else 0, blocks['pose'].start,
            blocks['velocity'].start,
        )  # fmt: skip
        self.state = PlanarState(*(getattr(world, name) for name in PlanarState._fields))
        self.measurement = empty_measurement(world.n, self.body)
        if action_map is not None:
            # The controls are consecutive.
            first = int(world.control_addresses([scope + action_map.actuators[0]])[0])
            self.data = PlanarBodyData(
                engine=world.engine,
                ids=self.body,
                physics=self.state,
                ground=self.ground,
                drive=action_map.drive(first),
                ctrl=world.ctrl,
                measurement=self.measurement,
                leaving=np.zeros(world.n, bool),
            )
            self._pack = packed(self.data)

    @property
    def ground(self) -> PlanarWindows:
        """The ground of all simulations, for compiled functions."""
        return self.arena.ground

    def control(self, env_ids: np.ndarray, action: np.ndarray) -> None:
        """Writes the controls of some simulations; moves ground windows, so that images show them.

        Args:
          env_ids: indices of simulations.
          action: actions of all simulations, (n, k), in [-1, 1].
        """
        if control_all(env_ids, action, self._pack):
            self.recentre(env_ids[self.data.leaving[env_ids]])

    def recentre(self, env_ids: np.ndarray) -> None:
        """Moves the ground windows of some simulations to the positions of their characters."""
        self.arena.recentre(env_ids, self._world.qpos[env_ids, self.pose_qpos[0]])

    def place(
        self, env_ids: np.ndarray, poses: np.ndarray, rates: np.ndarray, extents: np.ndarray
    ) -> None:
        """Places the characters of some simulations on the ground, at x = 0.

        Each is raised until the bounding boxes of all collision geoms are above the ground, at the
        middle and both ends of each; never lowered.

        Args:
          env_ids: indices of simulations, which are reset.
          poses: x (ignored), z above the ground, pitch and joints in link order, (m, 3 + J); x and
            z are overwritten with those of the placement.
          rates: velocities, (m, 3 + J).
          extents: extents of the collision geoms in these poses, relative to the root, (m, 3, G);
            see `trl_suite.kinematics.planar_reference.link_extents`.
        """
        world = self._world
        world.reset(env_ids)
        put_down(env_ids, poses, rates, extents, self.body, self._ground, world.qpos, world.qvel)
        world.forward(env_ids)

    def ground_heights(self, env_id: int, x: np.ndarray) -> np.ndarray:
        """Returns heights of the ground of one simulation at x (k,), m."""
        return self.arena.height(x[None], slice(env_id, env_id + 1))[0]


@compiled
def put_down(
    env_ids: np.ndarray, poses: np.ndarray, rates: np.ndarray, extents: np.ndarray,
    body: PlanarIds, ground: PlanarWindows, qpos: np.ndarray, qvel: np.ndarray,
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
