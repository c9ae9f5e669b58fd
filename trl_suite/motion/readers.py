"""Readers of the JSON motion files of Terrain RL Simulator and DeepMimic.

Both hold `Frames`, arrays of [duration of the frame in s, root x, y, z, root quaternion wxyz, then
one number per hinge and a quaternion wxyz per ball joint, in the order of the character file]. They
differ in `Loop`: a boolean in TerrainRL, 'wrap' or 'none' in DeepMimic, which also centres the
root, does not accumulate its height over cycles, and may accumulate its heading. Files of
DeepTerrainRL, the predecessor of TerrainRL, hold the same under `Motion`; their root is planar: x, y
and its angle.

The files' frame has x forward, y up and z to the right. In the frame of trl_suite,
(x, y, z) -> (x, -z, y), hinge angles keep their sign: hinges of the files are about +z, those here
about (0, -1, 0), which is the same axis.
"""

from __future__ import annotations

import dataclasses
import os
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from trl_suite.motion.clip import Clip
from trl_suite.motion.layout import LARGEST, SHORTEST, Layout
from trl_suite.util import errors
from trl_suite.util.files import read_json
from trl_suite.util.options import checked

# Numbers of a frame before the joints, and those of DeepTerrainRL.
_ROOT: tuple[str, ...] = ('duration', *3 * ('root position',), *4 * ('root quaternion',))
_PLANAR_ROOT: tuple[str, ...] = ('duration', 'root position', 'root position', 'root angle')
_HEADER = len(_ROOT)
_FLAT = 1e-4  # m, and quaternion components: largest deviation of a planar motion from the plane
_ZERO = 1e-6  # length below which a quaternion has no direction


# Joint layouts of DeepMimic's characters: name -> columns. Fixed joints (wrists) have no columns.
_ARM = (('shoulder', 4), ('elbow', 1))
_LEG = (('hip', 4), ('knee', 1), ('ankle', 4))
HUMANOID3D: Mapping[str, int] = {
    'chest': 4,
    'neck': 4,
    **{f'{side}_{name}': size for side in ('right', 'left') for name, size in (*_LEG, *_ARM)},
}
_FORELEG = (('shoulder', 4), ('forearm', 1), ('hand', 4), ('finger', 4))
_HINDLEG = (('upper_leg', 4), ('leg', 1), ('foot', 4), ('toe', 4))
DOG3D: Mapping[str, int] = {
    **dict.fromkeys(('spine0', 'spine1', 'neck', 'head'), 4),
    **{f'{side}_{name}': size for side in ('left', 'right') for name, size in _FORELEG},
    **{f'{side}_{name}': size for side in ('left', 'right') for name, size in _HINDLEG},
    **dict.fromkeys(('tail0', 'tail1'), 4),
}


def read_terrainrl(
    path: str | os.PathLike[str], joints: Sequence[str], sizes: Sequence[int], root: str
) -> Clip:
    """Reads a motion file of TerrainRL or of DeepTerrainRL.

    Args:
      path: JSON file.
      joints: joint names in the order of the character file.
      sizes: columns of each, 1 (hinge) or 4 (ball).
      root: 'planar' or 'free'; files of planar motions store the full root, too.

    Returns:
      The clip in the frame of trl_suite, named after the file, with normalised quaternions.

    Raises:
      ValueError: if the file is malformed or does not match the layout; the message names the file,
        the frame (counted from 0) and the field.
      FileNotFoundError: if there is no such file.
    """
    path = pathlib.Path(path)
    motion, head = _parse(path), _ROOT
    if isinstance(motion.get('Motion'), dict):
        motion, head = motion['Motion'], _PLANAR_ROOT
        if root != 'planar':
            raise ValueError(f'{path}: a motion in the plane; expected a planar character')
    loop = checked(f'{path}: Loop', motion.get('Loop', False), bool)
    frames = _frames(path, motion, head)
    if head is _PLANAR_ROOT:
        duration, x, y, angle = frames[:, : len(head)].T
        if (count := frames.shape[1]) != (needed := len(head) + sum(sizes)):
            raise ValueError(
                f'{path}: frame 0 has {count} numbers; expected {needed}, for {len(joints)} joints'
            )
        zero = np.zeros_like(x)
        full = (duration, x, y, zero, np.cos(angle / 2), zero, zero, np.sin(angle / 2))
        frames = np.column_stack([*full, frames[:, len(head) :]])
    return _clip(path, frames, joints, sizes, root, loop)


