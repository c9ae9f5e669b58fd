"""Captured motion: BVH files and Acclaim's skeleton and motion files (ASF, AMC; the CMU database).

Their skeletons are not ours: `trl_suite.retargeting` carries a capture over to a character. BVH is
read by the package pybvh. Acclaim's two formats are read here: the packages that parse them lose
frames or refuse bones without degrees of freedom, and dm_control's reader of AMC loses the names of
bones.

Turned into our frame (x forward, y left, z up) from that of the file, by default y up and z forward.
"""

from __future__ import annotations

import dataclasses
import os
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from trl_suite.motion import quaternion
from trl_suite.util.files import existing

BVH_UNIT = 0.01  # m; most files are in cm
ACCLAIM_UNIT = 0.0254  # m; inches, times what the file says
ACCLAIM_RATE = 120.0  # frames per second of the CMU database; the files do not say
_AXES = {'x': (1.0, 0.0, 0.0), 'y': (0.0, 1.0, 0.0), 'z': (0.0, 0.0, 1.0)}


@dataclasses.dataclass(frozen=True, eq=False)
class Capture:
    """A motion of any skeleton of ball joints, in our frame.

    Attributes:
      name: of the file.
      times: of the frames, s, (n,), from 0 on.
      joints: names, parents before children, the root first; J of them.
      parents: number of each joint's parent, -1 of the root.
      rest: where joints are in the rest pose, from the root, m, (J, 3).
      positions: of the root, m, (n, 3).
      rotations: of what hangs on each joint, from its rest pose, in world axes, unit quaternions wxyz,
        (n, J, 4).
    """

    name: str
    times: np.ndarray
    joints: tuple[str, ...]
    parents: tuple[int, ...]
    rest: np.ndarray
    positions: np.ndarray
    rotations: np.ndarray


def read_bvh(
    path: str | os.PathLike[str],
    unit: float = BVH_UNIT,
    forward: str = 'z',
    up: str = 'y',
) -> Capture:
    """Reads a BVH file.

    Args:
      path: the file. Joints have three rotation channels each, the root three positions too.
      unit: of lengths, m.
      forward: axis that the rest pose looks along: 'x', 'y', 'z', or with a - before it.
      up: axis that points up.

    Raises:
      ValueError: a malformed file, or axes that are none; the message names the file.
      FileNotFoundError: there is no such file.
      ImportError: the extra 'clips' is not installed.
    """
    path = existing(path, ('.bvh',))
    axes = frame(forward, up)
    try:
        import pybvh
    except ImportError as error:
        raise ImportError(
            "pybvh is needed to read BVH and missing; pip install 'trl_suite[clips]'"
        ) from error
    try:
        found = pybvh.read_bvh_file(path, world_up='+y', warn_on_world_up_disagreement=False)
    except (ValueError, IndexError) as error:
        raise ValueError(f'{path}: {error}') from None
    nodes = [node for node in found.nodes if not node.is_end_site()]
    numbers = {node: i for i, node in enumerate(nodes)}
    parents = [-1 if node.parent is None else numbers[node.parent] for node in nodes]
    local = [
        _euler(order, found.joint_angles[:, i], intrinsic=True)
        for i, order in enumerate(found.euler_orders)
    ]
    offsets = unit * np.array([node.offset for node in nodes])
    times = np.arange(len(found.root_pos)) * found.frame_time
    names = [node.name for node in nodes]
    return _capture(path, times, names, parents, offsets, unit * found.root_pos, local, axes)


