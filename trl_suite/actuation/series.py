"""Free play and elasticity between the motor and the link of every joint.

The body of each link is divided: the joint, with its actuators, moves a body of the motor, on which the
link turns about the same axis by one or two further joints:

    parent - JOINT - JOINT_motor [- JOINT_play - JOINT_gear] - JOINT_flex or JOINT_play - link

The joint of the character is thus that of its motor, and its angle is what an encoder on the motor
measures: servos, rewards, clips and pose limits refer to it, and positions and velocities of links to the
links. A spring, JOINT_flex, has the stiffness (torque limit / flex); free play, JOINT_play, is a range
of the joint without any torque inside. Both begin an episode at 0.
"""

from __future__ import annotations

import dataclasses
import itertools
from xml.etree import ElementTree

import numpy as np
from dm_control import mjcf

from trl_suite.characters.character import Character, CharacterSpec
from trl_suite.util import files, resources

MOTOR_INERTIA = 0.01  # kg m^2, as the default armature of joints, which becomes that of the motor
GEAR_INERTIA = 1e-4  # kg m^2; of what turns between play and spring
MASS = 1e-5  # kg; of each additional body
PLAY, FLEX = '_play', '_flex'
_FRAME = ('pos', 'quat', 'axisangle', 'xyaxes', 'zaxis', 'euler', 'childclass')
_KEPT = ('type', 'axis', 'pos', 'class')  # attributes of a joint that the added ones share


def divided(spec: CharacterSpec, backlash: float, flex: float, damping: float) -> CharacterSpec:
    """Returns a character with free play and springs in every joint.

    Args:
      spec: the character.
      backlash: free play, rad; of a ball joint the largest angle of a cone's opening. 0 for none.
      flex: deflection of the springs at the torque limit, rad; 0 for no springs.
      damping: damping of the springs relative to their stiffness, s.
    """
    character = Character(spec)
    limits = dict(zip(spec.joints, character.torque_limits, strict=True))
    text = spec.xml
    if text is None:
        text = files.read_text(resources.directory('xml') / f'{spec.name}.xml')
    tree = ElementTree.fromstring(text)
    contact = tree.find('contact')
    if contact is None:
        contact = ElementTree.SubElement(tree, 'contact')
    for body in [*tree.iter('body')]:
        joints = [each for each in body.findall('joint') if each.get('name') in spec.joints]
        names = [each.get('name', '') for each in joints]
        if len(joints) > 1:
            raise ValueError(
                f'{"backlash" if backlash else "flex"} needs one joint for each link; {spec.name!r} has '
                f'the joints {", ".join(names)} on the same link'
            )
        if joints:
            _divide(body, joints[0], limits[names[0]], backlash, flex, damping)
    # Links on both sides of a joint, and what is fixed to them, do not collide, as without a motor.
    for joint in character.joints:
        link, above = joint.parent, joint.parent.parent
        if above.tag == 'body':
            for one, other in itertools.product(_fixed(above), _fixed(link)):
                ElementTree.SubElement(contact, 'exclude', body1=one.name, body2=other.name)
    changed = dataclasses.replace(spec, xml=ElementTree.tostring(tree, encoding='unicode'))
    vars(changed)['digest'] = spec.digest  # it is the same character for policies
    return changed


def _fixed(body: mjcf.Element) -> list[mjcf.Element]:
    """Returns the bodies that move with a body, itself included."""
    while not body.joint and body.parent.tag == 'body':
        body = body.parent
    found = [body]
    for each in found:  # also those that are added
        found += [child for child in each.body if not child.joint]
    return found


def _divide(
    body: ElementTree.Element,
    joint: ElementTree.Element,
    limit: float,
    backlash: float,
    flex: float,
    damping: float,
) -> None:
    """Moves everything but the joint to inner bodies, with joints of their own."""
    name = joint.get('name', '')
    link = ElementTree.Element(
        'body', {key: value for key, value in body.attrib.items() if key not in _FRAME}
    )
    for child in [*body]:
        if child is not joint:
            body.remove(child)
            link.append(child)
    for key in [*body.attrib]:
        if key not in _FRAME:
            del body.attrib[key]
    body.set('name', f'{name}_motor')
    _inertia(body)
    inner = body
    if backlash:
        ball = joint.get('type') == 'ball'
        low, high = (0.0, backlash / 2) if ball else (-backlash / 2, backlash / 2)
        gear = ElementTree.SubElement(body, 'body', name=f'{name}_gear') if flex else link
        armature = repr(GEAR_INERTIA) if flex else '0'
        _joint(gear, joint, PLAY, limited='true', range=f'{low!r} {high!r}', armature=armature)
        if flex:
            _inertia(gear)
            inner = gear
    if flex:
        stiffness = limit / flex
        passive = {'stiffness': repr(float(stiffness)), 'damping': repr(float(stiffness * damping))}
        _joint(link, joint, FLEX, limited='false', armature='0', **passive)
    inner.append(link)


def _inertia(body: ElementTree.Element) -> None:
    """Gives a body a negligible inertia; that of its joint is an armature."""
    tiny = ' '.join([repr(MASS)] * 3)
    ElementTree.SubElement(body, 'inertial', pos='0 0 0', mass=repr(MASS), diaginertia=tiny)


def _joint(
    body: ElementTree.Element, like: ElementTree.Element, suffix: str, **attributes: str
) -> None:
    """Adds a joint with the axis of another one, before the other elements of a body."""
    joint = ElementTree.Element(
        'joint', {key: like.attrib[key] for key in _KEPT if key in like.attrib}
    )
    joint.set('name', like.get('name', '') + suffix)
    passive = dict.fromkeys(('damping', 'stiffness', 'frictionloss', 'springref'), '0')
    for key, value in {**passive, 'actuatorfrclimited': 'false', **attributes}.items():
        joint.set(key, value)
    body.insert(0, joint)


def finish(character: Character, timestep: float) -> None:
    """Sets what depends on the time step, or what actuation models set in joints.

    Springs get the armature by which an implicit integration step would increase their inertia:
    damping * timestep + stiffness * timestep^2. MuJoCo integrates damping implicitly, but its
    constraint solver does not take that into account; without the armature, light links on the ground
    would be unstable.
    """
    find = character.mjcf_model.find
    for joint in character.joints:
        joint.armature = max(joint.armature or 0.0, MOTOR_INERTIA)
        play, spring = (find('joint', f'{joint.name}{suffix}') for suffix in (PLAY, FLEX))
        if play is not None:
            play.solreflimit = (2 * timestep, 1)
        if spring is not None:
            # These attributes are polynomials in MJCF.
            stiffness, damping = np.ravel(spring.stiffness)[0], np.ravel(spring.damping)[0]
            spring.armature = float(damping * timestep + stiffness * timestep**2)
