"""Reads MJCF and URDF files with MuJoCo: names elements, checks numbers, and rotates roots."""

from __future__ import annotations

import itertools
import os
import pathlib
import re
from typing import Any

import mujoco
import numpy as np
from lxml import etree

from trl_suite.characters import meshes
from trl_suite.motion import quaternion
from trl_suite.util import errors
from trl_suite.util.files import check_size

LARGEST = 1e30  # number in a file; squares of larger ones may overflow
MOST_PARTS = 10_000  # bodies, joints, geoms and sites of a file
# Kinds of elements, besides bodies, that need names because they are looked up later.
_NAMED = (
    'joints', 'geoms', 'sites', 'cameras', 'lights', 'equalities', 'excludes', 'pairs', 'tendons',
)  # fmt: skip

# Part of an error of the engine -> what it means, and the remedy.
_REMEDIES = {
    'A + B >= C': 'one moment of inertia is larger than the sum of the others, as of no body; correct '
    'it, or pass balance_inertia=True, which replaces all three by their mean',
    'positive eigenvalues': 'its moments of inertia are not those of a body; expected positive ones; '
    'or pass balance_inertia=True, which replaces all three by their mean, if that is positive',
    'mass and inertia of moving bodies': 'it moves, and has no mass or no inertia; expected both in '
    'its inertial, or a fixed joint',
    'coplanar vertices': 'all corners are in a plane; expected a solid, such as a thin box',
    'at least 4 vertices': 'it has less than 4 corners; expected a solid, such as a thin box',
    'mesh volume is too small': 'it encloses no volume, from which to derive a mass; expected an '
    'inertial with the mass, or a closed mesh',
    'must be positive in geom': 'a size is 0 or negative; expected positive sizes',
    'surface area is too small': 'it is too small; is its scale right? expected lengths in m',
}


def named(file: pathlib.Path) -> mujoco.MjSpec:
    """Reads a file and its meshes, and gives names to elements without a name."""
    spec = mujoco.MjSpec.from_file(str(file))
    parts = sum(len(getattr(spec, kind)) for kind in ('bodies', 'joints', 'geoms', 'sites'))
    if parts > MOST_PARTS:
        raise ValueError(
            f'bodies, joints, geoms and sites are {parts}; expected no more than {MOST_PARTS}'
        )
    spec.memory = spec.njmax = spec.nconmax = spec.nstack = -1  # it is simulated in another model
    spec.compiler.fusestatic = False  # bodies without joints may be end effectors
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
            raise ValueError(
                f'the name {item.name!r} has a slash, a line break or another character that is '
                'not printable; expected a name without them'
            )
    for flex in spec.flexes:
        raise ValueError(
            f'flex {flex.name!r}: flexible bodies are not supported, nor rigid ones made of a flex; '
            'remove it, or replace it by geoms'
        )
    meshes.prepare(spec, file)
    return spec


def balance_inertia(spec: mujoco.MjSpec) -> None:
    """Replaces moments of inertia that no body has by their mean."""
    spec.compiler.balanceinertia = (
        True  # of those one of which is larger than the sum of the others
    )
    for body in spec.bodies:
        xx, yy, zz, xy, xz, yz = body.fullinertia
        tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        if np.isfinite(tensor).all() and np.linalg.eigvalsh(tensor)[0] <= 0 < tensor.trace():
            body.fullinertia = (*3 * (tensor.trace() / 3,), 0, 0, 0)


