"""A planar character on planar ground as arrays: what every planar task measures and resets."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from trl_suite.arenas import PlanarTerrain
from trl_suite.characters import Character
from trl_suite.engine import World

CLEARANCE = 0.001  # m; left under every link at the start
_UPRIGHT = np.pi / 2  # rad; beyond it a trunk may point backwards


class PlanarFigure:
    """Kinematics of one character in every simulation of a world, over a leading batch axis.

    Everything is in link order: `take` with precomputed addresses both orders and packs the engine's
    arrays, and arithmetic on packed arrays of equal shape costs a third of what broadcasting does.
    That is why repeated operands (the root under every link) are taken, not broadcast.

    Attributes:
      pose_qpos, pose_dof: addresses of x, z, pitch and the joints in link order.
      links, effectors: body ids, in link order.
      geoms: ids of the collision geoms.
    """

    def __init__(
        self,
        character: Character,
        arena: PlanarTerrain,
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
        # The last sample is the ground under the root, from which all heights are measured.
        self._samples = np.append(np.linspace(-behind, ahead, samples), 0.0)
        self._fall_sensors = [self._add_sensor(n, 'fall') for n in character.row.fall_links]
        ends = character.row.end_effectors if contact else ()
        self._contact_sensors = [self._add_sensor(name, 'contact') for name in ends]
        links = len(character.row.links)
        self.blocks = {'terrain': samples, 'pose': 2 * links + 1, 'velocity': 2 * links}

    def _add_sensor(self, link: str, kind: str) -> str:
        """Adds a sensor of the contacts between a link and the ground; returns its name."""
        name = f'{self.character.mjcf_model.model}_{link}_{kind}'
        self.arena.mjcf_model.sensor.add(
            'contact', name=name, body1=self.character.mjcf_model.find('body', link),
            body2=self.arena.ground_body, num=1, data='found',
        )  # fmt: skip
        return name

    def bind(self, world: World, about: str = 'com') -> None:
        """Resolves ids in a compiled world and allocates scratch of `world.n` rows.

        Args:
          world: the simulations.
          about: from where end effectors are measured, the centre of mass ('com') or the 'root'.
        """
        self._world, self._about = world, about
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
        links, root_body = self.links, self.links[0]
        count = len(links)
        # Addresses in flat arrays, x and z by turns.
        self._xz = np.stack([3 * links, 3 * links + 2], axis=1).ravel()
        self._zx = np.stack([3 * links + 2, 3 * links], axis=1).ravel()
        self._linear = np.stack([6 * links + 3, 6 * links + 5], axis=1).ravel()
        self._spin = np.repeat(6 * links + 1, 2)
        self._root_xz = np.tile(self.pose_qpos[:2], count)
        self._com_zx = np.tile([3 * root_body + 2, 3 * root_body], count)
        self._com_x = np.full(len(self.effectors), 3 * root_body)
        # Columns of end effectors: all x, then all z.
        self._effector_xz = np.concatenate([3 * self.effectors, 3 * self.effectors + 2])
        # v = w x r in the x-z plane is (w z, -w x) for w about +y.
        self._cross = np.tile([1.0, -1.0], count)[None]
        mass = world.models[0].body_mass[links]
        self._share = np.kron((mass / mass.sum())[:, None], np.eye(2))  # (2 * links, 2)
        falls = world.sensor_addresses(self._fall_sensors)  # added one after the other
        self._fall = slice(int(falls[0]), int(falls[-1]) + 1)
        self._contact = world.sensor_addresses(self._contact_sensors)
        # One ground query serves samples, root and end effectors.
        self._ground_x = np.zeros((world.n, len(self._samples) + len(self.effectors)))

    def views(
        self,
        observation: np.ndarray,
        blocks: dict[str, slice],
        effectors: np.ndarray,
        com_velocity: np.ndarray,
    ) -> SimpleNamespace:
        """The parts of all arrays that a measurement reads and writes.

        Args:
          observation: (n, size); terrain, pose and velocity are written there.
          blocks: where they lie.
          effectors: where end effectors are written, (n, 2 * E): all x ahead of the centre of mass,
            or of the root, then all z above the ground, m.
          com_velocity: where the velocity of the centre of mass is written, (n, 2), m/s.

        Returns:
          A namespace for `measure`. Of use to tasks: `x`, `z`, `pitch` (n, 1), `rates` of the joints
          (n, J or more), `height` (n, 1) of the root above the ground, `fall` (n, F) contact
          counts, and after `measure` `facing` and `under` (n, 1), the ground under the root, m.
        """
        world, n = self._world, self._world.n
        x, z, pitch = self.pose_qpos[:3]
        pose = observation[:, blocks['pose']]
        effector_count, samples = len(self.effectors), len(self._samples)
        return SimpleNamespace(
            facing=None,
            under=None,
            qpos=world.qpos,
            qvel=world.qvel,
            x=world.qpos[:, x, None],
            z=world.qpos[:, z, None],
            pitch=world.qpos[:, pitch, None],
            rates=world.qvel[:, self.pose_dof[2:].min() : self.pose_dof[2:].max() + 1],
            xpos=world.xpos.reshape(n, -1),
            xipos=world.xipos.reshape(n, -1),
            cvel=world.cvel.reshape(n, -1),
            com=world.subtree_com.reshape(n, -1),
            about=(world.subtree_com if self._about == 'com' else world.xpos).reshape(n, -1),
            fall=world.sensordata[:, self._fall],
            height=pose[:, :1],
            position=pose[:, 1:],
            velocity=observation[:, blocks['velocity']],
            terrain=observation[:, blocks.get('terrain', slice(0, 0))],
            sample_x=self._ground_x[:, :samples],
            effector_ground_x=self._ground_x[:, samples:],
            offsets=np.tile(self._samples, (n, 1)),
            effectors=effectors,
            effector_x=effectors[:, :effector_count],
            effector_z=effectors[:, effector_count:],
            com_velocity=com_velocity[:, None],
        )

    def measure(self, v: SimpleNamespace) -> None:
        """Writes terrain, pose and velocity blocks, end effectors and com velocity."""
        # A trunk that points backwards looks backwards. A sum of squares is the cheapest test, but of
        # many rows it says little.
        v.facing = None
        if np.vdot(v.pitch, v.pitch) > _UPRIGHT**2 and np.square(v.pitch).max() > _UPRIGHT**2:
            v.facing = np.where(np.cos(v.pitch) < 0, -1.0, 1.0)
        v.xipos.take(self._xz, 1, v.position, 'clip')
        v.position -= v.qpos.take(self._root_xz, 1)
        # Spatial velocities are about the centre of mass of the whole tree: v + w x r.
        v.cvel.take(self._linear, 1, v.velocity, 'clip')
        turning = v.xipos.take(self._zx, 1)
        turning -= v.com.take(self._com_zx, 1)
        turning *= v.cvel.take(self._spin, 1)
        turning *= self._cross
        v.velocity += turning
        # Row by row, so that a row's sum does not depend on how many rows there are.
        np.matmul(v.velocity[:, None], self._share, out=v.com_velocity)

        samples = len(self._samples) - 1
        v.xpos.take(self._effector_xz, 1, v.effectors, 'clip')
        offsets = v.offsets if v.facing is None else v.offsets * v.facing
        np.add(v.x, offsets, out=v.sample_x)
        v.effector_ground_x[...] = v.effector_x
        ground = self.arena.height(self._ground_x)
        if v.facing is not None:  # ahead is behind, where the boxes do not reach as far
            self.arena.look_far(self._ground_x, ground)
        v.under = ground[:, samples : samples + 1]
        np.subtract(v.z, v.under, v.height)
        if samples:
            np.subtract(ground[:, :samples], v.under, out=v.terrain)
        v.effector_x -= v.about.take(self._com_x, 1)
        v.effector_z -= ground[:, samples + 1 :]

        if v.facing is not None:
            v.position[:, ::2] *= v.facing
            v.velocity[:, ::2] *= v.facing

    def place(
        self, rows: np.ndarray, poses: np.ndarray, rates: np.ndarray, extents: np.ndarray
    ) -> None:
        """Puts the characters of some simulations at x = 0 onto the ground.

        Each is lifted until every link's bounding box is clear of the ground under its middle and
        its ends; never lowered.

        Args:
          rows: which simulations; they are reset.
          poses: x (ignored), z above the ground, pitch and joints in link order, (rows, 3 + J);
            they come back with x and z as placed.
          rates: their velocities, (rows, 3 + J).
          extents: of the collision geoms in these poses, relative to the root, (rows, 3, G); see
            `trl_suite.tasks.reference.link_extents`.
        """
        world = self._world
        centre, half, lowest = extents.swapaxes(0, 1)
        x = np.concatenate([np.zeros((len(rows), 1)), centre - half, centre, centre + half], axis=1)
        ground = self.arena.height(x, rows)
        height = poses[:, 1] + ground[:, 0]
        depth = ground[:, 1:].reshape(len(rows), 3, -1).max(1) - (height[:, None] + lowest)
        height += np.maximum(depth.max(1) + CLEARANCE, 0)
        poses[:, 0], poses[:, 1] = 0.0, height
        world.reset(rows)
        world.qpos[rows[:, None], self.pose_qpos] = poses
        world.qvel[rows[:, None], self.pose_dof] = rates
        world.forward(rows)

    def contacts(self) -> np.ndarray:
        """Returns whether each end effector touches the ground, 0 or 1, (n, E)."""
        return (self._world.sensordata.take(self._contact, 1) > 0).astype(float)

    def feet(self) -> np.ndarray:
        """Returns where the end effectors are in the world, x and z, (n, E, 2) m."""
        return self._world.xpos[:, self.effectors, ::2]

    def ground(self, row: int, x: np.ndarray) -> np.ndarray:
        """Heights of the ground of one simulation at x (k,), m."""
        return self.arena.height(x[None], slice(row, row + 1))[0]
