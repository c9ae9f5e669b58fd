"""Measures three-dimensional clips with MuJoCo: seam, limits, ground, feet, dynamics."""

from __future__ import annotations

import dataclasses

import checks
import figure3d
import mujoco
import numpy as np

from trl_suite import motion

CHARACTERS = {
    'biped3d_walk': 'biped3d',
    'biped3d_mocap_walk': 'biped3d_mocap',
    'biped3d_full_walk': 'biped3d_full_mocap',
    'biped3d_run': 'biped3d',
    'biped3d_mocap_run': 'biped3d_mocap_run',
    'biped3d_full_run': 'biped3d_full_mocap',
}
FEET = ('right_ankle', 'left_ankle')
DEEP = 0.001  # m, self-contact that counts


@dataclasses.dataclass(frozen=True)
class Report(checks.Report):
    """What was measured, as `checks.Report` has it, and:

    Attributes:
      heading_change: of the root from the first to the last frame.
      speeds: lowest and highest forward speed of the root, m/s.
      heights: lowest and highest place of the root.
      clearance: least height of a foot's lowest corner in the middle third of its swing.
      overlap: deepest self-contact.
      angles: lowest and highest pitch, yaw and roll, or hinge angle, by joint.
    """

    heading_change: float
    speeds: tuple[float, float]
    heights: tuple[float, float]
    clearance: float
    overlap: float
    angles: dict[str, np.ndarray]


def place(model: mujoco.MjModel, clip: motion.Clip) -> np.ndarray:
    """Returns where the columns of the clip's poses are in qpos."""
    columns = list(range(7))
    for name, size in zip(clip.joints, clip.sizes, strict=True):
        first = model.jnt_qposadr[model.joint(name).id]
        columns.extend(range(first, first + size))
    return np.array(columns)


def euler(clip: motion.Clip, poses: np.ndarray) -> dict[str, np.ndarray]:
    """Returns pitch, yaw and roll (n, 3) or the angle (n, 1) of every joint, rad."""
    found, column = {}, 7
    for name, size in zip(clip.joints, clip.sizes, strict=True):
        values = poses[:, column : column + size]
        found[name] = values if size == 1 else figure3d.angles(figure3d.matrices(values))
        column += size
    return found


def margins(model: mujoco.MjModel, angles: dict[str, np.ndarray]) -> dict[str, float]:
    """Returns the smallest distance of every joint from its limits, rad."""
    found = {}
    for name, values in angles.items():
        if values.shape[1] == 1:
            low, high = model.jnt_range[model.joint(name).id]
            found[name] = float(min((values - low).min(), (high - values).min()))
        else:
            limit = np.array(figure3d.LIMITS[name.rpartition('_')[2]])
            found[name] = float((limit - np.abs(values)).min())
    return found


def sweep(model: mujoco.MjModel, clip: motion.Clip, poses: np.ndarray):
    """Returns corners (n, 8, 3) of every collision box by name and the deepest self-contact, m."""
    data = mujoco.MjData(model)
    address = place(model, clip)
    boxes = [g for g in range(model.ngeom) if model.geom_group[g] == checks.GROUP]
    found = {model.geom(g).name: np.empty((len(poses), 8, 3)) for g in boxes}
    overlap = 0.0
    for i, pose in enumerate(poses):
        data.qpos[address] = pose
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        overlap = max([overlap, *(-data.contact.dist[: data.ncon])])
        for g in boxes:
            local = checks.SIGNS * model.geom_size[g]
            found[model.geom(g).name][i] = (
                data.geom_xpos[g] + local @ data.geom_xmat[g].reshape(3, 3).T
            )
    return found, float(overlap)