def compiled(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compiles a file; a mesh without volume is no fault if the mass of its bodies is given."""
    # After an error, they cannot be asked for.
    users, shapes = meshes.users(spec), {mesh.name: mesh for mesh in spec.meshes}
    for _ in range(len(shapes) + 1):
        try:
            return spec.compile()
        except ValueError as error:
            text = str(error)
        name = (re.findall("Element name '(.*)', id", text) or [''])[0]
        if 'mesh volume is too small' not in text or not all(users.get(name, {}).values()):
            break
        shapes[name].inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    of_mesh = name in users and re.search('mesh|vertices', text)
    kind = 'geom' if 'in geom' in text else 'link'
    what = meshes.described(name, users[name]) if of_mesh else f'{kind} {name!r}'
    for part, remedy in _REMEDIES.items():
        if part in text:
            text = f'{what}: {remedy}'
    raise ValueError(text)


def _name(item: Any, wanted: str, taken: set[str]) -> None:
    """Gives an element that has no name one that no other has."""
    if not item.name:
        numbers = itertools.count(1)
        name = wanted
        while name in taken:
            name = f'{wanted}_{next(numbers)}'
        taken.add(name)
        item.name = name


def check_numbers(file: pathlib.Path) -> None:
    """Raises an error for NaN, which MuJoCo treats as a missing value, and for huge numbers.

    Args:
      file: an absolute path; files that it includes or loads are checked as well.
    """
    files = [file]
    for each in files:  # grows
        check_size(each)
        where = '' if each == file else f'{each}: '
        try:
            parser = etree.XMLParser(resolve_entities=False)
            # MuJoCo ignores the version of XML, of which lxml knows one.
            content = re.sub(
                rb'\A(\s*<\?xml\s+version=).*?(?=[\s?])', rb'\1"1.0"', each.read_bytes()
            )
            elements = [*etree.fromstring(content, parser).iter(etree.Element)]
        except etree.XMLSyntaxError as error:
            raise ValueError(f'{where}not a model: {error}') from None
        names = {element.get(key) for element in elements for key in ('name', 'class')}
        for element in elements:
            for key, text in element.items():
                if text not in names and key not in ('name', 'class') and _is_huge(text):
                    of = f' of {element.get("name")!r}' if element.get('name') else ''
                    raise ValueError(
                        f'{where}line {element.sourceline}: {key}="{text}"{of} (<{element.tag}>); '
                        f'expected finite numbers up to {LARGEST:g}'
                    )
            if element.tag in ('include', 'model') and element.get('file'):
                # MuJoCo resolves paths also relative to the first file.
                for folder in (each.parent, file.parent):
                    inside = pathlib.Path(os.path.abspath(folder / element.get('file', '')))
                    if inside.is_file():  # otherwise MuJoCo reports the missing file
                        files += [] if inside in files else [inside]
                        break


def _is_huge(text: str) -> bool:
    """Whether a text is a list of numbers of which some are not finite, or above `LARGEST`."""
    try:
        return not all(abs(float(number)) <= LARGEST for number in text.split())
    except ValueError:
        return False


def find_root(model: mujoco.MjModel, root: str | None) -> int:
    """Returns the id of the root body; by default the only child of the world with joints below."""
    top = {model.body(i).name: i for i in range(1, model.nbody) if not model.body_parentid[i]}
    jointed = {model.body_rootid[i] for i in model.jnt_bodyid if model.body_parentid[i]}
    likely = [name for name, i in top.items() if i in jointed and model.body_mocapid[i] < 0] or [
        *top
    ]
    if root is None and len(likely) == 1:
        (root,) = likely
    if root in top:
        return top[root]
    if not top:
        raise ValueError('there is no body; expected one that is the ancestor of all others')
    if root is None:
        raise ValueError(f'several bodies may be the root; pass root=, one of {likely}')
    names = [model.body(i).name for i in range(1, model.nbody)]
    if root in names:
        above = model.body(model.body_rootid[model.body(root).id]).name
        raise ValueError(f'root {root!r} is the child of another body; did you mean {above!r}?')
    raise ValueError(errors.unknown('root', root, names))


def turned(spec: mujoco.MjSpec, root: str, rotation: np.ndarray) -> mujoco.MjModel:
    """Rotates the children of a body, so that the axes of the body are those of the world.

    The rotation is a unit quaternion wxyz. Returns the compiled file.
    """
    body = spec.body(root)
    for equality in spec.equalities:
        if equality.objtype == mujoco.mjtObj.mjOBJ_BODY and root in (
            equality.name1,
            equality.name2,
        ):
            raise ValueError(
                f'the root {root!r} is rotated, and equality {equality.name!r} refers to it; remove '
                'the equality, or rotate the character in the file'
            )
    frame = body.add_frame(quat=rotation)
    for item in (*body.geoms, *body.sites, *body.cameras, *body.lights, *body.bodies):
        if item.frame is None:
            item.set_frame(frame)
    for each in body.frames:
        if each is not frame and each.frame is None:
            each.set_frame(frame)
    if body.explicitinertial:
        model = compiled(spec)  # resolves orientations that are not given as quaternions
        number = model.body(root).id
        body.ipos = quaternion.rotate(rotation, model.body_ipos[number])
        body.iquat = quaternion.multiply(rotation, model.body_iquat[number])
        body.inertia, body.fullinertia = model.body_inertia[number], np.full(6, np.nan)
        body.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    body.quat = 1, 0, 0, 0
    body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    return compiled(spec)


def flat(text: str) -> str:
    """Returns MJCF, as `MjSpec.to_xml` writes it, without frames, which dm_control does not read."""
    tree = etree.fromstring(text.encode())
    for frame in reversed([*tree.iter('frame')]):  # the innermost first
        turn, origin = _place(frame)
        above, place = frame.getparent(), frame.getparent().index(frame)
        for child in reversed(frame):
            if child.tag in ('body', 'geom', 'site', 'camera', 'frame'):
                rotation, position = _place(child)
                position = origin + quaternion.rotate(turn, position)
                rotation = quaternion.multiply(turn, rotation)
                child.set('pos', ' '.join(map(repr, position.tolist())))
                child.set('quat', ' '.join(map(repr, rotation.tolist())))
            key = 'childclass' if child.tag in ('body', 'frame') else 'class'
            if frame.get('childclass') and child.get(key) is None:
                child.set(key, frame.get('childclass'))
            above.insert(place, child)
        above.remove(frame)
    return etree.tostring(tree, encoding='unicode')


def _place(element: etree._Element) -> tuple[np.ndarray, np.ndarray]:
    """Returns the rotation, as a quaternion wxyz, and the position of an element, m."""
    quat, pos = element.get('quat', '1 0 0 0'), element.get('pos', '0 0 0')
    return np.array(quat.split(), float), np.array(pos.split(), float)
