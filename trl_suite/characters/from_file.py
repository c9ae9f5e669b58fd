"""A character of the user's, from an MJCF or URDF file.

    row = characters.from_file('walker.urdf', fall_links=('trunk',),
                               end_effectors=('left_foot', 'right_foot'), spatial=True)
    environment = suite.build(row, terrain='hills3d', task='walk')

MuJoCo reads the file. Frames are MuJoCo's: the character looks along +x, z points up. What the file
says about masses, limits, damping of joints, servos and torques is kept; where it is silent,

* the torque limit of a joint holds the weight of the whole character at the far end of what hangs
  on the joint; the force limit of a slide is twice that weight;
* kp asks for all of that torque at an error of 1 rad (of a slide, at a tenth of its range), and a
  servo damps by a tenth of kp, as in the suite's own characters; so is the armature, 0.01 kg m^2 per
  300 N m/rad;
* a joint works about its first key frame, or else its zero, if that is within its limits.

`row.notes` tells what of it was assumed. The passive damping of joints is added to kd (see
`trl_suite.actuation`); friction, springs, equalities and tendons stay; actuators, sensors and what
is not part of the character go.
"""

from __future__ import annotations

import os
import pathlib
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
from dm_control import mjcf

from trl_suite.characters.character import CharacterSpec, Joint
from trl_suite.characters.inspect import KINDS, ModelInspector, check_numbers, named, problem
from trl_suite.characters.specs import CHARACTERS
from trl_suite.util import errors
from trl_suite.util.files import existing

SUFFIXES = ('.xml', '.mjcf', '.urdf')
COLOUR = (0.27, 0.42, 0.62, 1)  # red, green, blue, opacity
CAMERA_AWAY = 3.2  # reaches of the character; how far off a camera stands

_CAMERAS = {  # place in reaches, and the axes of the picture
    'side': ((0.15, -1, 0.09), (1, 0, 0, 0, 0.09, 1)),
    'front': ((0.85, -0.53, 0.2), (0.53, 0.85, 0, -0.17, 0.11, 1)),
    'back': ((-1, 0, 0.27), (0, -1, 0, 0.27, 0, 1)),
    'above': ((0, -1.7, 3.8), (1, 0, 0, 0, 0.91, 0.41)),
}


def from_file(
    path: str | os.PathLike[str],
    *,
    end_effectors: Sequence[str],
    fall_links: Sequence[str],
    root: str | None = None,
    spatial: bool | None = None,
    joints: Mapping[str, Joint] | None = None,
    stumble_exempt: Sequence[str] | None = None,
    name: str | None = None,
    description: str = "A user's own character.",
) -> CharacterSpec:
    """Reads a character, for `suite.build`, `characters.make` and what else takes a row.

    Links are all bodies with mass, in the order of the file; joints keep their names.

    Args:
      path: MJCF (.xml, .mjcf) or .urdf; meshes lie where the file says, those of a package:// in a
        folder about the file. Of a URDF file what is only looked at is left out, as MuJoCo does.
      end_effectors: bodies whose frames imitation follows and whose contacts are seen, e.g. feet.
      fall_links: bodies whose contact with the ground ends the episode.
      root: body that carries all others, a child of the world; by default the only one there is.
      spatial: whether it is to move in three dimensions, instead of in the x-z plane; by default as
        the root's own joints say: a free joint, or two slides and a hinge.
      joints: figures of joints by name, in place of those found.
      stumble_exempt: bodies that may touch the ground without a stumble; by default the end effectors.
      name: of the character; by default the file's.
      description: one line.

    Raises:
      FileNotFoundError: there is no such file; the message has similar names.
      ValueError: the file, or a name, does not make a character; the message has what is wrong, what
        was expected, and the closest matches of an unknown name.
    """
    file = existing(path, SUFFIXES)
    check_numbers(file)
    name = file.stem if name is None else name
    if name in CHARACTERS or '/' in name:
        raise ValueError(f'a character may not be named {name!r}, as one of the suite; give name=')
    spec = named(file)
    try:
        model = spec.compile()
    except ValueError as error:
        raise problem(file, ' '.join(str(error).split())) from None
    found = ModelInspector(file, model, root, spatial)
    found.check_names('end effector', end_effectors)
    found.check_names('fall link', fall_links, solid=True)
    exempt = tuple(end_effectors if stumble_exempt is None else stumble_exempt)
    found.check_names('link exempt from stumbling', exempt)
    figures = found.figures()
    for joint in joints or {}:
        if joint not in figures:
            raise problem(file, errors.unknown('joint', joint, figures))
    tree = _tree(file, spec, found)
    tree.model = name
    return CharacterSpec(
        name=name,
        joints={**figures, **(joints or {})},
        fall_links=tuple(fall_links),
        end_effectors=tuple(end_effectors),
        stumble_exempt=exempt,
        description=description,
        path=str(file),
        spatial=found.spatial,
        xml=tree.to_xml_string(),
        assets=tree.get_assets(),
        bodies=found.links,
        collision_geoms=found.collision_geoms,
        notes=tuple(found.notes),
    )


