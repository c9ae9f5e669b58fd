"""A planar figure read from xml/: its tree, masses and boxes, for NumPy kinematics and for MuJoCo.

Poses are those of a planar `Clip`: x, z, pitch of the root, then one angle per link in link order.
"""

from __future__ import annotations

import dataclasses
import functools

import mujoco
import numpy as np

from trl_suite.util import resources


def model(name: str, ground: bool = False) -> mujoco.MjModel:
    """Compiles a character of xml/ with planar root joints, and a ground plane if asked."""
    spec = mujoco.MjSpec.from_file(str(resources.directory('xml') / f'{name}.xml'))
    root = spec.body('root')
    hinge = mujoco.mjtJoint.mjJNT_HINGE
    slide = mujoco.mjtJoint.mjJNT_SLIDE
    for joint, kind, axis in (
        ('root_x', slide, (1, 0, 0)),
        ('root_z', slide, (0, 0, 1)),
        ('root_pitch', hinge, (0, -1, 0)),
    ):
        # The character's default class limits its joints; the root has no limits.
        root.add_joint(name=joint, type=kind, axis=axis, limited=mujoco.mjtLimited.mjLIMITED_FALSE)
    if ground:
        add_ground(spec)
    return spec.compile()


def add_ground(spec: mujoco.MjSpec) -> None:
    """Adds a plane with the friction of the suite's ground."""
    spec.worldbody.add_geom(
        name='ground', type=mujoco.mjtGeom.mjGEOM_PLANE, size=(0, 0, 1),
        friction=(0.81, 0.005, 0.0001), rgba=(0.85, 0.85, 0.82, 1), group=0,
    )  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Figure:
    """The tree of a planar character; arrays have one row per link, root first, link order.

    Attributes:
      links: names, root first.
      parent: index of the parent link, -1 for the root.
      offset: joint in the parent's frame, m, (links, 2).
      com: centre of mass in the link's frame, m, (links, 2).
      mass: kg.
      inertia: about the lateral axis through the centre of mass, kg m2.
    """

    links: tuple[str, ...]
    parent: tuple[int, ...]
    offset: np.ndarray
    com: np.ndarray
    mass: np.ndarray
    inertia: np.ndarray

    def length(self, link: str) -> float:
        """Returns the distance of a link's joint from its parent's, m."""
        return float(np.linalg.norm(self.offset[self.links.index(link)]))

    def joints(self, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns joint positions (n, links, 2) and pitch angles (n, links) of all links."""
        pitch = np.empty((len(poses), len(self.links)))
        joint = np.empty((*pitch.shape, 2))
        for i, p in enumerate(self.parent):
            if p < 0:
                pitch[:, i], joint[:, i] = poses[:, 2], poses[:, :2]
            else:
                pitch[:, i] = pitch[:, p] + poses[:, 2 + i]
                joint[:, i] = joint[:, p] + rotate(self.offset[i], pitch[:, p])
        return joint, pitch

    def forward(self, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns centres of mass (n, links, 2) and pitch angles (n, links) of all links."""
        joint, pitch = self.joints(poses)
        return joint + rotate(self.com, pitch), pitch

    def centre(self, poses: np.ndarray) -> np.ndarray:
        """Returns the centre of mass of the whole figure, (n, 2)."""
        com, _ = self.forward(poses)
        return np.einsum('l,nlk->nk', self.mass, com) / self.mass.sum()


def rotate(vector: np.ndarray, pitch: np.ndarray) -> np.ndarray:
    """Turns (forward, up) vectors by a pitch, positive lifting the front; broadcasts."""
    x, z = np.asarray(vector)[..., 0], np.asarray(vector)[..., 1]
    cos, sin = np.cos(pitch), np.sin(pitch)
    return np.stack([cos * x - sin * z, sin * x + cos * z], axis=-1)


@functools.cache
def figure(name: str, joints: tuple[str, ...]) -> Figure:
    """Reads a figure from xml/, with its links in the order of `joints`."""
    m = model(name)
    links = ('root', *joints)
    body = [m.body(link).id for link in links]
    frame = np.zeros((len(body), 9))
    inertia = np.empty(len(body))
    for i, b in enumerate(body):
        mujoco.mju_quat2Mat(frame[i], m.body_iquat[b])
        inertia[i] = frame[i].reshape(3, 3)[1] ** 2 @ m.body_inertia[b]
    return Figure(
        links=links,
        parent=tuple(body.index(m.body_parentid[b]) if b != body[0] else -1 for b in body),
        offset=m.body_pos[body][:, [0, 2]],
        com=m.body_ipos[body][:, [0, 2]],
        mass=m.body_mass[body],
        inertia=inertia,
    )
