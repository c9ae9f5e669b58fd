"""A user's own character, from an MJCF or URDF file.

    spec = characters.from_file('walker.urdf', fall_links=('trunk',),
                                end_effectors=('left_foot', 'right_foot'), spatial=True)
    environment = suite.build(spec, terrain='hills3d', task='walk')

MuJoCo reads the file, in a process of its own with limited time and memory. Frames are MuJoCo's:
the character faces +x, z points up. The masses, joint limits, position actuators and
torque limits of the file are kept; missing values are chosen as follows:

* the torque limit of a joint is the torque of the whole character's weight at the farthest end of
  the links that the joint carries; the force limit of a slide is twice that weight;
* kp yields that torque at an error of 1 rad (for a slide, at a tenth of its range), kd is a tenth
  of kp, and the armature 0.01 kg m^2 per 300 N m/rad, as for the shipped characters;
* the working posture of a joint is its angle in the first key frame, or else 0, moved into its
  limits.

`spec.notes` lists these assumptions, and the actuators that were left out: those that act on a
tendon, a site or a body, because every joint gets its own actuator. The passive damping of joints
is added to kd, which torque control does not use (see `trl_suite.actuation`); friction, springs, equalities and tendons are kept, and the
`solreflimit` of joint limits, if it is not MuJoCo's default: it describes the robot's stops, and MuJoCo
keeps a time constant stable at any time step. Limits without it are as stiff as the time step permits.
Sensors, lights, everything outside the character, and tendons and equalities with it are removed.
"""

from __future__ import annotations

import dataclasses
import os
import pathlib
from collections.abc import Collection, Mapping, Sequence

import mujoco
import numpy as np
from dm_control import composer, mjcf

from trl_suite.characters import model_file
from trl_suite.characters.character import Character, CharacterSpec, Joint
from trl_suite.characters.inspect import KINDS, ModelInspector
from trl_suite.characters.model_file import (
    check_numbers,
    compiled,
    find_root,
    flat,
    named,
    turned,
)
from trl_suite.characters.specs import CHARACTERS
from trl_suite.engine import GRAVITY, native
from trl_suite.motion import quaternion
from trl_suite.util import errors, limited
from trl_suite.util.files import check_size, existing
from trl_suite.util.options import checked

Names = Collection[str] | None
SUFFIXES = ('.xml', '.mjcf', '.urdf')
COLOUR = (0.27, 0.42, 0.62, 1)  # red, green, blue, opacity
SOFT = (0.02, 1.0)  # MuJoCo's default for joint limits: not the choice of the file's author
CAMERA_AWAY = 3.2  # distance of cameras, in reaches of the character

_CAMERAS = {  # position in units of the distance, and the axes of the picture
    'side': ((0.15, -1, 0.09), (1, 0, 0, 0, 0.09, 1)),
    'front': ((0.85, -0.53, 0.2), (0.53, 0.85, 0, -0.17, 0.11, 1)),
    'back': ((-1, 0, 0.27), (0, -1, 0, 0.27, 0, 1)),
    'above': ((0, -1.7, 3.8), (1, 0, 0, 0, 0.91, 0.41)),
}


