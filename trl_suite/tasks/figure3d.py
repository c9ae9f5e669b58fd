"""A character in three dimensions as arrays: what every 3D task measures, and how one starts.

The heading frame of a character has its origin on the ground under the root, x along the root's
heading, y to the left and z up.
"""

from __future__ import annotations

import itertools
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np

from trl_suite.arenas import SpatialTerrain
from trl_suite.characters import Character
from trl_suite.engine import World
from trl_suite.kinematics.planar_reference import tabulated
from trl_suite.motion import quaternion
from trl_suite.tasks.task import consecutive
from trl_suite.terrain.surroundings import SAMPLES

CLEARANCE = 0.001  # m; left under every link at the start
_ACROSS, _ACROSS_SIGN = (
    np.array([3, 2, 1, 0]),
    np.array([-1.0, -1.0, 1.0, 1.0]),
)  # z times (w, x, y, z)


class Kinematics:
    """What positions and velocities of a character's links amount to, over a leading batch axis.

    Works on anything that has the fields of a `World`, so that a simulation and the reference that
    it is compared with are measured by the same lines.

    Attributes:
      pose_qpos, pose_dof: addresses of the columns of a pose and of a velocity, as `motion.Layout`
        has them: root, then joints in link order.
      links, effectors: body ids, in link order.
      columns: name -> slice of `features`: `rotations`, quaternions of the root without its heading
        and of the ball joints; `angles` of the hinges, rad; `rates` of the root in the heading
        frame and of all joints, rad/s; `effectors` in the heading frame, in x and y from the middle
        that was asked for, in z above the ground, m; `com_velocity` in world axes, m/s; `height` of
        the root above the ground, m.
    """

    def __init__(self, character: Character, world: World, root: str, about: str) -> None:
        """Resolves ids.

        Args:
          character: a spatial character.
          world: where it was compiled.
          root: full name of its free joint.
          about: from where end effectors are measured: 'com', the centre of mass, or 'root'.
        """
        self.about = about
        names = [root, *(joint.full_identifier for joint in character.joints)]
        qpos, dof = world.joint_addresses(names)
        ball = character.spherical
        sizes, rates = np.where(ball, 4, 1), np.where(ball, 3, 1)
        self.pose_qpos = _addresses(qpos, [7, *sizes])
        self.pose_dof = _addresses(dof, [6, *rates])
        self._balls = _addresses(qpos[1:][ball], sizes[ball])
        self._hinges = qpos[1:][~ball]
        self.joint_dof = self.pose_dof[6:]
        self.links = world.body_ids([body.full_identifier for body in character.bodies])
        self.effectors = world.body_ids([b.full_identifier for b in character.end_effectors])
        mass = world.models[0].body_mass[self.links]
        self._share = np.kron((mass / mass.sum())[:, None], np.eye(3))  # (3 * links, 3)
        self.columns = consecutive({
            'rotations': 4 + len(self._balls), 'angles': len(self._hinges),
            'rates': 3 + len(self.joint_dof), 'effectors': 3 * len(self.effectors),
            'com_velocity': 3, 'height': 1,
        })  # fmt: skip

    def measure(self, world: Any, height: Any, surface: Any = None) -> SimpleNamespace:
        """Measures n characters.

        Args:
          world: anything with the fields of a `World`, n rows.
          height: (x, y), both (n, k) m -> heights of the ground, (n, k) m.
          surface: (x, y) -> velocities of the ground, (n, k, 2) m/s; None if nothing moves.

        Returns:
          A namespace: `root` and `com`, the centre of mass, (n, 3) m; `heading` (n,) rad; `cosine`,
          `sine` of it (n, 1); `under` (n, 1) m, ground under the root; `height` of the root above
          it (n, 1) m; in the heading frame `positions` of link centres from the root (n, links, 3) m, `orientations`
          (n, links, 4) with w not negative, `velocities` of the centres against the ground under
          the root (n, links, 3) m/s, `spins` (n, links, 3) rad/s; `feet`, the end effectors' joints
          in the world (n, E, 3) m; `com_velocity` (n, 3) m/s; and `features`, see `columns`.
        """
        n, links = len(world.qpos), len(self.links)
        body = self.links[0]
        root = world.xpos[:, body]
        quaternions = world.xquat.take(self.links, 1)
        heading = quaternion.heading(quaternions[:, 0])
        cosine, sine = np.cos(heading)[:, None], np.sin(heading)[:, None]
        centres = world.xipos.take(self.links, 1)
        cvel = world.cvel.take(self.links, 1)
        com = world.subtree_com[:, body]
        # Spatial velocities are about the centre of mass of the whole tree: v + w x r.
        spins = cvel[..., :3]
        velocities = cvel[..., 3:] + quaternion.cross(spins, centres - com[:, None])
        # Row by row, so that a row's sum does not depend on how many rows there are.
        com_velocity = np.matmul(velocities.reshape(n, 1, -1), self._share)[:, 0]

        feet = world.xpos.take(self.effectors, 1)
        x = np.concatenate([root[:, :1], feet[..., 0]], axis=1)
        y = np.concatenate([root[:, 1:2], feet[..., 1]], axis=1)
        ground = height(x, y)
        under = ground[:, :1]
        relative = velocities
        if surface is not None:
            relative = velocities.copy()
            relative[..., :2] -= surface(x[:, :1], y[:, :1])
        middle = com if self.about == 'com' else root
        vectors = np.concatenate(
            [centres - root[:, None], relative, spins, feet - middle[:, None]], axis=1
        )
        vectors = turn(vectors, cosine, sine)
        positions, relative, spins, effectors = np.split(vectors, [links, 2 * links, 3 * links], 1)
        effectors[..., 2] = feet[..., 2] - ground[:, 1:]
        half = 0.5 * heading
        orientations = _without_heading(quaternions, np.cos(half), -np.sin(half))
        features = np.concatenate(
            [
                orientations[:, 0], world.qpos.take(self._balls, 1),
                world.qpos.take(self._hinges, 1), spins[:, 0], world.qvel.take(self.joint_dof, 1),
                effectors.reshape(n, -1), com_velocity, root[:, 2:] - under,
            ],
            axis=1,
        )  # fmt: skip
        return SimpleNamespace(
            root=root, com=com, heading=heading, cosine=cosine, sine=sine, under=under,
            height=features[:, -1:], positions=positions,
            orientations=np.where(orientations[..., :1] < 0, -orientations, orientations),
            velocities=relative, spins=spins, feet=feet, com_velocity=com_velocity,
            features=features,
        )  # fmt: skip

    def compare(self, features: np.ndarray, reference: np.ndarray) -> np.ndarray:
        """Returns how far features are from those of a reference.

        Args:
          features: (n, F).
          reference: (n, F), quaternions of about unit length.

        Returns:
          Angles between rotations, the shorter way, rad; then differences of all other columns,
          shape (n, F - 3 * rotations).
        """
        rotations = self.columns['rotations']
        mine, other = (
            part[:, rotations].reshape(len(part), -1, 4) for part in (features, reference)
        )
        cosine = np.abs((mine * other).sum(2)) / np.sqrt((other * other).sum(2))
        angles = 2 * np.arccos(np.minimum(cosine, 1.0))
        rest = slice(rotations.stop, None)
        return np.concatenate([angles, features[:, rest] - reference[:, rest]], axis=1)


