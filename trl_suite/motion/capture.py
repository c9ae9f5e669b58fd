"""Captured motion: BVH files and Acclaim's skeleton and motion files (ASF, AMC; the CMU database).

`trl_suite.retargeting` transfers a capture to the skeleton of a character. BVH is read by the
package pybvh. Acclaim's two formats are read here: existing packages lose frames or reject bones
without degrees of freedom, and dm_control's reader of AMC loses the names of bones.

Captures are rotated from the file's frame, by default y up and z forward, to that of trl_suite
(x forward, y left, z up).
"""

from __future__ import annotations

import dataclasses
import os
import pathlib
import tempfile
from collections.abc import Sequence
from typing import Any

import numpy as np

from trl_suite.motion import quaternion
from trl_suite.motion.layout import LARGEST
from trl_suite.util import errors
from trl_suite.util.files import existing, read_text
from trl_suite.util.libraries import library
from trl_suite.util.options import checked

BVH_UNIT = 0.01  # m; most files are in cm
ACCLAIM_UNIT = 0.0254  # m; an inch, multiplied by the factor in the file
ACCLAIM_RATE = 120.0  # frames per second of the CMU database, whose files do not state the rate
MOST_JOINTS = 2000
MOST_ROTATIONS = 2e7  # of a motion; frames need not name all bones
_AXES = {'x': (1.0, 0.0, 0.0), 'y': (0.0, 1.0, 0.0), 'z': (0.0, 0.0, 1.0)}


@dataclasses.dataclass(frozen=True, eq=False)
class Capture:
    """A motion of any skeleton of ball joints, in the frame of trl_suite.

    Attributes:
      name: name of the file.
      times: times of the frames, s, (n,), starting at 0.
      joints: names, parents before children, the root first; J of them.
      parents: index of each joint's parent, -1 for the root.
      rest: positions of joints relative to the root in the rest pose, m, (J, 3).
      positions: positions of the root, m, (n, 3).
      rotations: rotations of each joint's bones from their rest pose, in world axes, unit
        quaternions wxyz, (n, J, 4).
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
      unit: unit of lengths in m.
      forward: axis that the rest pose faces: 'x', 'y' or 'z', with a - before it if negative.
      up: axis that points up.

    Raises:
      ValueError: a malformed file, or invalid axes; the message names the file.
      FileNotFoundError: there is no such file.
      ImportError: the extra 'clips' is not installed.
    """
    path = existing(path)
    axes = frame(forward, up)
    checked('unit', unit, float, 'm', above=0)
    text = read_text(path)
    _check_bvh(path, text)
    pybvh = library('pybvh', 'trl_suite[clips]')
    with tempfile.TemporaryDirectory() as folder:
        copy = pathlib.Path(folder, 'copy.bvh')  # pybvh reads no other suffix
        try:
            copy.write_text(text)  # in the encoding of the system, in which pybvh reads
            found = pybvh.read_bvh_file(copy, world_up='+y', warn_on_world_up_disagreement=False)
        except UnicodeEncodeError as error:
            raise ValueError(
                f'{path}: {text[error.start : error.end]!r} is not in the encoding of the system, '
                f'{error.encoding}; expected other names, or Python with -X utf8'
            ) from None
        except (ValueError, IndexError) as error:
            raise ValueError(f'{path}: {error}'.replace(str(copy), path.name)) from None
        except OverflowError:
            raise ValueError(f'{path}: a number is too large, or Frame Time is too small') from None
    values = np.concatenate(
        [found.root_pos, found.joint_angles.reshape(len(found.root_pos), -1)], axis=1
    )
    for bad in np.flatnonzero(~(np.abs(values) < LARGEST).all(axis=1)):
        raise ValueError(f'{path}: frame {bad}: a number is not finite, or too large')
    if not 0 < found.frame_time < LARGEST:
        raise ValueError(f'{path}: Frame Time is {found.frame_time}; expected a positive number')
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
    rate: float | None = None,
    unit: float = ACCLAIM_UNIT,
    forward: str = 'z',
    up: str = 'y',
) -> Capture:
    """Reads a motion in Acclaim's format, such as those of the CMU motion capture database.

    A joint has the name of its child bone.

    Args:
      path: the motion, an .amc file.
      skeleton: the .asf file that belongs to it.
      rate: frames per second; None: those that the file states, or 120.
      unit: unit of lengths in m, before multiplication by the file's factor.
      forward, up: as for `read_bvh`.

    Raises:
      ValueError: a malformed file; the message names file and line.
      FileNotFoundError: there is no such file.
    """
    path, skeleton = existing(path), existing(skeleton)
    axes = frame(forward, up)
    checked('rate', rate, float | None, 'frames per second', above=0)
    checked('unit', unit, float, 'm', above=0)
    bones, length, degrees = _skeleton(skeleton)
    frames, stated, in_degrees = _frames(path, bones)
    rate = rate or stated or ACCLAIM_RATE
    if len(frames) * len(bones) > MOST_ROTATIONS:
        raise ValueError(
            f'{path}: {len(frames)} frames of {len(bones)} bones; expected no more than '
            f'{MOST_ROTATIONS:g} rotations in all'
        )
    times, names = np.arange(len(frames)) / rate, list(bones)
    radians = np.pi / 180 if degrees else 1.0
    turned = radians if in_degrees is None else np.pi / 180 if in_degrees else 1.0
    offsets, local = np.zeros((len(bones), 3)), []
    for i, (name, bone) in enumerate(bones.items()):
        if bone['parent']:
            offsets[i] = bones[bone['parent']]['tip']
        values = np.array([values.get(name, [0.0] * len(bone['dof'])) for values in frames])
        angles = np.zeros((len(frames), 3))
        for column, dof in enumerate(bone['dof']):
            if dof.startswith('r'):
                angles[:, bone['order'].index(dof[1])] = turned * values[:, column]
            elif bone['parent'] and values[:, column].any():
                raise ValueError(
                    f'{path}: bone {name!r} moves along {dof!r}; expected rotations only, except of the root'
                )
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
    """Returns the rotation matrix (3, 3) from a file's frame to that of trl_suite.

    Raises:
      ValueError: an axis is invalid, or both are the same.
    """
    rows = []
    for name, axis in (('forward', forward), ('up', up)):
        letter = axis.lstrip('+-')
        if letter not in _AXES or len(axis) > 2:
            raise ValueError(f"{name} is {axis!r}; expected 'x', 'y', 'z', '-x', '-y' or '-z'")
        rows.append(np.array(_AXES[letter]) * (-1 if axis[0] == '-' else 1))
    if abs(rows[0] @ rows[1]) > 0:
        raise ValueError(f'forward is {forward!r} and up {up!r}; expected two axes')
    return np.stack([rows[0], np.cross(rows[1], rows[0]), rows[1]])