def clearance(box: np.ndarray, loop: bool) -> float:
    """Returns the least height of a foot's lowest corner in the middle third of a swing, m."""
    low = box[:, :, 2].min(axis=1)
    swings = checks.contacts(low > checks.NEAR) if loop else [np.flatnonzero(low > checks.NEAR)]
    least = np.inf
    for swing in swings:
        middle = swing[len(swing) // 3 : -(len(swing) // 3) or None]
        if len(middle):
            least = min(least, float(low[middle].min()))
    return least


def measure(clip: motion.Clip, character: str, samples: int = checks.SAMPLES) -> Report:
    """Measures a clip, looping or not, on a character of xml/."""
    model = figure3d.model(character)
    t = np.linspace(0, clip.duration, samples, endpoint=not clip.loop)
    poses = clip.pose(t)
    angles = euler(clip, poses)
    margin = margins(model, angles)
    worst = min(margin, key=lambda name: margin[name])
    boxes, overlap = sweep(model, clip, poses)
    feet = [boxes[foot] for foot in FEET]
    planted = np.any([foot[:, :, 2].min(axis=1) < checks.NEAR for foot in feet], axis=0)

    layout = clip.layout
    steps = np.diff(clip.times)[:, None]
    slopes = layout.change(clip.poses[:-1], clip.poses[1:]) / steps
    rates = {}
    for name, size in zip(clip.joints, clip.sizes, strict=True):
        _, first = layout.starts(name)
        rates[name] = float(np.linalg.norm(slopes[:, first : first + min(size, 3)], axis=1).max())
    fastest = max(rates, key=lambda name: rates[name])
    seam_position = seam_rate = np.nan
    if clip.loop:
        end = clip.poses[-1].copy()
        end[:3] -= clip.displacement
        seam_position = float(np.abs(layout.change(end, clip.poses[0])).max())
        changes = np.abs(np.diff(slopes, axis=0)).max(axis=0)
        seam_rate = float((np.abs(slopes[0] - slopes[-1]) / np.maximum(changes, 1e-6)).max())
    return Report(
        period=clip.duration,
        speed=clip.speed,
        seam_position=seam_position,
        seam_rate=seam_rate,
        margin=(margin[worst], worst),
        lowest=float(min(box[:, :, 2].min() for box in boxes.values())),
        slide=max(
            checks.slide(foot, clip.displacement[:2] if clip.loop else None) for foot in feet
        ),
        planted=float(planted.mean()),
        fastest=(rates[fastest], fastest),
        heading_change=clip.heading_change,
        speeds=(float(slopes[:, 0].min()), float(slopes[:, 0].max())),
        heights=(float(poses[:, 2].min()), float(poses[:, 2].max())),
        clearance=min(clearance(foot, clip.loop) for foot in feet),
        overlap=overlap,
        angles={
            name: np.stack([value.min(axis=0), value.max(axis=0)]) for name, value in angles.items()
        },
    )


@dataclasses.dataclass(frozen=True)
class Forces:
    """The ground reaction from inverse dynamics; arrays over samples.

    Attributes:
      force: on the body over its weight, (n, 3).
      outside: distance of the zero-moment point from the box around the low corners, m, (n,); NaN
        where none is low.
    """

    force: np.ndarray
    outside: np.ndarray

    @property
    def friction(self) -> np.ndarray:
        """Ratio of horizontal to vertical force where the vertical force is not 0, (n,)."""
        loaded = self.force[self.force[:, 2] > 0.1]
        return np.hypot(loaded[:, 0], loaded[:, 1]) / loaded[:, 2]


def dynamics(model: mujoco.MjModel, clip: motion.Clip, poses: np.ndarray, dt: float) -> Forces:
    """Returns the forces on a body that moves through poses `dt` apart; the ends are left out."""
    data = mujoco.MjData(model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT
    address = place(model, clip)
    qpos = np.empty((len(poses), model.nq))
    qpos[:, address] = poses
    rate = np.empty((len(poses) - 1, model.nv))
    for i in range(len(rate)):
        mujoco.mj_differentiatePos(model, rate[i], dt, qpos[i], qpos[i + 1])
    weight = model.body_subtreemass[0] * 9.81
    boxes, _ = sweep(model, clip, poses)
    corners = np.concatenate([boxes[foot] for foot in FEET], axis=1)
    force, outside = np.empty((len(poses) - 2, 3)), np.full(len(poses) - 2, np.nan)
    for i in range(1, len(poses) - 1):
        data.qpos, data.qvel = qpos[i], (rate[i - 1] + rate[i]) / 2
        data.qacc = (rate[i] - rate[i - 1]) / dt
        mujoco.mj_inverse(model, data)
        push = data.qfrc_inverse[:3]
        force[i - 1] = push / weight
        low = corners[i, corners[i, :, 2] < checks.NEAR, :2]
        if push[2] > 0.1 * weight and len(low):
            # The root's generalised torque is in its own axes and about its joint.
            moment = data.xmat[1].reshape(3, 3) @ data.qfrc_inverse[3:6]
            moment += np.cross(data.qpos[:3], push)
            zmp = np.array([-moment[1], moment[0]]) / push[2]
            gap = np.maximum(low.min(axis=0) - zmp, zmp - low.max(axis=0))
            outside[i - 1] = np.hypot(*np.maximum(gap, 0))
    return Forces(force, outside)