def read_deepmimic(
    path: str | os.PathLike[str],
    joints: Sequence[str] | None = None,
    sizes: Sequence[int] | None = None,
) -> Clip:
    """Reads a DeepMimic motion file; the default layout is that of humanoid3d.

    As in DeepMimic, the first frame is moved to the origin, and with `CycleSyncRootRot` the heading
    accumulates over cycles. The height of a looping clip accumulates only if `CycleSyncRootHeight`
    is set: otherwise the change of height over a cycle is removed evenly from the frames, where
    DeepMimic would jump between cycles.

    Args:
      path: JSON file.
      joints: joint names in the order of the character file, without fixed joints; by default those
        of `HUMANOID3D` or `DOG3D`, whichever has as many numbers as a frame.
      sizes: columns of each, 1 (hinge) or 4 (ball).

    Returns:
      The clip in the frame of trl_suite, root 'free', named after the file, with normalised
      quaternions.

    Raises:
      ValueError: as `read_terrainrl`, and for a looping clip whose displacement does not
        accumulate (`CycleSyncRootPos` false).
      FileNotFoundError: if there is no such file.
    """
    path = pathlib.Path(path)
    if (joints is None) != (sizes is None):
        raise ValueError('joints and sizes are given together, or neither')
    motion = _parse(path)
    loop = motion.get('Loop', 'none')
    if loop not in ('wrap', 'none'):
        raise ValueError(f"{path}: Loop is {loop!r}; expected 'wrap' or 'none'")
    looping = loop == 'wrap'
    turning = checked(f'{path}: CycleSyncRootRot', motion.get('CycleSyncRootRot', False), bool)
    frames = _frames(path, motion)
    if joints is None or sizes is None:
        layout = _deepmimic_layout(path, frames.shape[1])
        joints, sizes = tuple(layout), tuple(layout.values())
    if looping:
        if motion.get('CycleSyncRootPos', True) is not True:
            found = motion['CycleSyncRootPos']
            raise ValueError(f'{path}: CycleSyncRootPos is {found!r}; expected True')
        if not checked(
            f'{path}: CycleSyncRootHeight', motion.get('CycleSyncRootHeight', False), bool
        ):
            times = np.concatenate([[0], np.cumsum(frames[:-1, 0])])
            gain = frames[-1, 2] - frames[0, 2]
            frames[:, 2] -= gain * times / times[-1]
    frames[:, [1, 3]] -= frames[0, [1, 3]]
    clip = _clip(path, frames, joints, sizes, 'free', looping)
    return dataclasses.replace(clip, turning=looping and turning)


def _deepmimic_layout(path: pathlib.Path, length: int) -> Mapping[str, int]:
    """Returns the layout whose frames have this many numbers."""
    known = {_HEADER + sum(layout.values()): layout for layout in (HUMANOID3D, DOG3D)}
    if length not in known:
        lengths = ' or '.join(f'{count} ({len(layout)} joints)' for count, layout in known.items())
        raise ValueError(
            f"{path}: frame 0 has {length} numbers; DeepMimic's humanoid and dog have {lengths}"
        )
    return known[length]


def _parse(path: pathlib.Path) -> dict[str, Any]:
    motion = read_json(path)
    if not isinstance(motion, dict):
        raise ValueError(f'{path}: an object with Frames is needed')
    return motion