class SpatialFigure:
    """One character in every simulation of a world: what it observes and how it is placed."""

    fields: tuple[str, ...] = ('xquat',)  # of MjData, beside those that every world binds

    def __init__(self, character: Character, arena: SpatialTerrain, terrain_map: bool) -> None:
        """Attaches the character; adds contact sensors for its fall links and end effectors.

        Args:
          character: a spatial character; it is attached to the arena and given a free joint.
          arena: where it moves.
          terrain_map: whether it sees the heights around it, 32 x 32 samples.
        """
        self.character, self.arena, self.terrain_map = character, arena, terrain_map
        (self._root,) = character.create_root_joints(arena.attach(character))
        self._sensors = {
            kind: [self._add_sensors(name, kind) for name in names]
            for kind, names in (
                ('fall', character.row.fall_links),
                ('contact', character.row.end_effectors),
            )
        }
        links = len(character.row.links)
        self.blocks = {
            'terrain': SAMPLES**2 if terrain_map else 0,
            'pose': 7 * links + 1,
            'velocity': 6 * links,
        }

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

    def bind(self, world: World, about: str) -> None:
        """Resolves ids in a compiled world; `about` as for `Kinematics`."""
        self._world = world
        self.arena.bind(world)
        self.kinematics = Kinematics(self.character, world, self._root.full_identifier, about)
        self.pose_qpos, self.pose_dof = self.kinematics.pose_qpos, self.kinematics.pose_dof
        kinds = len(self.arena.touched)
        self._fall, self._contact = (
            world.sensor_addresses([*itertools.chain(*names)]).reshape(len(names), kinds)
            for names in self._sensors.values()
        )
        model = world.models[0]
        geoms = world.geom_ids([g.full_identifier for g in self.character.collision_geoms])
        self._bodies = model.geom_bodyid[geoms]
        signs = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3, indexing='ij'), axis=-1).reshape(8, 3)
        boxes = model.geom_aabb[geoms, None]  # middle and half sides, in the geoms' frames
        corners = quaternion.rotate(
            model.geom_quat[geoms, None], boxes[..., :3] + signs * boxes[..., 3:]
        )
        self._corners = model.geom_pos[geoms, None] + corners  # (G, 8, 3), in the links' frames
        self._surface = self.arena.surface_velocity if self.arena.surroundings.moving else None

    def measure(self) -> SimpleNamespace:
        """Measures all characters; see `Kinematics.measure`. Adds the contacts.

        They are `fall` (n, F) and `contact` (n, E): whether links touch the ground.
        """
        found = self.kinematics.measure(self._world, self.arena.height, self._surface)
        sensed = self._world.sensordata
        found.fall = sensed.take(self._fall, 1).max(2)
        found.contact = (sensed.take(self._contact, 1).max(2) > 0).astype(float)
        return found

    def write(
        self, found: SimpleNamespace, observation: np.ndarray, blocks: dict[str, slice]
    ) -> None:
        """Writes the blocks terrain, pose and velocity of a measurement into (n, size)."""
        n = len(observation)
        if self.terrain_map:
            terrain = observation[:, blocks['terrain']]
            self.arena.height_map(found.root[:, :2], found.heading, out=terrain)
        pose = observation[:, blocks['pose']]
        pose[:, :1] = found.height
        links = pose[:, 1:].reshape(n, -1, 7)  # a view
        links[..., :3], links[..., 3:] = found.positions, found.orientations
        links = observation[:, blocks['velocity']].reshape(n, -1, 6)
        links[..., :3], links[..., 3:] = found.velocities, found.spins

    def place(
        self, rows: np.ndarray, poses: np.ndarray, rates: np.ndarray, spawns: np.ndarray
    ) -> None:
        """Puts the characters of some simulations on the ground.

        Each is lifted until the corners of all its boxes are clear of the ground; never lowered.

        Args:
          rows: which simulations; their physics was reset.
          poses: of a free root that stands at the origin, z above the ground, and the joints in link
            order, (rows, columns of a pose).
          rates: their velocities, (rows, columns of a velocity).
          spawns: where the origin is put: x, y in m, and by how much it is turned, rad, (rows, 3).
        """
        world, angle = self._world, spawns[:, 2]
        poses, rates = poses.copy(), rates.copy()
        poses[:, :2] = spawns[:, :2] + quaternion.turned(poses[:, :2], angle)
        poses[:, 3:7] = quaternion.multiply(quaternion.about_z(angle), poses[:, 3:7])
        rates[:, :2] = quaternion.turned(rates[:, :2], angle)
        poses[:, 2] += self.arena.height(poses[:, :1], poses[:, 1:2], rows)[:, 0]
        world.qpos[rows[:, None], self.pose_qpos] = poses
        world.qvel[rows[:, None], self.pose_dof] = rates
        world.forward(rows)
        bodies = (rows[:, None], self._bodies)
        corners = world.xpos[bodies][:, :, None] + quaternion.rotate(
            world.xquat[bodies][:, :, None], self._corners
        )
        x, y, z = corners.reshape(len(rows), -1, 3).transpose(2, 0, 1)
        depth = self.arena.height(x, y, rows) - z
        lift = np.maximum(depth.max(1) + CLEARANCE, 0)
        world.qpos[rows, self.pose_qpos[2]] += lift
        world.forward(rows)