def _euler(order: str, angles: np.ndarray, intrinsic: bool) -> np.ndarray:
    """Returns quaternions (n, 4) of Euler angles (n, 3) rad about axes in the given order.

    Intrinsic rotations are about body axes, the others about fixed ones.
    """
    from scipy.spatial.transform import Rotation  # takes time, and few programs need it

    turns = Rotation.from_euler(order.upper() if intrinsic else order.lower(), angles)
    return np.roll(turns.as_quat(), 1, axis=-1)  # scipy has w last


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
    """Builds a Capture from offsets and rotations relative to parents, in the file's frame."""
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
    for what, values in (('rotation', turns), ('position', place), ('length', rest)):
        if not (np.abs(values) < LARGEST).all():
            raise ValueError(f'{path}: a {what} is not finite, or larger than {LARGEST:g}')
    return Capture(
        path.stem, times, tuple(names), tuple(parents), rest @ axes.T, place @ axes.T, turns
    )


def _check_bvh(path: pathlib.Path, text: str) -> None:
    """Raises an error, with the line number, for input that pybvh rejects or reads wrongly."""
    joints = 0
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split()
        key = words[0].upper() if words else ''
        if key == 'MOTION':
            return
        joints += key == 'JOINT'
        if joints > MOST_JOINTS:
            raise ValueError(f'{path}, line {number}: expected at most {MOST_JOINTS} joints')
        if key == 'OFFSET' and not _three_numbers(words[1:]):
            raise ValueError(
                f'{path}, line {number}: {line.strip()!r}; expected OFFSET and three finite numbers'
            )
        if key == 'CHANNELS' and words[1:2] == ['0']:
            raise ValueError(
                f'{path}, line {number}: {line.strip()!r}: joints without channels are not supported; '
                "expected 'CHANNELS 3 Zrotation Xrotation Yrotation', and three zeros in every frame"
            )
    raise ValueError(f'{path}: there is no line MOTION; expected one after the HIERARCHY')


def _three_numbers(words: Sequence[str]) -> bool:
    try:
        return len(words) == 3 and bool((np.abs(np.array(words, float)) < LARGEST).all())
    except ValueError:
        return False


