"""Overlays of rendered images: reference pose, markers of the task, observed terrain.

An overlay is a function (physics, scene) that appends geoms to a `mujoco.MjvScene`, as the
`scene_callback` of `dm_control.mujoco.Physics.render` does.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from trl_suite.motion import quaternion
from trl_suite.tasks.task import Marker, Task
from trl_suite.terrain.spatial.windows import FORWARD, RIGHT

Overlay = Callable[[Any, Any], None]

GHOST_COLOUR = (1.0, 0.85, 0.35, 0.45)  # red, green, blue, opacity
GHOST_BEHIND = 0.7  # m; distance of the ghost behind the character, as seen by the camera


def of_task(task: Any, with_ghost: bool = False) -> list[Overlay]:
    """Returns the overlays of a task: its markers, and optionally the reference pose."""
    drawn = [ghost(task)] if with_ghost else []
    return [*drawn, markers(task)] if isinstance(task, Task) else drawn


def ghost(task: Any) -> Overlay:
    """Returns an overlay of the reference pose, translucent and behind the character."""
    if not has_ghost(task):
        raise ValueError(f'the task {type(task).__name__} has no reference clip to show as a ghost')

    def add(physics: Any, scene: Any) -> None:
        # Uses a separate MjData of the same model, so that the simulation does not change.
        model, data = physics.model.ptr, mujoco.MjData(physics.model.ptr)
        addresses = task.body.pose_qpos
        data.qpos[addresses] = task.reference_pose(0)
        mujoco.mj_kinematics(model, data)
        before = scene.ngeom
        options = mujoco.MjvOption(), mujoco.MjvPerturb(), mujoco.mjtCatBit.mjCAT_DYNAMIC
        mujoco.mjv_addGeoms(model, data, *options, scene)
        root = model.jnt_bodyid[root_joint(model, task)]
        for geom in scene.geoms[before : scene.ngeom]:
            # Moving boxes have no ghosts.
            own = model.body_rootid[model.geom_bodyid[geom.objid]] == model.body_rootid[root]
            geom.pos[1] += GHOST_BEHIND
            geom.rgba = GHOST_COLOUR if own else np.zeros(4)
            geom.matid = -1

    return add


def root_joint(model: Any, task: Any) -> int:
    """Returns the id of the first root joint of a task's character."""
    return int(np.flatnonzero(model.jnt_qposadr == task.body.pose_qpos[0])[0])


def has_ghost(task: Any) -> bool:
    """Whether a task has a reference pose."""
    return getattr(task, 'reference_pose', None) is not None


def markers(task: Any) -> Overlay:
    """Returns an overlay of the markers of a task: footstep plans, goals, paths, pushes."""

    def add(physics: Any, scene: Any) -> None:
        for part in (task, *task.components):
            for marker in part.markers(0):
                append(scene, marker)

    return add


def observes_terrain(task: Any) -> bool:
    """Whether the agent observes heights of the terrain."""
    return 'terrain' in getattr(task, 'blocks', {}) and hasattr(task, 'body')


def terrain_samples(task: Any, physics: Any) -> np.ndarray:
    """Returns where the terrain is observed, on its surface, (samples, 3) m."""
    if not task.arena.terrain.spatial:
        body = task.body.ids
        x, _, pitch = physics.data.qpos[body.qpos[:3]]
        facing = -1.0 if abs(pitch) > np.pi / 2 and np.cos(pitch) < 0 else 1.0
        places = x + body.samples * facing
        heights = task.arena.height(places[None], slice(0, 1))[0]
        return np.stack([places, np.zeros_like(places), heights], axis=1)
    root = task.body.links[0]
    (x, y, _), heading = physics.data.xpos[root], quaternion.heading(physics.data.xquat[root])
    aside, ahead = np.meshgrid(-RIGHT, FORWARD, indexing='ij')
    cosine, sine = np.cos(heading), np.sin(heading)
    x = x + cosine * ahead.ravel() - sine * aside.ravel()
    y = y + sine * ahead.ravel() + cosine * aside.ravel()
    heights = task.arena.height(x[None], y[None], np.array([0]))[0]
    return np.stack([x, y, heights], axis=1)


def append(scene: Any, marker: Marker) -> None:
    """Appends a marker to a scene, unless the scene is full."""
    if scene.ngeom == scene.maxgeom:
        return
    scene.ngeom += 1
    geom = scene.geoms[scene.ngeom - 1]
    cosine, sine = np.cos(marker.yaw), np.sin(marker.yaw)
    if marker.shape == 'arrow':  # MuJoCo's arrows point along their z axis
        axes = np.array([[0, -sine, cosine], [0, cosine, sine], [-1, 0, 0]])
    else:
        axes = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
    mujoco.mjv_initGeom(
        geom,
        getattr(mujoco.mjtGeom, f'mjGEOM_{marker.shape.upper()}'),
        np.array(marker.size, float),
        np.array(marker.position, float),
        axes.ravel(),
        np.array(marker.colour, np.float32),
    )
    # Attributes that mjv_initGeom does not initialise.
    geom.category, geom.objtype = mujoco.mjtCatBit.mjCAT_DECOR, mujoco.mjtObj.mjOBJ_UNKNOWN
    geom.objid = geom.dataid = geom.matid = geom.segid = -1