def _frames(
    path: pathlib.Path, motion: Mapping[str, Any], head: Sequence[str] = _ROOT
) -> np.ndarray:
    """Returns the frames as an array, (n, length), every number finite, no duration below `SHORTEST`.

    `head` names the numbers before the joints.
    """
    frames = motion.get('Frames')
    if not isinstance(frames, list):
        raise ValueError(f'{path}: Frames: an array of frames is needed')
    if len(frames) < 2:
        raise ValueError(f'{path}: Frames: at least 2 are needed, found {len(frames)}')
    for i, frame in enumerate(frames):
        if not isinstance(frame, list):
            raise ValueError(f'{path}: frame {i}: an array of numbers is needed')
        if len(frame) != len(frames[0]):
            raise ValueError(
                f'{path}: frame {i} has {len(frame)} numbers, frame 0 has {len(frames[0])}'
            )
        for j, value in enumerate(frame):
            number = isinstance(value, (int, float)) and not isinstance(value, bool)
            if not (number and abs(value) < LARGEST):  # false for NaN, too
                shown = repr(value) if len(repr(value)) < 40 else f'{repr(value)[:40]}...'
                raise ValueError(
                    f'{path}: frame {i}, {_field(j, head=head)}: {shown} is not a finite number below {LARGEST:g}'
                )
    if len(frames[0]) < len(head):
        raise ValueError(
            f'{path}: frame 0 has {len(frames[0])} numbers, at least {len(head)} are needed'
        )
    array = np.array(frames, dtype=float)
    for bad in np.flatnonzero(array[:-1, 0] < SHORTEST):
        raise ValueError(
            f'{path}: frame {bad}, duration: {array[bad, 0]:g} s; expected at least {SHORTEST:g} s'
        )
    return array


def _field(
    column: int,
    joints: Sequence[str] = (),
    sizes: Sequence[int] = (),
    head: Sequence[str] = _ROOT,
) -> str:
    """Returns the name of a column of a frame, for messages."""
    if column < len(head):
        return head[column]
    for joint, size in zip(joints, sizes, strict=True):
        if column < _HEADER + size:
            return f'joint {joint!r}'
        column -= size
    return f'column {column}'


def _clip(
    path: pathlib.Path,
    frames: np.ndarray,
    joints: Sequence[str],
    sizes: Sequence[int],
    root: str,
    loop: bool,
) -> Clip:
    """Returns frames of a file, which hold the root in full, as a clip."""
    layout, poses = Layout('free', joints, sizes), frames[:, 1:]
    if poses.shape[1] != layout.columns:
        raise ValueError(
            f'{path}: frame 0 has {frames.shape[1]} numbers, the layout of {len(joints)} joints '
            f'needs {1 + layout.columns}'
        )
    # (x, y, z) -> (x, -z, y)
    poses[:, :3] = poses[:, [0, 2, 1]] * (1, -1, 1)
    for column, _ in layout.rotations:
        here = slice(column, column + 4)
        norms = np.linalg.norm(poses[:, here], axis=1)
        for i in np.flatnonzero(norms < _ZERO):
            field = _field(column + 1, layout.joints, layout.sizes)
            raise ValueError(f'{path}: frame {i}, {field}: the quaternion is zero')
        poses[:, here] = (poses[:, here] / norms[:, None])[:, [0, 1, 3, 2]] * (1, 1, -1, 1)
    if root == 'planar':
        turns = poses[:, 3:7]
        position, rotation = np.abs(poses[:, 1]), np.abs(turns[:, [1, 3]]).max(axis=1)
        for field, off in (('root position', position), ('root quaternion', rotation)):
            for i in np.flatnonzero(off > _FLAT):
                raise ValueError(f'{path}: frame {i}, {field}: leaves the plane by {off[i]:g}')
        # A quaternion and its negative are the same rotation: unwrap the full angle, not half.
        pitch = np.unwrap(2 * np.arctan2(-turns[:, 2], turns[:, 0]))
        pitch -= 2 * np.pi * np.round(pitch[0] / (2 * np.pi))
        poses = np.column_stack([poses[:, [0, 2]], pitch, poses[:, 7:]])
    times = np.concatenate([[0], np.cumsum(frames[:-1, 0])])
    with errors.naming(path):
        kind = root, layout.joints, layout.sizes
        return Clip(path.stem, times, poses, *kind, loop, f'read from {path.name}')