def read_amc(
    path: str | os.PathLike[str],
    skeleton: str | os.PathLike[str],
    rate: float = ACCLAIM_RATE,
    unit: float = ACCLAIM_UNIT,
    forward: str = 'z',
    up: str = 'y',
) -> Capture:
    """Reads a motion of Acclaim's format, such as those of the CMU motion capture database.

    A joint has the name of the bone that hangs on it.

    Args:
      path: the .amc file.
      skeleton: the .asf file that belongs to it.
      rate: frames per second.
      unit: of lengths, m, before the file's own factor.
      forward, up: as for `read_bvh`.

    Raises:
      ValueError: a malformed file; the message names file and line.
      FileNotFoundError: there is no such file.
    """
    path, skeleton = existing(path, ('.amc',)), existing(skeleton, ('.asf',))
    axes = frame(forward, up)
    if not 0 < rate < np.inf:
        raise ValueError(f'rate is {rate}; expected a positive number of frames per second')
    bones, length, degrees = _skeleton(skeleton)
    frames = _frames(path, bones)
    times, names = np.arange(len(frames)) / rate, list(bones)
    radians = np.pi / 180 if degrees else 1.0
    offsets, local = np.zeros((len(bones), 3)), []
    for i, (name, bone) in enumerate(bones.items()):
        if bone['parent']:
            offsets[i] = bones[bone['parent']]['tip']
        values = np.array([values.get(name, [0.0] * len(bone['dof'])) for values in frames])
        angles = np.zeros((len(frames), 3))
        for column, dof in enumerate(bone['dof']):
            if dof.startswith('r'):
                angles[:, bone['order'].index(dof[1])] = radians * values[:, column]
        rest = _euler(bone['order'], radians * bone['axis'][None], intrinsic=False)
        turn = _euler(bone['order'], angles, intrinsic=False)
        local.append(
            quaternion.multiply(quaternion.multiply(rest, turn), quaternion.conjugate(rest))
        )
    dofs = bones['root']['dof']
    place = [[values['root'][dofs.index(f't{axis}')] for axis in 'xyz'] for values in frames]
    scale = unit / length
    parents = [names.index(bone['parent']) if bone['parent'] else -1 for bone in bones.values()]
    return _capture(
        path, times, names, parents, scale * offsets, scale * np.array(place), local, axes
    )


def frame(forward: str, up: str) -> np.ndarray:
    """Returns the matrix (3, 3) that turns vectors of a file's frame into ours.

    Raises:
      ValueError: an axis that is none, or twice the same.
    """
    rows = []
    for name, axis in (('forward', forward), ('up', up)):
        letter = axis.lstrip('+-')
        if letter not in _AXES or len(axis) > 2:
            raise ValueError(
                f"{name} is {axis!r}; expected 'x', 'y' or 'z', with - before it or not"
            )
        rows.append(np.array(_AXES[letter]) * (-1 if axis[0] == '-' else 1))
    if abs(rows[0] @ rows[1]) > 0:
        raise ValueError(f'forward is {forward!r} and up {up!r}; expected two axes')
    return np.stack([rows[0], np.cross(rows[1], rows[0]), rows[1]])


def _euler(order: str, angles: np.ndarray, intrinsic: bool) -> np.ndarray:
    """Returns quaternions (n, 4) of turns about axes, angles (n, 3) rad in that order.

    Intrinsic turns are about axes that turn along, the others about fixed ones.
    """
    result = np.tile([1.0, 0.0, 0.0, 0.0], (len(angles), 1))
    for axis, angle in zip(order.lower(), angles.T, strict=True):
        turn = np.concatenate(
            [np.cos(angle / 2)[:, None], np.sin(angle / 2)[:, None] * _AXES[axis]], axis=1
        )
        pair = (result, turn) if intrinsic else (turn, result)
        result = quaternion.multiply(*pair)
    return result


def _capture(
    path: pathlib.Path,
    times: np.ndarray,
    names: Sequence[str],
    parents: Sequence[int],
    offsets: np.ndarray,
    place: np.ndarray,
    local: Sequence[np.ndarray],
    axes: np.ndarray,
) -> Capture:
    """Puts a motion together: offsets from parents, rotations against parents, the file's axes."""
    if len(times) < 2:
        raise ValueError(f'{path}: {len(times)} frames; expected at least 2')
    rest = np.zeros_like(offsets)
    turns = np.empty((len(times), len(names), 4))
    for i, parent in enumerate(parents):
        turns[:, i] = local[i]
        if parent >= 0:
            rest[i] = rest[parent] + offsets[i]
            turns[:, i] = quaternion.multiply(turns[:, parent], local[i])
    turns[..., 1:] = turns[..., 1:] @ axes.T
    if not (np.isfinite(turns).all() and np.isfinite(place).all()):
        raise ValueError(f'{path}: a value is not finite')
    return Capture(
        path.stem, times, tuple(names), tuple(parents), rest @ axes.T, place @ axes.T, turns
    )


