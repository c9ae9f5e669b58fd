"""A planar character on planar ground as arrays: what every planar task measures and resets."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from trl_suite.arenas import PlanarTerrain
from trl_suite.characters import Character
from trl_suite.world import World

CLEARANCE = 0.001  # m; left under every link at the start
_UPRIGHT = np.pi / 2  # rad; beyond it a trunk may point backwards


class PlanarFigure:
    """Kinematics of one character in every simulation of a world, over a leading batch axis.

    Within the loop, bodies and joints stand in the engine's order, so that all of a character is
    one slice of every array; only the observation is put into link order.

    Attributes:
      pose_qpos, pose_dof: addresses of x, z, pitch and the joints in link order.
      links, effectors: body ids, in link order.
    """

    def __init__(
        self, character: Character, arena: PlanarTerrain, behind: float, ahead: float, samples: int
    ) -> None:
        """Attaches the character and adds a contact sensor for each of its fall links.

        Args:
          character: a planar character; it is attached to the arena and given root joints.
          arena: where it moves.
          behind: where the line of observed ground heights begins, m behind the root.
          ahead: where it ends, m ahead of the root.
          samples: number of heights on that line; 0 is blind.
        """
        self.character, self.arena = character, arena
        character.create_root_joints(arena.attach(character))
        # The last sample is the ground under the root, from which all heights are measured.
        self._samples = np.append(np.linspace(-behind, ahead, samples), 0.0)
        self._fall_sensors = [
            f'{character.mjcf_model.model}_{n}_fall' for n in character.row.fall_links
        ]
        for name, link in zip(self._fall_sensors, character.row.fall_links, strict=True):
            arena.mjcf_model.sensor.add(
                'contact', name=name, body1=character.mjcf_model.find('body', link),
                body2=arena.ground_body, num=1, data='found',
            )  # fmt: skip
        links = len(character.row.links)
        self.blocks = {'terrain': samples, 'pose': 2 * links + 1, 'velocity': 2 * links}

    def bind(self, world: World) -> None:
        """Resolves ids in a compiled world and allocates scratch of `world.n` rows."""
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
        self._geoms = world.geom_ids([g.full_identifier for g in character.collision_geoms])
        # Columns of end effectors in the flat xpos: all x, then all z.
        self._effector_xz = np.concatenate([3 * self.effectors, 3 * self.effectors + 2])
        self._fall = _span(world.sensor_addresses(self._fall_sensors))
        self._bodies = _span(self.links)
        order = self.links - self._bodies.start
        self._link_order = None if (order == np.arange(len(order))).all() else order
        mass = world.models[0].body_mass[self._bodies]
        self._share = (mass / mass.sum())[None]
        # One ground query serves samples, root and end effectors.
        self._ground_x = np.zeros((world.n, len(self._samples) + len(self.effectors)))

    def views(
        self,
        rows: slice,
        observation: np.ndarray,
        blocks: dict[str, slice],
        effectors: np.ndarray,
        com_velocity: np.ndarray,
    ) -> SimpleNamespace:
        """The parts of all arrays that a measurement of some rows reads and writes.

        Args:
          rows: which simulations.
          observation: of all simulations, (n, size); terrain, pose and velocity are written there.
          blocks: where they lie.
          effectors: where end effectors are written, (rows, 2 * E): all x ahead of the centre of
            mass, then all z above the ground, m.
          com_velocity: where the velocity of the centre of mass is written, (rows, 2), m/s.

        Returns:
          A namespace for `measure`. Of use to tasks: `x`, `z` (rows, 1), `pitch` (rows,), `angles`
          and `rates` (rows, 1 + J) of pitch and joints in the engine's order, `height` (rows, 1) of
          the root above the ground, `fall` (rows, F) contact counts, and after `measure` `facing`.
        """
        world, bodies = self._world, self._bodies
        x, z, pitch = self.pose_qpos[:3]
        out = observation[rows]
        pose = out[:, blocks['pose']]
        shape = (len(out), bodies.stop - bodies.start, 2)
        position, velocity = pose[:, 1:].reshape(shape), out[:, blocks['velocity']].reshape(shape)
        # Computed in the engine's order; out of place where the link order differs.
        position_out, velocity_out = position, velocity
        if self._link_order is not None:
            position, velocity = np.empty(shape), np.empty(shape)
        ground_x = self._ground_x[rows]
        count = len(self.effectors)
        return SimpleNamespace(
            rows=rows,
            facing=None,
            root=world.qpos[rows, None, x : z + 1],
            x=world.qpos[rows, x, None],
            z=world.qpos[rows, z, None],
            pitch=world.qpos[rows, pitch],
            angles=world.qpos[rows, _span(self.pose_qpos[2:])],
            rates=world.qvel[rows, _span(self.pose_dof[2:])],
            xpos=world.xpos[rows].reshape(len(out), -1),
            xipos=world.xipos[rows, bodies, ::2],
            spin=world.cvel[rows, bodies, 1:2],
            linear_x=world.cvel[rows, bodies, 3],
            linear_z=world.cvel[rows, bodies, 5],
            com=world.subtree_com[rows, bodies.start, None, ::2],
            com_x=world.subtree_com[rows, bodies.start, :1],
            fall=world.sensordata[rows, self._fall],
            height=pose[:, :1],
            terrain=out[:, blocks.get('terrain', slice(0, 0))],
            position=position,
            velocity=velocity,
            velocity_x=velocity[:, :, 0],
            velocity_z=velocity[:, :, 1],
            position_out=position_out,
            velocity_out=velocity_out,
            ground_x=ground_x,
            sample_x=ground_x[:, : len(self._samples)],
            effector_ground_x=ground_x[:, len(self._samples) :],
            effectors=effectors,
            effector_x=effectors[:, :count],
            effector_z=effectors[:, count:],
            com_velocity=com_velocity[:, None],
        )

    def measure(self, v: SimpleNamespace) -> None:
        """Writes terrain, pose and velocity blocks, end effectors and com velocity of some rows."""
        # A trunk that points backwards looks backwards. A sum of squares is the cheapest test.
        v.facing = None
        if np.vdot(v.pitch, v.pitch) > _UPRIGHT**2:
            v.facing = np.where(np.cos(v.pitch) < 0, -1.0, 1.0)[:, None]
        np.subtract(v.xipos, v.root, out=v.position)
        # Spatial velocities are about the centre of mass of the whole tree: v + w x r.
        turning = v.xipos - v.com
        turning *= v.spin
        np.add(v.linear_x, turning[:, :, 1], out=v.velocity_x)
        np.subtract(v.linear_z, turning[:, :, 0], out=v.velocity_z)
        np.matmul(self._share, v.velocity, out=v.com_velocity)

        samples = len(self._samples) - 1
        v.xpos.take(self._effector_xz, axis=1, out=v.effectors, mode='clip')
        np.add(v.x, self._samples if v.facing is None else v.facing * self._samples, out=v.sample_x)
        v.effector_ground_x[...] = v.effector_x
        ground = self.arena.height(v.ground_x, v.rows)
        under_root = ground[:, samples, None]
        np.subtract(v.z, under_root, out=v.height)
        if samples:
            np.subtract(ground[:, :samples], under_root, out=v.terrain)
        v.effector_x -= v.com_x
        v.effector_z -= ground[:, samples + 1 :]

        if v.facing is not None:
            v.position[:, :, 0] *= v.facing
            v.velocity_x *= v.facing
        if self._link_order is not None:
            v.position_out[...] = v.position[:, self._link_order]
            v.velocity_out[...] = v.velocity[:, self._link_order]

    def place(self, row: int, pose: np.ndarray, rate: np.ndarray) -> None:
        """Puts the character of one simulation at x = 0 onto the ground.

        Args:
          row: which simulation; it is reset.
          pose: x (ignored), z above the ground, pitch and joints in link order, (3 + J,).
          rate: their velocities, (3 + J,).
        """
        world = self._world
        world.reset(row)
        world.qpos[row, self.pose_qpos] = pose
        world.qpos[row, self.pose_qpos[0]] = 0.0
        world.qpos[row, self.pose_qpos[1]] += self.ground(row, np.zeros(1))[0]
        world.qvel[row, self.pose_dof] = rate
        world.forward(row)
        lift = self._penetration(row) + CLEARANCE
        if lift > 0:
            world.qpos[row, self.pose_qpos[1]] += lift
            world.forward(row)

    def ground(self, row: int, x: np.ndarray) -> np.ndarray:
        """Heights of the ground of one simulation at x (k,), m."""
        return self.arena.height(x[None], slice(row, row + 1))[0]

    def _penetration(self, row: int) -> float:
        """How deep the lowest of the links' bounding boxes reaches below the ground, m."""
        centre = self._world.geom_xpos[row, self._geoms]
        matrix = self._world.geom_xmat[row, self._geoms].reshape(-1, 3, 3)
        extent = (np.abs(matrix) * self._world.models[row].geom_size[self._geoms, None]).sum(2)
        x = centre[:, 0] + extent[:, 0] * np.array([[-1], [0], [1]])
        ground = self.ground(row, x.ravel()).reshape(x.shape)
        return float(np.max(ground - (centre[:, 2] - extent[:, 2])))


def _span(ids: np.ndarray) -> slice:
    """The slice that ids which are neighbours, in whatever order, lie in."""
    first, last = int(ids.min()), int(ids.max())
    assert last - first + 1 == len(ids), ids
    return slice(first, last + 1)