def from_file(
    path: str | os.PathLike[str],
    *,
    end_effectors: Sequence[str] | None = None,
    fall_links: Sequence[str] | None = None,
    root: str | None = None,
    spatial: bool | None = None,
    turn: Sequence[float] | None = None,
    joints: Mapping[str, Joint] | None = None,
    stumble_exempt: Sequence[str] | None = None,
    balance_inertia: bool = False,
    name: str | None = None,
    description: str = "A user's own character.",
) -> CharacterSpec:
    """Reads a character, for `suite.build`, `characters.make` and others that take a CharacterSpec.

    Links are all bodies with mass, in the order of the file; joints keep their names.

    Args:
      path: MJCF (.xml, .mjcf) or .urdf; meshes are read from the paths in the file, from file://
        addresses, and package:// addresses from the folders that contain the file. Visual geoms of a
        URDF file are discarded, as by MuJoCo. Meshes may be .stl, .obj, .ply, and with pycollada
        .dae, whose unit is applied and whose up axis is not.
      end_effectors: bodies whose positions imitation tracks and whose contacts are observed, e.g.
        feet; by default the last bodies of limbs that reach below the centre of mass.
      fall_links: bodies whose contact with the ground ends the episode, () for none; by default the
        first one with geoms that can touch it, and with limbs, if there is one.
      root: body that is the ancestor of all others, a child of the world; by default the only one
        with joints below it.
      spatial: whether the character moves in three dimensions, instead of in the x-z plane; by
        default derived from the root's joints: a free joint, or two slides and a hinge.
      turn: rotation, as a quaternion wxyz, that makes the character face +x with z up; by default
        none. (0.7071, 0.7071, 0, 0) is for a character whose y axis points up.
      joints: parameters of joints by name, which replace those derived from the file.
      stumble_exempt: bodies that may touch the ground without a stumble; by default the end
        effectors.
      balance_inertia: whether to replace moments of inertia that no body has by their mean: one is
        larger than the sum of the others, or not positive; by default they are an error.
      name: name of the character; by default the file's.
      description: one line.

    Raises:
      FileNotFoundError: there is no such file; the message has similar names.
      ValueError: the file or an argument is invalid; the message names the problem, the expected
        value, and the closest matches of an unknown name.
      TypeError: parameters of a joint that are not a `Joint`.
    """
    checked('root', root, str | None)
    checked('spatial', spatial, bool | None)
    checked('name', name, str | None)
    checked('description', description, str)
    checked('balance_inertia', balance_inertia, bool)
    names = [
        checked('end_effectors', end_effectors, Names),
        checked('fall_links', fall_links, Names),
        checked('stumble_exempt', stumble_exempt, Names),
    ]
    for given in names:
        if len(set(given or ())) < len(given or ()):
            raise ValueError(f'{", ".join(given or ())}: expected names without repeats')
    if names[0] == ():
        raise ValueError(f'end_effectors is {end_effectors!r}; expected one name or more')
    if name == '':
        raise ValueError("name is ''; expected a name, or None for that of the file")
    if joints is not None and not isinstance(joints, Mapping):
        raise TypeError(f'joints is {joints!r}; expected a dict of characters.Joint by name')
    rotation = None if turn is None else _rotation(turn)
    file = existing(path, SUFFIXES)
    name = file.stem if name is None else name
    if '/' in name:
        raise ValueError(f"name is {name!r}; expected a name without '/'")
    if name in CHARACTERS:
        raise ValueError(f'the suite has a character named {name!r}; pass another name=')
    file.open('rb').close()  # raises an OSError if it cannot be read
    with errors.naming(file):
        about = name, description, root, spatial, rotation, balance_inertia
        spec = limited.call(_read, os.path.abspath(file), *about, *names)
        errors.check_known('joint', spec.joints, *joints or {})
    for joint, own in (joints or {}).items():
        if not isinstance(own, Joint):
            raise TypeError(f'joints[{joint!r}] is {own!r}; expected a characters.Joint')
    return dataclasses.replace(spec, joints={**spec.joints, **(joints or {})})


def _read(
    path: str,
    name: str,
    description: str,
    root: str | None,
    spatial: bool | None,
    rotation: np.ndarray | None,
    balance: bool,
    end_effectors: tuple[str, ...] | None,
    fall_links: tuple[str, ...] | None,
    exempt: tuple[str, ...] | None,
) -> CharacterSpec:
    """Reads a file in a process of its own; arguments are those of `from_file`."""
    file = pathlib.Path(path)
    check_numbers(file)
    spec = named(file)
    if balance:
        model_file.balance_inertia(spec)
    model = compiled(spec)
    number = find_root(model, root)
    own_turn = model.body_quat[number]
    is_turned = abs(own_turn[0]) < 1 - 1e-6
    if is_turned or rotation is not None:
        whole = own_turn if rotation is None else quaternion.multiply(rotation, own_turn)
        model = turned(spec, model.body(number).name, whole)
    found = ModelInspector(model, number, spatial)
    if is_turned:
        found.notes.append(
            f'the root is rotated in the file by {own_turn.round(3).tolist()}; its axes are now those of '
            'the world'
        )
    lowest, first = found.limbs()
    end_effectors = end_effectors or lowest
    if fall_links is None and not first:
        found.notes.append('no fall links: no body above the ends of limbs can touch the ground')
    fall_links = first if fall_links is None else fall_links
    exempt = end_effectors if exempt is None else exempt
    found.check_names('end effector', end_effectors)
    found.check_posture(end_effectors)
    found.check_names('fall link', fall_links, solid=True)
    found.check_names('stumble-exempt link', exempt)
    figures = found.figures()
    if left_out := found.left_out():
        found.notes.append(
            f'actuators that are left out, {len(left_out)} of {model.nu}, because they do not act on a '
            f'joint of the character: {", ".join(left_out)}'
        )
    tree = _tree(file, spec, found)
    tree.model = name
    made = CharacterSpec(
        name=name,
        joints=figures,
        fall_links=fall_links,
        end_effectors=end_effectors,
        stumble_exempt=exempt,
        description=description,
        spatial=found.spatial,
        xml=tree.to_xml_string(),
        assets=tree.get_assets(),
        bodies=found.links,
        collision_geoms=found.collision_geoms,
        notes=tuple(found.notes),
    )
    check_size(path, size=sum(map(len, (made.xml or '', *made.assets.values()))))
    _check_physics(made)
    return made


