"""Reads MJCF and URDF files with MuJoCo: names elements, checks numbers, and rotates roots."""

from __future__ import annotations

import itertools
import math
import pathlib
import re
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from lxml import etree

from trl_suite.util import errors
from trl_suite.util.files import check_size

LARGEST = 1e30  # number in a file; squares of larger ones may overflow
MOST_PARTS = 10_000  # bodies, joints, geoms and sites of a file
_PARTS = (
    'body', 'joint', 'freejoint', 'geom', 'site', 'link', 'collision', 'composite', 'flexcomp',
)  # fmt: skip
_COPIES = ('replicate', 'composite', 'flexcomp')  # elements whose attribute 'count' multiplies
# Kinds of elements, besides bodies, that need names because they are looked up later.
_NAMED = ('joints', 'geoms', 'sites', 'cameras', 'lights', 'equalities', 'excludes', 'tendons')


def problem(file: pathlib.Path, what: str) -> ValueError:
    """Returns an error that names the file."""
    return ValueError(f'{file}: {what}')


def named(file: pathlib.Path) -> mujoco.MjSpec:
    """Reads a file, and gives names to elements without a name."""
    try:
        spec = mujoco.MjSpec.from_file(str(file))
    except ValueError as error:
        raise problem(file, f'not a model: {" ".join(str(error).split())}') from None
    spec.compiler.fusestatic = False  # bodies without joints may be end effectors
    for mesh in spec.meshes:
        mesh.file = _in_package(file, mesh.file)
    taken = {kind: {item.name for item in getattr(spec, kind)} for kind in ('bodies', *_NAMED)}
    for number, body in enumerate(spec.bodies[1:], 1):
        by_joint = body.joints[0].name if body.joints else ''
        _name(body, by_joint or f'{body.parent.name}_{number}', taken['bodies'])
        for kind, items in (('joints', body.joints), ('geoms', body.geoms)):
            for i, item in enumerate(items):
                word = '_geom' if kind == 'geoms' else ''
                _name(item, f'{body.name}{word}{i if word or len(items) > 1 else ""}', taken[kind])
    for kind in _NAMED:
        for i, item in enumerate(getattr(spec, kind)):
            _name(item, f'unnamed_{kind}_{i}', taken[kind])
    for item in (*spec.bodies[1:], *(item for kind in _NAMED for item in getattr(spec, kind))):
        if '/' in item.name or not item.name.isprintable():
            raise problem(
                file, f'the name {item.name!r} has a slash, a line break or another character that is '
                'not printable; expected a name without them',
            )  # fmt: skip
    return spec


def _name(item: Any, wanted: str, taken: set[str]) -> None:
    """Gives an element that has no name one that no other has."""
    if not item.name:
        numbers = itertools.count(1)
        name = wanted
        while name in taken:
            name = f'{wanted}_{next(numbers)}'
        taken.add(name)
        item.name = name


def check_numbers(file: pathlib.Path, above: tuple[pathlib.Path, ...] = ()) -> None:
    """Raises an error for NaN, which MuJoCo treats as a missing value, and for huge numbers.

    Refuses models that load themselves, too, which would crash the process, and those with so many
    parts that MuJoCo would take all memory.

    Args:
      file: the file; files that it includes or loads are checked as well.
      above: files that load it, the first one first.
    """
    check_size(file)
    try:
        parser = etree.XMLParser(resolve_entities=False)
        elements = [*etree.fromstring(file.read_bytes(), parser).iter(etree.Element)]
    except etree.XMLSyntaxError as error:
        raise problem(file, f'not a model: {error}') from None
    _check_parts(file, elements)
    names = {element.get(key) for element in elements for key in ('name', 'class')}
    for element in elements:
        for key, text in element.items():
            if text not in names and key not in ('name', 'class') and _is_huge(text):
                of = f' of {element.get("name")!r}' if element.get('name') else ''
                raise problem(
                    file, f'line {element.sourceline}: {key}="{text}"{of} (<{element.tag}>); expected '
                    f'finite numbers up to {LARGEST:g}',
                )  # fmt: skip
    above = (*above, file.resolve())
    for element in elements:
        if element.tag not in ('include', 'model') or not element.get('file'):
            continue
        # MuJoCo resolves paths also relative to the first file.
        for folder in dict.fromkeys((file.parent, above[0].parent)):
            inside = folder / element.get('file', '')
            if inside.resolve() in above:
                raise problem(
                    file, f'line {element.sourceline}: <{element.tag} file="{element.get("file")}"> '
                    'loads a file that loads this one; expected another model',
                )  # fmt: skip
            if inside.is_file():  # otherwise MuJoCo reports the missing file
                check_numbers(inside, above)
                break


def _check_parts(file: pathlib.Path, elements: list[etree._Element]) -> None:
    """Refuses more than `MOST_PARTS` parts, counting the copies that MuJoCo makes."""
    total = 0
    for element in elements:
        if element.tag in _PARTS:
            around = (element, *element.iterancestors(*_COPIES))
            total += math.prod(_count(each) for each in around)
            if total > MOST_PARTS:
                raise problem(
                    file, f'line {element.sourceline}: bodies, joints, geoms and sites are more than '
                    f'{MOST_PARTS}; expected fewer',
                )  # fmt: skip


