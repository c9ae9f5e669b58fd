"""Measures a clip on its character with MuJoCo's kinematics: seam, limits, ground, feet."""

from __future__ import annotations

import dataclasses
import itertools

import figure
import mujoco
import numpy as np

from trl_suite.motion.clip import Clip

SAMPLES = 2000
GROUP = (
    3  # geom group of the collision boxes, the dog's tail (which collides with nothing) included
)
NEAR = 0.003  # m; a foot is planted while its lowest corner is lower than this
CHARACTERS = {
    'biped2d_walk': 'biped2d',
    'biped2d_full_walk': 'biped2d_full',
    'biped2d_run': 'biped2d',
    'dog_bound': 'dog',
    'raptor_run_050': 'raptor',
    'raptor_run_066': 'raptor',
}
FEET = {
    'biped2d': ('right_ankle', 'left_ankle'),
    'biped2d_full': ('right_ankle', 'left_ankle'),
    'dog': ('finger', 'toe'),
    'raptor': ('right_toe', 'left_toe'),
}
SIGNS = np.array(list(itertools.product((-1, 1), repeat=3)))


@dataclasses.dataclass(frozen=True)
class Report:
    """What was measured; lengths in m, angles in rad, times in s.

    Attributes:
      period: s.
      speed: mean, m/s.
      seam_position: largest difference of last and first frame, displacement aside.
      seam_rate: change of the joint rates from the last to the first interval, as a share of the
        largest such change between neighbours anywhere in the clip.
      margin: smallest distance of a joint from its limits, and that joint.
      lowest: lowest point of any collision box over the cycle.
      slide: longest horizontal travel of a foot's lowest corner in one contact.
      planted: share of the cycle with at least one foot planted.
      fastest: largest joint rate, rad/s, and that joint.
    """

    period: float
    speed: float
    seam_position: float
    seam_rate: float
    margin: tuple[float, str]
    lowest: float
    slide: float
    planted: float
    fastest: tuple[float, str]


def corners(character: str, clip: Clip, t: np.ndarray) -> dict[str, np.ndarray]:
    """Returns the corners of every collision box in the world, (times, 8, 3) by geom name."""
    model = figure.model(character)
    data = mujoco.MjData(model)
    poses = clip.pose(t)
    address = [model.jnt_qposadr[model.joint(name).id] for name in clip.joints]
    boxes = [g for g in range(model.ngeom) if model.geom_group[g] == GROUP]
    found = {model.geom(g).name: np.empty((len(t), 8, 3)) for g in boxes}
    for i, pose in enumerate(poses):
        data.qpos[:3] = pose[:3]
        data.qpos[address] = pose[3:]
        mujoco.mj_kinematics(model, data)
        for g in boxes:
            local = SIGNS * model.geom_size[g]
            found[model.geom(g).name][i] = (
                data.geom_xpos[g] + local @ data.geom_xmat[g].reshape(3, 3).T
            )
    return found


def contacts(low: np.ndarray) -> list[np.ndarray]:
    """Returns the index runs of a cyclic mask, a run over the seam in one piece."""
    if low.all() or not low.any():
        return [np.arange(low.size)] if low.all() else []
    shift = int(np.argmin(low))  # start where the foot is in the air
    index = (np.arange(low.size) + shift) % low.size
    runs = np.split(index, np.flatnonzero(np.diff(low[index])) + 1)
    return [run for run in runs if low[run[0]]]


def slide(box: np.ndarray, displacement: np.ndarray | None) -> float:
    """Returns the longest horizontal travel of a corner in one contact, m.

    A corner's contact is the time it is lower than `NEAR`: heel and toe have one each, so that
    rolling from heel to toe is no slide.

    Args:
      box: corners, evenly sampled, (n, 8, 3); of a cycle without the last frame.
      displacement: x and y that a cycle adds, m; None: the motion does not repeat.
    """
    longest = 0.0
    for corner in range(8):
        low = box[:, corner, 2] < NEAR
        if displacement is None:
            index = np.arange(len(low))
            pieces = np.split(index, np.flatnonzero(np.diff(low)) + 1)
            runs = [piece for piece in pieces if low[piece[0]]]
        else:
            runs = contacts(low)
        for run in runs:
            path = box[run, corner, :2]
            if displacement is not None:
                path = path + np.where(run < run[0], 1, 0)[:, None] * displacement
            longest = max(longest, float(np.hypot(*np.ptp(path, axis=0))))
    return longest


def measure(clip: Clip, character: str, samples: int = SAMPLES) -> Report:
    """Measures a clip on a character of xml/."""
    model = figure.model(character)
    t = np.linspace(0, clip.duration, samples, endpoint=False)
    poses = clip.pose(t)
    margins = {}
    for i, name in enumerate(clip.joints):
        joint = model.joint(name).id
        if model.jnt_limited[joint]:
            low, high = model.jnt_range[joint]
            angle = poses[:, 3 + i]
            margins[name] = float(min((angle - low).min(), (high - angle).min()))
    end = clip.poses[-1].copy()
    end[:2] -= clip.displacement
    slopes = np.diff(clip.poses, axis=0) / np.diff(clip.times)[:, None]
    changes = np.abs(np.diff(slopes, axis=0)).max(axis=0)
    seam = np.abs(slopes[0] - slopes[-1])
    rates = np.abs(slopes[:, 3:]).max(axis=0)
    boxes = corners(character, clip, t)
    feet = [boxes[foot] for foot in FEET[character]]
    planted = np.any([foot[:, :, 2].min(axis=1) < NEAR for foot in feet], axis=0)
    worst = min(margins, key=lambda name: margins[name])
    return Report(
        period=clip.duration,
        speed=clip.speed,
        seam_position=float(np.abs(end - clip.poses[0]).max()),
        seam_rate=float((seam / np.maximum(changes, 1e-9)).max()),
        margin=(margins[worst], worst),
        lowest=float(min(box[:, :, 2].min() for box in boxes.values())),
        slide=max(slide(foot, np.array([clip.displacement[0], 0.0])) for foot in feet),
        planted=float(planted.mean()),
        fastest=(float(rates.max()), clip.joints[int(rates.argmax())]),
    )
