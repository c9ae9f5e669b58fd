"""A 3D figure read from xml/: rotations, kinematics of the tree, and inverse kinematics.

Rotations are matrices, arrays (..., 3, 3). A ball joint's angles are pitch about (0, -1, 0), yaw
about z and roll about x, in rad, with R = P(pitch) Y(yaw) X(roll); pelvis and torso are prescribed
as Y(heading) P(pitch) X(roll).
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping

import mujoco
import numpy as np
from figure import add_ground

from trl_suite import motion
from trl_suite.motion import quaternion
from trl_suite.util import resources

LEGS = {
    'torso': 4,
    **{
        f'{side}_{joint}': size
        for side in ('right', 'left')
        for joint, size in (('hip', 4), ('knee', 1), ('ankle', 4))
    },
}
ARMS = {
    **{
        f'{side}_{joint}': size
        for side in ('right', 'left')
        for joint, size in (('shoulder', 4), ('elbow', 1), ('wrist', 4))
    },
    'neck': 4,
    'head': 1,
}
JOINTS: Mapping[str, Mapping[str, int]] = {  # name -> columns, in link order
    'biped3d': LEGS,
    'biped3d_mocap': LEGS,
    'biped3d_mocap_run': LEGS,
    'biped3d_full_mocap': LEGS | ARMS,
}
# Limits of pitch, yaw and roll by the last part of the joint's name, rad. The files of xml/ contain
# only the cone of a ball joint that includes them.
LIMITS: Mapping[str, tuple[float, float, float]] = {
    'torso': (1.0, 1.0, 0.5),
    'hip': (2.57, 1.0, 1.2),
    'ankle': (1.57, 1.0, 1.0),
    'shoulder': (0.01, 0.01, 0.01),
    'wrist': (0.01, 0.01, 0.01),
    'neck': (0.01, 0.01, 0.01),
}
FOOT = (0.1403, -0.0367, 0.0474)  # toe corner ahead, heel corner ahead, ankle above the sole, m
SOFT = (0.99, 0.9996)  # reach, shares of the leg: where the knee starts to resist, never exceeded


def pitch(angle: np.ndarray) -> np.ndarray:
    """Returns rotations about (0, -1, 0): positive lifts the front."""
    c, s, o = np.cos(angle), np.sin(angle), np.zeros_like(angle)
    return _matrix((c, o, -s), (o, o + 1, o), (s, o, c))


def yaw(angle: np.ndarray) -> np.ndarray:
    """Returns rotations about z: positive turns left."""
    c, s, o = np.cos(angle), np.sin(angle), np.zeros_like(angle)
    return _matrix((c, -s, o), (s, c, o), (o, o, o + 1))


def roll(angle: np.ndarray) -> np.ndarray:
    """Returns rotations about x: positive drops the right side."""
    c, s, o = np.cos(angle), np.sin(angle), np.zeros_like(angle)
    return _matrix((o + 1, o, o), (o, c, -s), (o, s, c))


def _matrix(*rows: tuple[np.ndarray, np.ndarray, np.ndarray]) -> np.ndarray:
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def apply(rotation: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Returns rotated vectors; broadcasts (..., 3, 3) and (..., 3)."""
    return np.einsum('...ij,...j->...i', rotation, vector)


def between(parent: np.ndarray, child: np.ndarray) -> np.ndarray:
    """Returns the rotation of a child in the frame of its parent, (..., 3, 3)."""
    return np.swapaxes(parent, -1, -2) @ child


def angles(rotation: np.ndarray) -> np.ndarray:
    """Returns pitch, yaw and roll of P Y X, rad, (..., 3)."""
    r = rotation
    return np.stack(
        [
            np.arctan2(r[..., 2, 0], r[..., 0, 0]),
            np.arcsin(np.clip(r[..., 1, 0], -1, 1)),
            np.arctan2(-r[..., 1, 2], r[..., 1, 1]),
        ],
        axis=-1,
    )


