"""A character without physics, for posing, measuring and rendering on a level floor.

from trl_suite import motion
from trl_suite.rendering import kinematic_viewer

figure = kinematic_viewer.KinematicViewer('raptor')
figure.put(motion.load('raptor_run_050').pose(0.1))
image = figure.picture(camera='side')  # (480, 640, 3) uint8
"""

from __future__ import annotations

import itertools
from typing import Any

import mujoco
import numpy as np
from dm_control import composer

from trl_suite import characters, rendering
from trl_suite.arenas import scene as stage
from trl_suite.motion import Clip, Layout
from trl_suite.motion.layout import ROOT_SIZES

FLOOR = 200.0  # m; half length
SHADOWS = 8.0  # range of shadows, in extents; so large that artefacts at its edge are far away
TILE = 1.0  # m; edge of a square of the floor, as a scale
_SIGNS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))


class KinematicViewer:
    """One character on a level floor at height 0.

    Attributes:
      character: the entity.
      layout: the columns of its poses, as in a `Clip`.
      links: name of the body of each collision geom, in the order of `corners`; bodies with several
        geoms are repeated.
      environment: a `composer.Environment` with a null task, for `rendering`.
    """

    def __init__(self, character: str | characters.CharacterSpec) -> None:
        """Compiles a character.

        Args:
          character: a name in `trl_suite.characters.CHARACTERS`, or a user's own spec.
        """
        arena = composer.Arena()
        root = arena.mjcf_model
        stage.prepare(root)
        root.visual.map.shadowclip = SHADOWS
        root.visual.quality.shadowsize = 4096
        stage.paint(root, 'floor', stage.OLIVE.ground, 0.5 / TILE)
        box = {'type': 'box', 'size': (FLOOR, FLOOR, 1), 'pos': (0, 0, -1)}
        root.worldbody.add('geom', name='floor', material='floor', **box)
        self.character = figure = characters.make(character)
        root_joints = figure.create_root_joints(arena.attach(figure))
        self.environment = composer.Environment(composer.NullTask(arena), random_state=0)
        self.environment.reset()
        physics = self._physics = self.environment.physics
        kind = 'free' if figure.spec.spatial else 'planar'
        self.layout = Layout(
            kind, tuple(figure.spec.joints), np.where(figure.spherical, 4, 1).tolist()
        )
        joints = [*root_joints, *figure.joints]
        starts = np.concatenate([np.atleast_1d(physics.bind(joint).qposadr) for joint in joints])
        sizes = [ROOT_SIZES[kind] // len(root_joints)] * len(root_joints) + list(self.layout.sizes)
        self._pose_qpos = np.concatenate(
            [start + np.arange(size) for start, size in zip(starts, sizes, strict=True)]
        )
        model = physics.model
        geoms = [geom.full_identifier for geom in figure.collision_geoms]
        self._geoms = np.array([model.name2id(name, 'geom') for name in geoms])
        self._joints = np.atleast_1d(physics.bind(figure.joints).element_id)
        root_body = model.name2id(figure.bodies[0].full_identifier, 'body')
        self._bodies = np.array([root_body, *model.jnt_bodyid[self._joints]])
        bodies = (model.id2name(body, 'body') for body in model.geom_bodyid[self._geoms])
        self.links = tuple(name.rpartition('/')[2] for name in bodies)
        box = model.geom_aabb[self._geoms]
        self._local = box[:, None, :3] + _SIGNS * box[:, None, 3:]
        self.put(self.standing())

    def standing(self) -> np.ndarray:
        """Returns the pose with all joints at 0, feet on the floor, (columns,)."""
        pose = np.zeros(self.layout.columns)
        for column, _ in self.layout.rotations:
            pose[column] = 1.0
        height = 1 if self.layout.root == 'planar' else 2
        self.put(pose)
        pose[height] = -self.corners()[..., 2].min()
        return pose

    def put(self, pose: np.ndarray) -> None:
        """Sets the pose, (columns,) as in `layout`."""
        pose = np.asarray(pose, float)
        if pose.shape != (self.layout.columns,):
            raise ValueError(f'pose has shape {pose.shape}; expected ({self.layout.columns},)')
        data = self._physics.data
        data.qpos[self._pose_qpos] = pose
        # Cameras and light that track the character need its centre of mass.
        mujoco.mj_fwdPosition(self._physics.model.ptr, data.ptr)

    def corners(self) -> np.ndarray:
        """Returns the corners of the bounding boxes of all collision geoms, m, (geoms, 8, 3)."""
        data = self._physics.data
        frames = data.geom_xmat[self._geoms].reshape(-1, 3, 3)
        return data.geom_xpos[self._geoms][:, None] + self._local @ frames.transpose(0, 2, 1)

    def places(self) -> np.ndarray:
        """Returns the position of the root and of all joints, m, (1 + joints, 3)."""
        data = self._physics.data
        return np.concatenate([data.xpos[self._bodies[:1]], data.xanchor[self._joints]])

    def bodies(self) -> list[int]:
        """Returns a number of the root's body, and of that which each joint moves."""
        return self._bodies.tolist()

    def orientations(self) -> np.ndarray:
        """Returns the orientations of these bodies, unit quaternions wxyz, (1 + joints, 4)."""
        return self._physics.data.xquat[self._bodies].copy()

    def axes(self) -> list[np.ndarray | None]:
        """Returns the axis of every hinge in the frame of its body, (3,); None for others."""
        joints = self._physics.bind(self.character.joints)
        hinge = int(mujoco.mjtJoint.mjJNT_HINGE)
        return [
            np.array(axis) if kind == hinge else None
            for kind, axis in zip(joints.type, joints.axis, strict=True)
        ]

    def parents(self) -> list[int]:
        """Returns -1 for the root, and for each joint the number of the one before it, 0 for the root.

        It is the last joint before it on the way from the root, which may move the same body.
        """
        above, last = self._physics.model.body_parentid, {self._bodies[0]: 0}
        result = [-1]
        for number, body in enumerate(self.bodies()[1:], 1):
            near = body
            while near not in last:
                near = above[near]
            result.append(last[near])
            last[body] = number
        return result

    def picture(self, **options: Any) -> np.ndarray:
        """Renders the pose, (h, w, 3) uint8; options are those of `trl_suite.rendering.frame`."""
        return rendering.frame(self.environment, **options)

    def film_strip(self, clip: Clip, columns: int = 8, **options: Any) -> np.ndarray:
        """Renders evenly spaced poses of a clip side by side; options are those of `picture`."""
        images = []
        for time in np.linspace(0, clip.duration, columns):
            self.put(clip.pose(time))
            images.append(self.picture(**options))
        return rendering.film_strip(images, columns=columns)