def _skeleton(path: pathlib.Path) -> tuple[dict[str, dict[str, Any]], float, bool]:
    """Reads a .asf file: bones, parents before children, the factor of lengths, and if in degrees."""
    bones: dict[str, dict[str, Any]] = {
        'root': {'parent': '', 'dof': [], 'axis': np.zeros(3), 'order': 'xyz', 'tip': np.zeros(3)}
    }
    root = bones['root']
    bone: dict[str, Any] = {}
    children: list[str] = []
    section, length, degrees = '', 1.0, True
    for number, line in enumerate(path.read_text(encoding='utf-8').splitlines(), 1):
        words = line.split('#')[0].split()
        if not words:
            continue
        key, values = words[0].lower(), words[1:]
        try:
            if key.startswith(':'):
                section = key[1:]
            elif section == 'units' and key == 'length':
                length = float(values[0])
            elif section == 'units' and key == 'angle':
                degrees = values[0].lower().startswith('deg')
            elif section == 'root' and key == 'order':
                root['dof'] = [value.lower() for value in values]
            elif section == 'root' and key == 'axis':
                root['order'] = values[0].lower()
            elif section == 'root' and key == 'orientation':
                root['axis'] = np.array(values, float)
            elif section == 'bonedata' and key == 'begin':
                bone = {'dof': [], 'axis': np.zeros(3), 'order': 'xyz'}
            elif section == 'bonedata' and key == 'end':
                bones[bone['name']] = {**bone, 'tip': bone['length'] * bone['direction']}
            elif section == 'bonedata' and key == 'name':
                bone['name'] = values[0]
            elif section == 'bonedata' and key == 'length':
                bone['length'] = float(values[0])
            elif section == 'bonedata' and key == 'direction':
                bone['direction'] = np.array(values, float)
            elif section == 'bonedata' and key == 'axis':
                bone['axis'], bone['order'] = np.array(values[:3], float), values[3].lower()
            elif section == 'bonedata' and key == 'dof':
                bone['dof'] = [value.lower() for value in values]
            elif section == 'hierarchy' and key not in ('begin', 'end'):
                if words[0] not in ('root', *children):
                    raise ValueError('a bone whose own parent is not named above')
                for child in values:
                    bones[child]['parent'] = words[0]
                    children.append(child)
        except (ValueError, KeyError, IndexError) as error:
            raise ValueError(f'{path}, line {number}: {line.strip()!r}: {error!r}') from None
    if not root['dof'] or not children:
        raise ValueError(f'{path}: expected the sections :root and :hierarchy')
    return {name: bones[name] for name in ('root', *children)}, length, degrees


def _frames(path: pathlib.Path, bones: dict[str, dict[str, Any]]) -> list[dict[str, list[float]]]:
    """Reads a .amc file: the numbers of every bone, frame by frame."""
    frames: list[dict[str, list[float]]] = []
    for number, line in enumerate(path.read_text(encoding='utf-8').splitlines(), 1):
        words = line.split()
        if not words or words[0][0] in '#:':
            continue
        try:
            if len(words) == 1:
                int(words[0])
                frames.append({})
                continue
            name, values = words[0], list(map(float, words[1:]))
            expected = len(bones[name]['dof'])
            if len(values) != expected:
                raise ValueError(f'{len(values)} numbers; expected {expected}')
            frames[-1][name] = values
        except (ValueError, KeyError, IndexError) as error:
            raise ValueError(f'{path}, line {number}: {line.strip()!r}: {error!r}') from None
    for i, found in enumerate(frames):
        if 'root' not in found:
            raise ValueError(f'{path}: frame {i} has no root')
    return frames