def quaternions(rotation: np.ndarray) -> np.ndarray:
    """Returns unit quaternions wxyz with w >= 0, (..., 4)."""
    flat = rotation.reshape(-1, 9)
    found = np.empty((len(flat), 4))
    for q, r in zip(found, flat, strict=True):
        mujoco.mju_mat2Quat(q, r)
    found *= np.where(found[:, :1] < 0, -1, 1)
    found /= np.linalg.norm(found, axis=1, keepdims=True)
    return found.reshape(*rotation.shape[:-2], 4)


def matrices(turns: np.ndarray) -> np.ndarray:
    """Returns rotations from quaternions wxyz, (..., 3, 3)."""
    flat = turns.reshape(-1, 4)
    found = np.empty((len(flat), 9))
    for r, q in zip(found, flat, strict=True):
        mujoco.mju_quat2Mat(r, q)
    return found.reshape(*turns.shape[:-1], 3, 3)


def model(name: str, ground: bool = False) -> mujoco.MjModel:
    """Compiles a character of xml/ with a free root joint, and a ground plane if asked."""
    spec = mujoco.MjSpec.from_file(str(resources.directory('xml') / f'{name}.xml'))
    spec.body('root').add_freejoint(name='root')
    if ground:
        add_ground(spec)
    return spec.compile()


@dataclasses.dataclass(frozen=True)
class Figure:
    """The tree of a character; one row per link, root first, link order.

    Attributes:
      name: of its file in xml/.
      layout: of its poses.
      parent: index of the parent link, -1 for the root.
      offset: joint in the parent's frame, m, (links, 3).
      com: centre of mass in the link's frame, m, (links, 3).
      mass: kg.
    """

    name: str
    layout: motion.Layout
    parent: tuple[int, ...]
    offset: np.ndarray
    com: np.ndarray
    mass: np.ndarray

    def joint(self, name: str) -> np.ndarray:
        """Returns where a joint is in its parent's frame, m, (3,)."""
        return self.offset[1 + self.layout.joints.index(name)]

    @property
    def leg(self) -> tuple[float, float]:
        """Lengths of thigh and shank, m."""
        thigh, shank = (np.linalg.norm(self.joint(f'right_{name}')) for name in ('knee', 'ankle'))
        return float(thigh), float(shank)

    def forward(self, bodies: Bodies) -> tuple[np.ndarray, np.ndarray]:
        """Returns positions (n, links, 3) and rotations (n, links, 3, 3) of all links."""
        n = len(bodies.root)
        position = np.empty((n, len(self.parent), 3))
        rotation = np.empty((n, len(self.parent), 3, 3))
        for i, p in enumerate(self.parent):
            if p < 0:
                position[:, i], rotation[:, i] = bodies.root, bodies.pelvis
                continue
            position[:, i] = position[:, p] + apply(rotation[:, p], self.offset[i])
            turn = bodies.joints.get(self.layout.joints[i - 1])
            if turn is None:
                rotation[:, i] = rotation[:, p]
            else:
                rotation[:, i] = rotation[:, p] @ (pitch(turn) if turn.ndim == 1 else turn)
        return position, rotation

    def centre(self, bodies: Bodies) -> np.ndarray:
        """Returns the centre of mass of the whole figure, (n, 3)."""
        position, rotation = self.forward(bodies)
        com = position + apply(rotation, self.com)
        return np.einsum('l,nlk->nk', self.mass, com) / self.mass.sum()

    def poses(self, bodies: Bodies) -> np.ndarray:
        """Returns the poses, (n, columns); joints that are not given stand at zero."""
        columns = [bodies.root, quaternions(bodies.pelvis)]
        for name, size in zip(self.layout.joints, self.layout.sizes, strict=True):
            turn = bodies.joints.get(name)
            if turn is None:
                turn = np.zeros(len(bodies.root)) if size == 1 else np.eye(3)
            if size == 1:
                columns.append(turn[:, None])
            else:
                columns.append(quaternions(np.broadcast_to(turn, (len(bodies.root), 3, 3))))
        return np.concatenate(columns, axis=1)