def _check_physics(spec: CharacterSpec) -> None:
    """Raises an error if a character in an arena cannot be compiled or simulated."""
    character, arena = Character(spec), composer.Arena()
    character.create_root_joints(arena.attach(character))
    try:
        physics = mjcf.Physics.from_mjcf_model(arena.mjcf_model)
    except ValueError as error:  # it begins with a hint to debug dm_control
        raise ValueError(str(error).partition('information.')[2] or str(error)) from None
    model, data = physics.model.ptr, physics.data.ptr
    mujoco.mj_step(model, data)
    for name in dir(model):
        value = getattr(model, name)
        if isinstance(value, np.ndarray) and not np.isfinite(value).all():
            raise ValueError(f'{name} has a value that is not finite; expected smaller numbers')
    if data.warning.number[slice(*native.BAD)].any():
        raise ValueError('its simulation diverges in the first step; expected a stable one')


def _rotation(turn: Sequence[float]) -> np.ndarray:
    """Returns a unit quaternion."""
    found = errors.floats('turn, a quaternion wxyz', turn, (4,))
    length = np.linalg.norm(found)
    if not 0 < length < np.inf:
        raise ValueError(
            f'turn is {turn!r}; expected a quaternion wxyz, such as (0.7071, 0.7071, 0, 0)'
        )
    return found / length