def _tree(file: pathlib.Path, spec: mujoco.MjSpec, found: ModelInspector) -> mjcf.RootElement:
    """Returns the character alone: no world, root joints, actuators or options; figures explicit."""
    model = found.model
    try:
        tree = mjcf.from_xml_string(spec.to_xml(), model_dir=str(file.parent))
    except (ValueError, KeyError, AttributeError, OSError) as error:
        raise problem(file, f'cannot be taken over: {error}') from None
    root = tree.find('body', found.bodies[0])
    outside = [child for child in tree.worldbody.all_children() if child is not root]
    joints = [child for child in root.all_children() if child.tag in ('joint', 'freejoint')]
    excluded = [
        item
        for item in tree.contact.all_children()
        if item.tag == 'pair' or not {item.body1.name, item.body2.name} <= {*found.bodies}
    ]
    lists = [*tree.actuator.all_children(), *tree.sensor.all_children()]
    lists += [*tree.keyframe.all_children(), *excluded]
    grounds = [item for item in tree.asset.texture if item.type == 'skybox']
    grounds += tree.asset.hfield
    for element in (*lists, *joints, *outside, *grounds):
        element.remove()
    for element in (tree.option, tree.size, tree.visual, tree.statistic):
        element.remove()
    for attribute in tree.compiler.get_attributes():
        if attribute != 'angle':
            delattr(tree.compiler, attribute)
    if tree.default.dclass is None:
        tree.default.dclass = 'own'  # what is written could not be read without a name
    root.pos = (0, 0, 0)
    for i, name in zip(found.ids, found.bodies, strict=True):
        if model.body_mass[i] > 0:  # as compiled by the file's rules
            body = tree.find('body', name)
            if body.inertial is not None:
                body.inertial.remove()
            body.add(
                'inertial', mass=model.body_mass[i], diaginertia=model.body_inertia[i],
                pos=model.body_ipos[i], quat=model.body_iquat[i],
            )  # fmt: skip
    for i in found.joints:
        name = model.joint(i).name
        joint = tree.find('joint', name)
        limited = bool(model.jnt_limited[i])
        joint.type, joint.limited = KINDS[int(model.jnt_type[i])], limited
        joint.range = model.jnt_range[i] if limited else None
        joint.actuatorfrclimited = True
        joint.actuatorfrcrange = (-found.limits[name], found.limits[name])
    for i in found.geoms:
        geom = tree.find('geom', model.geom(i).name)
        geom.conaffinity = int(model.geom_conaffinity[i]) | 1  # the ground's contype is 1
        if file.suffix.lower() == '.urdf':
            geom.rgba = COLOUR  # what is only looked at, and has colours, was left out
    _stage(tree, root, found.reach(found.data.xpos[found.root], found.root))
    return tree


def _stage(tree: mjcf.RootElement, root: mjcf.Element, reach: float) -> None:
    """Adds the cameras that pictures ask for, and a light, unless the file has them."""
    away = CAMERA_AWAY * reach
    for name, (place, axes) in _CAMERAS.items():
        if tree.find('camera', name) is None:
            root.add('camera', name=name, mode='trackcom', pos=away * np.array(place), xyaxes=axes)
    if not tree.find_all('light'):
        root.add(
            'light', name='sun', mode='trackcom', pos=(-1.2, 1.2, 4), dir=(0.3, -0.3, -1),
            directional=True, castshadow=True, diffuse=(0.5, 0.5, 0.48), specular=(0.1,) * 3,
        )  # fmt: skip
