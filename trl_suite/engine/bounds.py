"""Bounding volumes, used by collision detection, of the geoms of static bodies.

After writing `geom_pos`, `geom_size` or `geom_quat` one must call `mj_setConst`, otherwise other
bodies fall through these geoms. For geoms of bodies without joints, it only changes their bounds,
the bounding volume hierarchies of their bodies, and the flags of coinciding frames
(`geom_sameframe`); but it also recomputes all inertias, which takes most of its time. `refresh`
writes only these bounds.

Source: MuJoCo 3.17, `mj_setConst`; tests compare all numbers of the two.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import mujoco
import numpy as np

from trl_suite.util.compiled import compiled, compiled_inline

_BOX = int(mujoco.mjtGeom.mjGEOM_BOX)
_NONE, _BODY, _INERTIA, _BODY_ROTATION, _INERTIA_ROTATION = (
    int(getattr(mujoco.mjtSameFrame, f'mjSAMEFRAME_{name}'))
    for name in ('NONE', 'BODY', 'INERTIA', 'BODYROT', 'INERTIAROT')
)
_SAME = 1e-6  # tolerance within which frames coincide


class Geoms(NamedTuple):
    """Inputs and outputs of the bounds: fields of one MjModel, by their MuJoCo names."""

    geom_type: np.ndarray
    geom_pos: np.ndarray
    geom_quat: np.ndarray
    geom_size: np.ndarray
    geom_aabb: np.ndarray
    geom_rbound: np.ndarray
    geom_sameframe: np.ndarray
    body_ipos: np.ndarray
    body_iquat: np.ndarray
    body_geomadr: np.ndarray
    body_geomnum: np.ndarray
    body_bvhadr: np.ndarray
    body_bvhnum: np.ndarray
    bvh_aabb: np.ndarray
    bvh_child: np.ndarray
    bvh_nodeid: np.ndarray


def geoms(model: mujoco.MjModel) -> Geoms:
    """Returns views of the fields of a model."""
    return Geoms(*(getattr(model, name) for name in Geoms._fields))


@compiled
def refresh(body: int, geoms: Geoms) -> None:
    """Updates the bounds of the geoms of a body.

    The body and its ancestors must have no joints. Its geoms must be boxes, planes or height
    fields; the sizes of planes and height fields must be unchanged.
    """
    first = geoms.body_geomadr[body]
    for geom in range(first, first + geoms.body_geomnum[body]):
        if geoms.geom_type[geom] == _BOX:
            total = 0.0
            for k in range(3):
                size = geoms.geom_size[geom, k]
                geoms.geom_aabb[geom, k], geoms.geom_aabb[geom, 3 + k] = 0.0, size
                total += size * size
            geoms.geom_rbound[geom] = math.sqrt(total)
        geoms.geom_sameframe[geom] = _frame(
            geom, body, geoms.geom_pos, geoms.geom_quat, geoms.body_ipos, geoms.body_iquat
        )
    start = geoms.body_bvhadr[body]
    # From the last node to the first: children are stored after their parents.
    for node in range(start + geoms.body_bvhnum[body] - 1, start - 1, -1):
        geom = geoms.bvh_nodeid[node]
        if geom >= 0:
            _bound_geom(node, geom, body, geoms)
        else:
            left, right = start + geoms.bvh_child[node, 0], start + geoms.bvh_child[node, 1]
            _bound_children(node, left, right, geoms.bvh_aabb)


@compiled
def refresh_all(bodies: np.ndarray, geoms: Geoms) -> None:
    """Updates the bounds of the geoms of bodies; takes a pack."""
    for body in bodies:
        refresh(body, geoms)


@compiled
def _bound_geom(node: int, geom: int, body: int, geoms: Geoms) -> None:
    """Writes the bounding box of a geom, in the inertial frame of its body, to a leaf node."""
    own, frame = geoms.geom_quat, geoms.body_iquat
    w, x, y, z = _product(
        frame[body, 0], -frame[body, 1], -frame[body, 2], -frame[body, 3],
        own[geom, 0], own[geom, 1], own[geom, 2], own[geom, 3],
    )  # fmt: skip
    right, up, ahead = geoms.geom_aabb[geom, 0], geoms.geom_aabb[geom, 1], geoms.geom_aabb[geom, 2]
    far = _rotated(w, x, y, z, right, up, ahead)
    offset = _rotated(
        frame[body, 0], -frame[body, 1], -frame[body, 2], -frame[body, 3],
        geoms.geom_pos[geom, 0] - geoms.body_ipos[body, 0],
        geoms.geom_pos[geom, 1] - geoms.body_ipos[body, 1],
        geoms.geom_pos[geom, 2] - geoms.body_ipos[body, 2],
    )  # fmt: skip
    a = _rotated(w, x, y, z, geoms.geom_aabb[geom, 3], 0.0, 0.0)
    b = _rotated(w, x, y, z, 0.0, geoms.geom_aabb[geom, 4], 0.0)
    c = _rotated(w, x, y, z, 0.0, 0.0, geoms.geom_aabb[geom, 5])
    for k in range(3):
        geoms.bvh_aabb[node, k] = offset[k] + far[k]
        geoms.bvh_aabb[node, 3 + k] = abs(a[k]) + abs(b[k]) + abs(c[k])


@compiled
def _bound_children(node: int, left: int, right: int, bounds: np.ndarray) -> None:
    """Writes the union of the bounding boxes of two child nodes to their parent node."""
    for k in range(3):
        low = min(bounds[left, k] - bounds[left, 3 + k], bounds[right, k] - bounds[right, 3 + k])
        high = max(bounds[left, k] + bounds[left, 3 + k], bounds[right, k] + bounds[right, 3 + k])
        bounds[node, k], bounds[node, 3 + k] = 0.5 * (low + high), 0.5 * (high - low)


@compiled
def _frame(
    geom: int, body: int, pos: np.ndarray, quat: np.ndarray, ipos: np.ndarray, iquat: np.ndarray
) -> int:
    """Returns which frame of its body the frame of a geom coincides with, as mjtSameFrame."""
    at_body, at_inertia, plus, minus, same, opposite = True, True, True, True, True, True
    for k in range(3):
        at_body &= abs(pos[geom, k]) < _SAME
        at_inertia &= abs(pos[geom, k] - ipos[body, k]) < _SAME
    for k in range(4):
        one = 1.0 if k == 0 else 0.0
        plus &= abs(quat[geom, k] - one) < _SAME
        minus &= abs(quat[geom, k] + one) < _SAME
        same &= abs(quat[geom, k] - iquat[body, k]) < _SAME
        opposite &= abs(quat[geom, k] + iquat[body, k]) < _SAME
    if plus or minus:
        return _BODY if at_body else _BODY_ROTATION
    if same or opposite:
        return _INERTIA if at_inertia else _INERTIA_ROTATION
    return _NONE


@compiled_inline
def _product(
    aw: float, ax: float, ay: float, az: float, bw: float, bx: float, by: float, bz: float
) -> tuple[float, float, float, float]:
    """Returns the product of two quaternions."""
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


@compiled_inline
def _rotated(
    w: float, x: float, y: float, z: float, a: float, b: float, c: float
) -> tuple[float, float, float]:
    """Returns a vector (a, b, c) rotated by a quaternion."""
    return (
        (w * w + x * x - y * y - z * z) * a + 2 * (x * y - w * z) * b + 2 * (x * z + w * y) * c,
        2 * (x * y + w * z) * a + (w * w - x * x + y * y - z * z) * b + 2 * (y * z - w * x) * c,
        2 * (x * z - w * y) * a + 2 * (y * z + w * x) * b + (w * w - x * x - y * y + z * z) * c,
    )