def _skeleton(path: pathlib.Path) -> tuple[dict[str, dict[str, Any]], float, bool]:
    """Reads a .asf file: bones (parents first), factor of lengths, whether angles are degrees."""
    bones: dict[str, dict[str, Any]] = {
        'root': {'parent': '', 'dof': [], 'axis': np.zeros(3), 'order': 'xyz', 'tip': np.zeros(3)}
    }
    root = bones['root']
    bone: dict[str, Any] | None = None
    named = {'root': None}  # in the order of the hierarchy
    section, length, degrees = '', 1.0, True
    for number, line in enumerate(read_text(path).splitlines(), 1):
        words = line.split('#')[0].split()
        if not words:
            continue
        key, values = words[0].lower(), words[1:]
        try:
            if key.startswith(':'):
                section = key[1:]
            elif section == 'units' and key == 'length':
                length = _number(values, positive=True)
            elif section == 'units' and key == 'angle':
                degrees = _in_degrees(''.join(values).lower())
            elif section == 'root' and key == 'order':
                root['dof'] = _dofs(values)
                if not {'tx', 'ty', 'tz'} <= {*root['dof']}:
                    raise ValueError('expected TX, TY and TZ among them')
            elif section == 'root' and key == 'axis':
                root['order'] = _order(values)
            elif section == 'root' and key == 'orientation':
                root['axis'] = _vector(values)
            elif section == 'bonedata' and key == 'begin':
                bone = {'dof': [], 'axis': np.zeros(3), 'order': 'xyz'}
            elif section == 'bonedata' and bone is None:
                raise ValueError("expected 'begin' before it")
            elif section == 'bonedata' and bone is not None:
                if key == 'end':
                    for needed in ('name', 'length', 'direction'):
                        if needed not in bone:
                            raise ValueError(f'the bone has no {needed}')
                    bones[bone['name']] = {**bone, 'tip': bone['length'] * bone['direction']}
                    bone = None
                elif key == 'name':
                    (bone['name'],) = values
                    if bone['name'] in bones:
                        raise ValueError('the name is taken')
                    if len(bones) > MOST_JOINTS:
                        raise ValueError(f'expected at most {MOST_JOINTS} bones')
                elif key == 'length':
                    bone['length'] = _number(values)
                elif key == 'direction':
                    bone['direction'] = _vector(values)
                elif key == 'axis':
                    bone['axis'], bone['order'] = _vector(values[:3]), _order(values[3:])
                elif key == 'dof':
                    bone['dof'] = _dofs(values)
            elif section == 'hierarchy' and key not in ('begin', 'end'):
                if words[0] not in named:
                    raise ValueError('a bone whose parent is not named above')
                for child in values:
                    errors.check_known('bone', bones, child)
                    if child in named:
                        raise ValueError(f'{child!r} has a parent already')
                    bones[child]['parent'] = words[0]
                    named[child] = None
        except ValueError as error:
            raise ValueError(f'{path}, line {number}: {line.strip()!r}: {error}') from None
    if not root['dof'] or len(named) < 2:
        raise ValueError(f'{path}: expected the sections :root and :hierarchy')
    return {name: bones[name] for name in named}, length, degrees


def _in_degrees(unit: str) -> bool:
    """Returns whether a unit of angles is degrees, not radians."""
    if unit[:3] not in ('deg', 'rad'):
        raise ValueError("expected 'deg' or 'rad'")
    return unit[:3] == 'deg'


def _number(values: Sequence[str], positive: bool = False) -> float:
    (number,) = map(float, values)
    if not (1 / LARGEST if positive else 0) <= number < LARGEST:
        raise ValueError(f'expected a {"positive" if positive else "finite"} number')
    return number


def _vector(values: Sequence[str]) -> np.ndarray:
    if not _three_numbers(values):
        raise ValueError('expected three finite numbers')
    return np.array(values, float)


def _order(values: Sequence[str]) -> str:
    (order,) = values
    if sorted(order.lower()) != ['x', 'y', 'z']:
        raise ValueError('expected an order of axes, such as XYZ')
    return order.lower()


def _dofs(values: Sequence[str]) -> list[str]:
    found = [value.lower() for value in values]
    known = ('tx', 'ty', 'tz', 'rx', 'ry', 'rz', 'l')
    errors.check_known('degree of freedom', known, *found)
    if len({*found}) < len(found):
        raise ValueError('one of them is given twice')
    return found


def _frames(
    path: pathlib.Path, bones: dict[str, dict[str, Any]]
) -> tuple[list[dict[str, list[float]]], float | None, bool | None]:
    """Reads a .amc file: for every frame, the values of every bone.

    And, None if the file does not state them, its rate, and whether angles are degrees.
    """
    frames: list[dict[str, list[float]]] = []
    rate, degrees = None, None
    for number, line in enumerate(read_text(path).splitlines(), 1):
        words = line.split()
        if not words or words[0].startswith('#'):
            continue
        try:
            if words[0].startswith(':'):
                key = words[0][1:].lower()
                if key == 'samples-per-second':
                    rate = _number(words[1:], positive=True)
                elif key in ('degrees', 'radians'):
                    degrees = _in_degrees(key)
                continue
            if len(words) == 1:
                int(words[0])
                frames.append({})
                continue
            name, values = words[0], list(map(float, words[1:]))
            if not frames:
                raise ValueError('expected the number of a frame before it')
            errors.check_known('bone', bones, name)
            expected = len(bones[name]['dof'])
            if len(values) != expected:
                raise ValueError(f'{len(values)} numbers; expected {expected}')
            if not (np.abs(values) < LARGEST).all():
                raise ValueError('expected finite numbers')
            frames[-1][name] = values
        except ValueError as error:
            raise ValueError(f'{path}, line {number}: {line.strip()!r}: {error}') from None
    if len(frames) < 2:
        raise ValueError(f'{path}: {len(frames)} frames; expected at least 2')
    for i, found in enumerate(frames):
        if 'root' not in found:
            raise ValueError(f'{path}: frame {i} has no root')
    return frames, rate, degrees