def _tree(file: pathlib.Path, spec: mujoco.MjSpec, found: ModelInspector) -> mjcf.RootElement:
    """Returns the character alone: no world, root joints, actuators, options; explicit values."""
    model = found.model
    tree = mjcf.from_xml_string(flat(spec.to_xml()), model_dir=str(file.parent))
    root = tree.find('body', found.bodies[0])
    outside = [child for child in tree.worldbody.all_children() if child is not root]
    joints = [child for child in root.all_children() if child.tag in ('joint', 'freejoint')]
    excluded = [
        item
        for item in tree.contact.all_children()
        if item.tag == 'exclude'
        and not {getattr(body, 'name', body) for body in (item.body1, item.body2)}
        <= {*found.bodies}
    ]
    ties = _ties(tree, root, joints)
    own = {geom.name for geom in root.find_all('geom')}
    for item in tree.contact.pair:
        if not {item.geom1.name, item.geom2.name} <= own:
            excluded.append(item)
            found.notes.append(
                f'the pair of {item.geom1.name!r} and {item.geom2.name!r} is left out: one is beside the character'
            )
    found.notes += [
        f'{item.tag} {item.name!r} is left out: it ties the character to something else'
        for item in ties
    ]
    gravity = np.array(spec.option.gravity)
    if abs(gravity - np.array((0, 0, -GRAVITY))).max() > 0.1:
        found.notes.append(
            f'gravity of the file, {gravity.tolist()}, is left out: it is {GRAVITY} m/s^2 downwards; the task '
            "option randomize={'gravity': ...} sets another one"
        )
    moving = [
        body.name or '?'
        for body in outside
        if body.tag == 'body' and (body.find_all('joint') or getattr(body, 'freejoint', None))
    ]
    if moving:
        found.notes.append(f'bodies beside the character are left out: {", ".join(moving)}')
    lists = [*tree.actuator.all_children(), *tree.sensor.all_children()]
    lists += [*tree.keyframe.all_children(), *excluded]
    grounds = [item for item in tree.asset.texture if item.type == 'skybox']
    grounds += tree.asset.hfield
    for element in (*lists, *ties, *joints, *outside, *grounds):
        element.remove()
    for element in (tree.option, tree.size, tree.visual, tree.statistic):
        element.remove()
    for attribute in tree.compiler.get_attributes():
        if attribute != 'angle':
            delattr(tree.compiler, attribute)
    if tree.default.dclass is None:
        tree.default.dclass = 'own'  # MJCF without this name could not be read back
    root.pos, root.quat = (0, 0, 0), None
    for i, name in zip(found.ids, found.bodies, strict=True):
        # As compiled with the file's options, by which a body with geoms may have no mass.
        body = tree.find('body', name)
        if body.inertial is not None:
            body.inertial.remove()
        place = {'pos': model.body_ipos[i], 'quat': model.body_iquat[i]}
        mass, inertia = model.body_mass[i], model.body_inertia[i]
        body.add('inertial', mass=mass, diaginertia=inertia, **place)
    for i in found.joints:
        name = model.joint(i).name
        joint = tree.find('joint', name)
        limited = bool(model.jnt_limited[i])
        joint.type, joint.limited = KINDS[int(model.jnt_type[i])], limited
        joint.pos = model.jnt_pos[i]
        joint.axis = model.jnt_axis[i]
        joint.range = model.jnt_range[i] if limited else None
        stiffness = model.jnt_solref[i]
        joint.solreflimit = None if (stiffness == SOFT).all() else stiffness
        joint.actuatorfrclimited = True
        joint.actuatorfrcrange = (-found.limits[name], found.limits[name])
    for i in found.geoms:
        geom = tree.find('geom', model.geom(i).name)
        # The first bit is the ground's. The file's masks move up by one, so that two geoms of the
        # character collide exactly if they do in the file.
        geom.contype = int(model.geom_contype[i]) << 1
        geom.conaffinity = int(model.geom_conaffinity[i]) << 1 | 1
        if file.suffix.lower() == '.urdf':
            geom.rgba = COLOUR  # visual geoms, which have colours, were discarded
    _stage(tree, root, found.reach(found.data.xpos[found.root], found.root))
    return tree


def _ties(
    tree: mjcf.RootElement, root: mjcf.Element, joints: list[mjcf.Element]
) -> list[mjcf.Element]:
    """Returns tendons and equalities with the world, the root's joints, or bodies beside the root."""
    kinds = ('body', 'geom', 'site', 'joint')
    own = [root, *(each for kind in kinds for each in root.find_all(kind) if each not in joints)]
    known, ties = {(each.tag, each.name) for each in own}, []
    for item in (*tree.tendon.all_children(), *tree.equality.all_children()):
        ends = [
            (end.tag, end.name)
            for part in (item, *item.all_children())
            for end in part.get_attributes().values()
            if isinstance(end, mjcf.Element) and end.tag not in ('default', 'material')
        ]
        if not known.issuperset(ends) or (item.tag in ('connect', 'weld') and len(ends) < 2):
            ties.append(item)
        else:
            known.add((item.tag, item.name))  # an equality may refer to a tendon
    return ties


def _stage(tree: mjcf.RootElement, root: mjcf.Element, reach: float) -> None:
    """Replaces the lights of the file, and its cameras with the names of the suite's cameras."""
    away = CAMERA_AWAY * reach
    for item in (*tree.find_all('light'), *tree.find_all('camera')):
        if item.tag == 'light' or item.name in _CAMERAS:
            item.remove()
    for name, (place, axes) in _CAMERAS.items():
        root.add(
            'camera', name=name, mode='trackcom', pos=away * np.array(place), xyaxes=axes, fovy=45
        )
    light = {'diffuse': (0.5, 0.5, 0.48), 'specular': (0.1,) * 3, 'castshadow': True}
    sun = {'pos': (-1.2, 1.2, 4), 'dir': (0.3, -0.3, -1), 'directional': True}
    root.add('light', name='sun', mode='trackcom', **sun, **light)
