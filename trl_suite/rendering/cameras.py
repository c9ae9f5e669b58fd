"""Keeps cameras that follow a character out of the terrain and of obstacles."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np

FOLLOWING = (int(mujoco.mjtCamLight.mjCAMLIGHT_TRACK), int(mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM))
HIDING = 1.5  # m; an obstacle that is so close to a camera, and before it, fills the picture
MARGIN = 0.15  # m; between a camera and the surface that it would be behind
NEAREST = 0.6  # m; a camera is not moved closer to the centre of mass than this
WIDEST = 100.0  # degrees; vertical field of view of a camera that was moved
_STEP = 1e-4  # m; a ray continues this far behind a surface
_MOST_HITS = 200  # surfaces along a ray


@contextlib.contextmanager
def outside_obstacles(physics: Any, camera_id: int) -> Iterator[None]:
    """Moves a camera inside or closely behind an obstacle to the character, until the context ends.

    Only cameras that follow a body are moved. They keep their orientation, and their field of view
    grows so that the character keeps its size in the picture. The simulation is not affected.
    """
    model, data = physics.model.ptr, physics.data.ptr
    if camera_id < 0 or model.cam_mode[camera_id] not in FOLLOWING:
        yield
        return
    place, angle = data.cam_xpos[camera_id].copy(), model.cam_fovy[camera_id]
    body = model.cam_bodyid[camera_id]
    data.cam_xpos[camera_id] = free_place(model, data, body, place)
    centre = data.subtree_com[model.body_rootid[body]]
    before, after = (np.linalg.norm(eye - centre) for eye in (place, data.cam_xpos[camera_id]))
    if before > after:
        wide = 2 * np.rad2deg(np.arctan(np.tan(np.deg2rad(angle) / 2) * before / after))
        model.cam_fovy[camera_id] = min(wide, max(angle, WIDEST))
    try:
        yield
    finally:
        data.cam_xpos[camera_id], model.cam_fovy[camera_id] = place, angle


def free_place(
    model: mujoco.MjModel, data: mujoco.MjData, body: int, place: np.ndarray
) -> np.ndarray:
    """Returns the place closest to a camera, on the line to a body, from which the body is visible.

    Geoms of other bodies hide it if the camera is inside them, or less than `HIDING` behind them.
    Without any, the place of the camera, (3,) m, is returned.
    """
    centre = data.subtree_com[model.body_rootid[body]].copy()
    hits = _hits(model, data, body, centre, place)
    length = float(np.linalg.norm(place - centre))
    # A line from outside to a place in a convex geom crosses its surface once, otherwise twice.
    crossed = [geom for geom, _ in hits]
    hiding = {
        geom for geom, distance in hits if crossed.count(geom) % 2 or length - distance < HIDING
    }
    if not hiding:
        return place
    nearest = min(distance for geom, distance in hits if geom in hiding) - MARGIN
    return centre + (place - centre) * max(nearest, NEAREST) / length


def _hits(
    model: mujoco.MjModel, data: mujoco.MjData, body: int, start: np.ndarray, end: np.ndarray
) -> list[tuple[int, float]]:
    """Returns geoms of other bodies whose surface a line crosses, and distances from its start, m."""
    length = float(np.linalg.norm(end - start))
    if length == 0:
        return []
    ahead, gone = (end - start) / length, 0.0
    found: list[tuple[int, float]] = []
    geom = np.full(1, -1, np.int32)
    for _ in range(_MOST_HITS):
        away = mujoco.mj_ray(model, data, start + gone * ahead, ahead, None, 1, -1, geom)
        if away < 0 or gone + away > length:
            break
        gone += away
        if model.body_rootid[model.geom_bodyid[geom[0]]] != model.body_rootid[body]:
            found.append((int(geom[0]), gone))
        gone += _STEP
    return found