@dataclasses.dataclass(frozen=True)
class Bodies:
    """Results of the generators: arrays over n samples.

    Attributes:
      root: position, m, (n, 3).
      pelvis: its rotation, (n, 3, 3).
      joints: rotations (n, 3, 3) in the parent's frame, and angles (n,) rad of hinges; others 0.
      reach: required reach of right and left leg, as a share of their length, (n, 2).
    """

    root: np.ndarray
    pelvis: np.ndarray
    joints: Mapping[str, np.ndarray]
    reach: np.ndarray


@functools.cache
def figure(name: str) -> Figure:
    """Reads a figure from xml/."""
    m = model(name)
    layout = motion.Layout('free', tuple(JOINTS[name]), tuple(JOINTS[name].values()))
    body = [m.body(link).id for link in ('root', *layout.joints)]
    return Figure(
        name=name,
        layout=layout,
        parent=tuple(body.index(m.body_parentid[b]) if b != body[0] else -1 for b in body),
        offset=m.body_pos[body],
        com=m.body_ipos[body],
        mass=m.body_mass[body],
    )


def smooth(u: np.ndarray) -> np.ndarray:
    """Returns the smoothest curve from 0 to 1 that starts and ends at rest."""
    return u**3 * (10 - 15 * u + 6 * u**2)


def rolled(angle: np.ndarray, corner: float) -> np.ndarray:
    """Returns the ankle's path (forward, up) as the foot pitches about a corner of its sole, m."""
    height = FOOT[2]
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack(
        [corner - cos * corner - sin * height, cos * height - sin * corner - height], -1
    )


def soft_reach(wanted: np.ndarray) -> np.ndarray:
    """Returns the reach of a leg, as a share of its length, for a required reach."""
    soft, end = SOFT
    bent = soft + (end - soft) * np.tanh((wanted - soft) / (end - soft))
    return np.where(wanted > soft, bent, wanted)


def leg(
    lengths: tuple[float, float], hip: np.ndarray, ankle: np.ndarray, hinge: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Solves a leg of two segments for its ankle.

    The leg never stretches fully, so the ankle does not reach a position that is too far away.

    Args:
      lengths: of thigh and shank, m.
      hip: joint position, m, (n, 3).
      ankle: joint position, m, (n, 3).
      hinge: horizontal direction of the knee's axis, as the yaw of its bending direction, rad,
        (n,).

    Returns:
      The thigh's rotation in the world (n, 3, 3), the knee's angle, rad (n,), and the reach the leg
      is asked for as a share of its length (n,).
    """
    thigh, shank = lengths
    way = hip - ankle
    distance = np.linalg.norm(way, axis=-1)
    wanted = distance / (thigh + shank)
    d = soft_reach(wanted) * (thigh + shank)
    d = np.maximum(d, 1.02 * abs(thigh - shank))  # a fit may ask for a leg folded on itself
    knee = np.arccos(np.clip((thigh**2 + shank**2 - d**2) / (2 * thigh * shank), -1, 1)) - np.pi
    above = np.arccos(np.clip((thigh**2 + d**2 - shank**2) / (2 * thigh * d), -1, 1))
    up = way / distance[..., None]
    axis = np.stack([-np.sin(hinge), np.cos(hinge), np.zeros_like(hinge)], axis=-1)
    axis = axis - np.sum(axis * up, axis=-1, keepdims=True) * up
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    frame = np.stack([np.cross(axis, up), axis, up], axis=-1)
    return frame @ pitch(above), knee, wanted


def features(made: Figure, bodies: Bodies, turn: float) -> np.ndarray:
    """Returns the features of a step at its start, with its own landing as the plan, (7,)."""
    position, _ = made.forward(bodies)
    right, left = (
        position[:, 1 + made.layout.joints.index(f'{side}_ankle'), :2] for side in ('right', 'left')
    )
    heading = quaternion.heading(quaternions(bodies.pelvis[:1]))
    return motion.step_features(
        bodies.root[:1, :2],
        heading,
        right[:1],
        left[:1],
        left[-1:],
        np.array([turn]),
        np.array([True]),
    )[0]