def _count(element: etree._Element) -> int:
    """Returns how many copies an element makes."""
    numbers = element.get('count', '') if element.tag in _COPIES else ''
    return math.prod(int(number) for number in numbers.split() if number.isdecimal())


def _is_huge(text: str) -> bool:
    """Whether a text is a list of numbers of which some are not finite, or above `LARGEST`."""
    try:
        return not all(abs(float(number)) <= LARGEST for number in text.split())
    except ValueError:
        return False


def _in_package(file: pathlib.Path, name: str) -> str:
    """Returns the path of a mesh of a ROS package, from a file in that package."""
    address = re.fullmatch(r'package:/+([^/]+)/(.+)', name)
    if address is None:
        return name
    package, inside = address.groups()
    places = [
        parent / part
        for parent in file.resolve().parents
        for part in (inside, f'{package}/{inside}')
    ]
    return str(next((place for place in places if place.is_file()), name))


def find_root(file: pathlib.Path, model: mujoco.MjModel, root: str | None) -> int:
    """Returns the id of the root body; by default the only child of the world."""
    top = {model.body(i).name: i for i in range(1, model.nbody) if not model.body_parentid[i]}
    if root is None and len(top) == 1:
        (root,) = top
    if root in top:
        return top[root]
    if not top:
        raise problem(file, 'there is no body; expected one that is the ancestor of all others')
    if root is None:
        raise problem(file, f'several bodies may be the root; pass root=, one of {[*top]}')
    names = [model.body(i).name for i in range(1, model.nbody)]
    if root in names:
        above = model.body(model.body_rootid[model.body(root).id]).name
        raise problem(file, f'root {root!r} is the child of another body; did you mean {above!r}?')
    raise problem(file, errors.unknown('root', root, names))


def turned(
    file: pathlib.Path, spec: mujoco.MjSpec, root: str, rotation: np.ndarray
) -> mujoco.MjModel:
    """Rotates the children of a body, so that the axes of the body are those of the world.

    Args:
      file: path of the file, for messages.
      spec: the file as read, which is changed.
      root: name of the body, a child of the world.
      rotation: rotation of its children, unit quaternion wxyz.

    Returns:
      The compiled file.
    """
    body = spec.body(root)
    for equality in spec.equalities:
        if equality.objtype == mujoco.mjtObj.mjOBJ_BODY and root in (
            equality.name1, equality.name2,
        ):  # fmt: skip
            raise problem(
                file, f'the root {root!r} is rotated, and equality {equality.name!r} refers to it; remove '
                'the equality, or rotate the character in the file',
            )  # fmt: skip
    frame = body.add_frame(quat=rotation)
    for item in (*body.geoms, *body.sites, *body.cameras, *body.lights, *body.bodies):
        if item.frame is None:
            item.set_frame(frame)
    for each in body.frames:
        if each is not frame and each.frame is None:
            each.set_frame(frame)
    if body.explicitinertial:
        model = spec.compile()  # resolves orientations that are not given as quaternions
        number = model.body(root).id
        turn = Rotation(rotation)
        body.ipos = turn.vector(model.body_ipos[number])
        body.iquat = turn.quaternion(model.body_iquat[number])
        body.inertia, body.fullinertia = model.body_inertia[number], np.full(6, np.nan)
        body.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    body.quat = 1, 0, 0, 0
    body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    return compiled(file, spec)


def compiled(file: pathlib.Path, spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compiles a file."""
    try:
        return spec.compile()
    except ValueError as error:
        raise problem(file, ' '.join(str(error).split())) from None


def flat(text: str) -> str:
    """Returns MJCF, as `MjSpec.to_xml` writes it, without frames, which dm_control does not read."""
    tree = etree.fromstring(text.encode())
    for frame in reversed([*tree.iter('frame')]):  # the innermost first
        turn = Rotation(_numbers(frame, 'quat', (1, 0, 0, 0)))
        origin = _numbers(frame, 'pos', (0, 0, 0))
        above, place = frame.getparent(), frame.getparent().index(frame)
        for child in reversed(frame):
            if child.tag in ('body', 'geom', 'site', 'camera', 'frame'):
                position = origin + turn.vector(_numbers(child, 'pos', (0, 0, 0)))
                rotation = turn.quaternion(_numbers(child, 'quat', (1, 0, 0, 0)))
                child.set('pos', ' '.join(map(repr, position.tolist())))
                child.set('quat', ' '.join(map(repr, rotation.tolist())))
            key = 'childclass' if child.tag in ('body', 'frame') else 'class'
            if frame.get('childclass') and child.get(key) is None:
                child.set(key, frame.get('childclass'))
            above.insert(place, child)
        above.remove(frame)
    return etree.tostring(tree, encoding='unicode')


def _numbers(element: etree._Element, key: str, default: Sequence[float]) -> np.ndarray:
    text = element.get(key)
    return np.array(default if text is None else text.split(), float)


class Rotation:
    """A rotation that is applied to vectors and to other rotations."""

    def __init__(self, quaternion: Sequence[float] | np.ndarray) -> None:
        self._turn = np.array(quaternion, float)

    def vector(self, vector: np.ndarray) -> np.ndarray:
        result = np.empty(3)
        mujoco.mju_rotVecQuat(result, vector, self._turn)
        return result

    def quaternion(self, quaternion: np.ndarray) -> np.ndarray:
        result = np.empty(4)
        mujoco.mju_mulQuat(result, self._turn, quaternion)
        return result