def turn(vectors: np.ndarray, cosine: np.ndarray, sine: np.ndarray) -> np.ndarray:
    """Returns vectors (n, k, 2 or 3) in a frame that is turned about z by an angle, (n, 1)."""
    x, y = vectors[..., 0], vectors[..., 1]
    result = vectors.copy()
    result[..., 0] = cosine * x + sine * y
    result[..., 1] = cosine * y - sine * x
    return result


def stacked(
    model: mujoco.MjModel, kinematics: Kinematics, poses: np.ndarray, rates: np.ndarray
) -> SimpleNamespace:
    """Returns the fields of a `World` for a character in given poses, nothing else simulated.

    Args:
      model: the compiled model.
      kinematics: of the character.
      poses: (n, columns of a pose).
      rates: (n, columns of a velocity).
    """
    names = ('qpos', 'qvel', 'xpos', 'xquat', 'xipos', 'cvel', 'subtree_com')
    everything = dict.fromkeys(names, slice(None))
    pose_qpos, pose_dof = kinematics.pose_qpos, kinematics.pose_dof
    return SimpleNamespace(**tabulated(model, pose_qpos, pose_dof, poses, rates, everything))


def polar(way: np.ndarray, found: SimpleNamespace) -> np.ndarray:
    """Returns bearing (rad to the left) and length of ways (n, 1, 2) in the heading frame, (n, 2)."""
    x, y = turn(way, found.cosine, found.sine)[:, 0].T.copy()
    return np.stack([np.arctan2(y, x), np.sqrt(x * x + y * y)], axis=1)


def _addresses(starts: np.ndarray, sizes: Any) -> np.ndarray:
    """Returns the addresses of blocks of columns, one block after the other."""
    blocks = [start + np.arange(size) for start, size in zip(starts, sizes, strict=True)]
    return np.concatenate(blocks) if blocks else np.zeros(0, int)


def _without_heading(q: np.ndarray, w: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Returns rotations (n, k, 4), then turned about the vertical by (w, 0, 0, z), both (n,)."""
    return w[:, None, None] * q + z[:, None, None] * (q.take(_ACROSS, -1) * _ACROSS_SIGN)
