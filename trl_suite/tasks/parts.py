"""Measurements of a task's character, for reward terms, observation blocks and failures.

Each is a function of a task and returns an array with a leading axis of n simulations, as
`trl_suite.tasks.variation.additions` expects. The task must have a `body`, planar or spatial, as all tasks
of the suite do.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from trl_suite.motion import quaternion


def joint_angles(task: Any) -> np.ndarray:
    """Joint angles in link order, rad (slides m, ball joints quaternions), (n, J or more)."""
    return task.world.qpos.take(task.body.pose_qpos[7 if _spatial(task) else 3 :], 1)


def joint_rates(task: Any) -> np.ndarray:
    """Joint rates in link order, rad/s (slides m/s), (n, J or more)."""
    return task.world.qvel.take(task.body.pose_dof[6 if _spatial(task) else 3 :], 1)


def height(task: Any) -> np.ndarray:
    """Height of the root above the ground under it, m, (n,)."""
    place = root(task)
    if _spatial(task):
        return place[:, 2] - task.arena.height(place[:, :1], place[:, 1:2])[:, 0]
    return place[:, 2] - task.arena.height(place[:, :1])[:, 0]


def speed(task: Any) -> np.ndarray:
    """Speed of the root along its heading, m/s, (n,); in the plane along x."""
    velocity = task.world.qvel.take(task.body.pose_dof[:2], 1)
    if not _spatial(task):
        return velocity[:, 0]
    angle = heading(task)
    return np.cos(angle) * velocity[:, 0] + np.sin(angle) * velocity[:, 1]


def heading(task: Any) -> np.ndarray:
    """Heading of the root, rad to the left of +x, (n,); 0 in the plane."""
    if not _spatial(task):
        return np.zeros(task.world.n)
    return quaternion.heading(task.world.qpos.take(task.body.pose_qpos[3:7], 1))


def upright(task: Any) -> np.ndarray:
    """Cosine of the angle between the root's z axis and the vertical, (n,)."""
    if not _spatial(task):
        return np.cos(task.world.qpos[:, task.body.pose_qpos[2]])
    x, y = task.world.qpos.take(task.body.pose_qpos[4:6], 1).T
    return 1 - 2 * (x * x + y * y)


def effort(task: Any) -> np.ndarray:
    """Mean square of the last action, in [0, 1], (n,); for the functions of `Additions`."""
    return np.add.reduce(task.action**2, axis=1) / task.action.shape[1]


def root(task: Any) -> np.ndarray:
    """Position of the root, m, (n, 3)."""
    return task.world.xpos[:, task.body.links[0]].copy()


def _spatial(task: Any) -> bool:
    return task.character.spec.spatial
