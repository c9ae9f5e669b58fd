"""Four actuation models: torque, velocity, position, and muscle where a character has muscles.

Each adds actuators to a character's MJCF and returns an `ActionMap`: the affine map from the
agent's action in [-1, 1] to physical units. No model lets a joint exceed the torque limit of the
character's MJCF (`actuatorfrcrange`).

The servos have the original's gains, with additions for stability: every actuated joint gets an
armature, a joint limit with a time constant of two physics steps, and some passive damping. A
servo's damping is split: if all of it were inside the force clamp, the joint would chatter; if all
of it were outside, the speed of the joint would be too low for a bound.

For a prismatic joint, read m for rad, N for N m and kg for kg m^2. A spherical joint has three
actions, about the x (forward), y (left) and z (up) axes of its link in the zero pose; a limb swings
forward by a rotation about -y. Its torque limit bounds the norm of the three torques; velocity
servos, which MuJoCo clamps axis by axis, get that limit / sqrt(3) about each axis.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from dm_control import mjcf

from trl_suite.actuation.action_map import AXIS_OFFSET, ActionMap
from trl_suite.actuation.muscles import MUSCLES, PLAIN, Muscle, constant_arm, mujoco_parameters
from trl_suite.characters.character import Character
from trl_suite.util import errors
from trl_suite.util.options import checked

DAMPING_DIVISOR = 50.0  # passive damping of torque and position joints: torque limit / this, in s
MUSCLE_DAMPING_DIVISOR = 100.0  # less damping, as the force-velocity curve also damps
TORQUE_SCALE = 0.75  # of the limit at action 1
FORCE_SCALE = 1.0  # the same for a prismatic joint
VELOCITY_SCALE = 10 * np.pi  # rad/s at action 1
SLIDE_VELOCITY_SCALE = 10.0  # m/s at action 1, where the resting hopper's leg has its force limit
POSITION_SCALE = 1.5  # rad at action 1; for a prismatic joint half its range
ORIGINAL_SPAN = 2.0  # ranges of a joint; largest distance of the original's position targets
ROTATIONS = ('vector', 'angle_axis')  # how position actions describe the rotation of a ball joint
EXCITATION_OFFSET, EXCITATION_SCALE = 0.505, 0.495  # [0.01, 1]


def _prepare(
    character: Character, timestep: float, damping: np.ndarray, least: np.ndarray | None = None
) -> None:
    """Sets every joint's armature, at least `least` (J,), its damping (J,) and a stiff limit.

    A joint keeps the `solreflimit` of its MJCF.
    """
    armature = np.array([joint.armature for joint in character.spec.joints.values()])
    armature = armature if least is None else np.maximum(armature, least)
    for joint, inertia, value in zip(character.joints, armature, damping, strict=True):
        joint.armature = inertia
        joint.damping = value
        if joint.solreflimit is None:
            joint.solreflimit = (2 * timestep, 1)


def _spread(character: Character, per_joint: np.ndarray) -> np.ndarray:
    """Repeats values per joint (J, ...) for every degree of freedom, (D, ...)."""
    return np.repeat(per_joint, character.dofs, axis=0)


def _by_type(character: Character, revolute: float, prismatic: float) -> np.ndarray:
    """Returns one of two values for each degree of freedom, shape (D,)."""
    return _spread(character, np.where(character.prismatic, prismatic, revolute))


def _unit(character: Character, revolute: str, prismatic: str) -> str:
    """Returns the unit of controls of joints."""
    slides = np.array(list(character.spec.joints))[character.prismatic]
    return f'{revolute} ({", ".join(slides)}: {prismatic})' if len(slides) else revolute


def _split(character: Character, parts: Sequence[str]) -> tuple[str, ...]:
    """Returns names of actions: those of joints, for ball joints one for each of `parts`."""
    return tuple(
        f'{name}_{part}' if ball else name
        for name, ball in zip(character.spec.joints, character.spherical, strict=True)
        for part in (parts if ball else ('',))
    )


def _balls(character: Character, size: int) -> np.ndarray:
    """Returns the first index of each ball joint if it takes `size` numbers, shape (B,)."""
    ball = character.spherical
    sizes = np.where(ball, size, 1)
    return (np.cumsum(sizes) - sizes)[ball]


def _vectors(character: Character) -> np.ndarray:
    """Returns the indices of the degrees of freedom of each ball joint, shape (B, 3)."""
    return _balls(character, 3)[:, None] + np.arange(3)


def _dofs(character: Character) -> Iterator[tuple[str, mjcf.Element, dict[str, Any]]]:
    """Yields name and joint of every degree of freedom, and options of its actuator."""
    for name, joint, ball in zip(
        character.spec.joints, character.joints, character.spherical, strict=True
    ):
        if ball:
            for axis, gear in zip('xyz', np.eye(3), strict=True):
                yield f'{name}_{axis}', joint, {'gear': gear}
        else:
            yield name, joint, {}


def original_ranges(character: Character) -> np.ndarray:
    """Limits by which the original scales position actions, rad or m, shape (J, 2).

    For a ball joint they are the extremes over its three axes.
    """
    ranges = character.joint_ranges
    ranges[character.spherical, 0] = -ranges[character.spherical, 1]
    for i, joint in enumerate(character.spec.joints.values()):
        if joint.original_range is not None:
            ranges[i] = joint.original_range
    free = ~np.isfinite(ranges).all(1)
    return np.where(free[:, None], (-np.pi, np.pi), ranges)


def _add_torque(character: Character, timestep: float) -> ActionMap:
    limits = character.torque_limits
    _prepare(character, timestep, limits / DAMPING_DIVISOR)
    each = _spread(character, limits)
    for (name, joint, options), limit in zip(_dofs(character), each, strict=True):
        character.mjcf_model.actuator.add(
            'motor', name=name, joint=joint, ctrllimited=True, ctrlrange=(-limit, limit), **options
        )
    names = _split(character, 'xyz')
    scale = _by_type(character, TORQUE_SCALE, FORCE_SCALE)
    unit = _unit(character, 'N m', 'N')
    balls = {'torque_balls': _vectors(character), 'torque_limits': limits[character.spherical]}
    return ActionMap(names, 'torque', unit, np.zeros(len(names)), scale * each, names, balls)


def _add_velocity(character: Character, timestep: float) -> ActionMap:
    limits, ball = character.torque_limits, character.spherical
    kd = np.array([joint.kd for joint in character.spec.joints.values()])
    passive, least, clamps = np.zeros(len(limits)), None, limits
    if ball.any():
        # Without passive damping, limbs on ball joints spin up. The actuator compensates for the
        # passive damping: below the clamp the control law is that of a servo with the whole kd.
        passive = np.minimum(limits / DAMPING_DIVISOR, kd)
        # With a clamp for every axis, thin limbs would oscillate: a force that changes sign at
        # every step sustains itself unless 2 * inertia > gain * timestep.
        least = (kd - passive) * timestep / 2
        clamps = np.where(ball, limits / np.sqrt(3), limits)
    _prepare(character, timestep, passive, least)
    figures = (_spread(character, each) for each in (clamps, kd, kd - passive))
    for (name, joint, options), limit, gain, damping in zip(
        _dofs(character), *figures, strict=True
    ):
        options |= {'gaintype': 'fixed', 'gainprm': (gain,)}
        options |= {'biastype': 'affine', 'biasprm': (0, 0, -damping), 'ctrllimited': False}
        options |= {'forcelimited': True, 'forcerange': (-limit, limit)}
        character.mjcf_model.actuator.add('general', name=name, joint=joint, **options)
    names = _split(character, 'xyz')
    unit, offset = _unit(character, 'rad/s', 'm/s'), np.zeros(len(names))
    scale = _by_type(character, VELOCITY_SCALE, SLIDE_VELOCITY_SCALE)
    return ActionMap(names, 'target velocity', unit, offset, scale, names)


def _add_position(
    character: Character,
    timestep: float,
    action_offset: Sequence[float] | np.ndarray | None = None,
    action_scale: float | Sequence[float] | np.ndarray | None = None,
    rotations: str = 'vector',
) -> ActionMap:
    errors.check_known('description of rotations', ROTATIONS, rotations)
    if rotations == 'angle_axis':
        if action_offset is not None or action_scale is not None:
            raise ValueError(
                "rotations='angle_axis' has the original's scaling; do not pass action_offset or "
                'action_scale'
            )
        action_map = _angle_axis(character)
    else:
        action_map = _position_map(character, action_offset, action_scale)
    limits = character.torque_limits
    joints = list(character.spec.joints.values())
    kd = np.array([joint.kd for joint in joints])
    passive = np.minimum(limits / DAMPING_DIVISOR, kd)
    _prepare(character, timestep, passive)
    add, elements, balls = character.mjcf_model.actuator.add, character.joints, character.spherical
    for (name, joint), element, limit, servo, ball in zip(
        character.spec.joints.items(), elements, limits, kd - passive, balls, strict=True
    ):
        common = {'name': name, 'joint': element, 'kp': joint.kp, 'kv': servo, 'forcelimited': True}
        if ball:
            # Its control is a rotation vector, its force range bounds a norm. At the clamp, the
            # last bit of the norm decides whether MuJoCo 3.17 keeps the implicit damping of a step.
            add('orientation', forcerange=(0, limit), **common)
        else:
            add('position', ctrllimited=False, forcerange=(-limit, limit), **common)
    return action_map


def _position_map(character: Character, action_offset: Any, action_scale: Any) -> ActionMap:
    """Returns the map of actions to target angles, and to rotation vectors of ball joints."""
    joints, names = list(character.spec.joints.values()), _split(character, 'xyz')
    if action_offset is None:
        targets = [
            np.broadcast_to(j.target, n) for j, n in zip(joints, character.dofs, strict=True)
        ]
        middle = np.concatenate(targets).astype(float)
    else:
        middle = errors.floats('action_offset', action_offset).copy()
    if action_scale is None:
        slide = np.ptp(character.joint_ranges, axis=1) / 2
        # Joints with a small range get the original's scale.
        original = ORIGINAL_SPAN * np.ptp(original_ranges(character), axis=1)
        turn = np.minimum(POSITION_SCALE, original)
        action_scale = _spread(character, np.where(character.prismatic, slide, turn))
    scale = errors.floats(f'action_scale of {character.spec.name!r}', action_scale)
    if middle.shape != (len(names),) or scale.shape not in ((), (1,), (len(names),)):
        raise ValueError(
            f'position control of {character.spec.name!r}: action_offset has shape {middle.shape}, '
            f'action_scale {scale.shape}; expected ({len(names)},), and for action_scale also a number'
        )
    if not np.all(scale > 0):
        raise ValueError(
            f'position control of {character.spec.name!r}: action_scale is {scale}; expected positive numbers'
        )
    quantity = 'target rotation vector' if character.spherical.any() else 'target angle'
    unit = _unit(character, 'rad', 'm')
    reach = np.broadcast_to(scale, len(names)).copy()
    return ActionMap(names, quantity, unit, middle, reach, tuple(character.spec.joints))


def _angle_axis(character: Character) -> ActionMap:
    """Returns the original's map of position actions."""
    ranges, ball = original_ranges(character), character.spherical
    span = np.ptp(ranges, axis=1)
    span[~character.prismatic] *= ORIGINAL_SPAN
    span[character.prismatic] /= 2
    names = _split(character, ('angle', 'forward', 'up', 'right'))
    sizes = np.where(ball, 4, 1)
    angles = _balls(character, 4)
    action_offset = np.repeat(np.where(ball, 0, ranges.mean(1)), sizes)
    action_scale = np.repeat(span, sizes)
    action_offset[angles + 3] = AXIS_OFFSET
    action_scale[angles[:, None] + np.arange(1, 4)] = 1
    others = [np.cumsum(width)[~ball] - 1 for width in (sizes, character.dofs)]
    balls = {'angles': angles, 'angle_balls': _vectors(character), 'hinges': np.array(others)}
    quantity, unit = 'target angle and axis', _unit(character, 'rad and 1', 'm')
    actuators = tuple(character.spec.joints)
    return ActionMap(names, quantity, unit, action_offset, action_scale, actuators, balls)


def _add_muscle(character: Character, timestep: float, muscle_set: str = PLAIN) -> ActionMap:
    units = character_muscles(character, muscle_set)
    _prepare(character, timestep, character.torque_limits / MUSCLE_DAMPING_DIVISOR)
    joints = dict(zip(character.spec.joints, character.joints, strict=True))
    for unit in units:
        tendon = character.mjcf_model.tendon.add('fixed', name=unit.name)
        for arm in unit.arms:
            # In MuJoCo the moment is d length / d angle, and a muscle's force is negative.
            tendon.add('joint', joint=joints[arm.joint], coef=-constant_arm(arm))
        character.mjcf_model.actuator.add(
            'general', name=unit.name, tendon=tendon, **mujoco_parameters(unit)
        )
    names, count = tuple(unit.name for unit in units), len(units)
    offset, scale = np.full(count, EXCITATION_OFFSET), np.full(count, EXCITATION_SCALE)
    return ActionMap(names, 'excitation', '1', offset, scale, names)


_MODELS: dict[str, Callable[..., ActionMap]] = {
    'torque': _add_torque,
    'velocity': _add_velocity,
    'position': _add_position,
    'muscle': _add_muscle,
}
ACTUATIONS = tuple(_MODELS)


def character_muscles(character: Character, muscle_set: str = PLAIN) -> tuple[Muscle, ...]:
    """Returns a character's muscles: one of the sets of `trl_suite.actuation.muscles.MUSCLES`."""
    name = character.spec.name
    sets = MUSCLES.get(name)
    if sets is None:
        raise ValueError(f'character {name!r} has no muscles; these have: {", ".join(MUSCLES)}')
    errors.check_known(f'muscle set of {name!r}', sets, muscle_set)
    return sets[muscle_set]


def add(character: Character, model: str, timestep: float, **options: object) -> ActionMap:
    """Adds the actuators of one actuation model to a character.

    Args:
      character: a character without actuators.
      model: one of `ACTUATIONS`.
      timestep: physics time step, s; joint limits are as stiff as it allows.
      **options: for 'position', `action_offset` and `action_scale` of every degree of freedom,
        (D,), rad (m where prismatic); by default the working posture, and 1.5 rad, half the
        range of a prismatic joint, or twice the range of joints with a small range.
        `rotations`: description of a ball joint's rotation in actions: 'vector', a rotation vector,
        or 'angle_axis', an angle and an axis, scaled as in the original. For 'muscle',
        `muscle_set`: 'plain', or the name of a motion for which the muscles were optimised.

    Returns:
      The map from actions to controls, in the order of the actuators.

    Raises:
      ValueError: unknown model, a character without muscles, or invalid options.
    """
    errors.check_known('actuation', ACTUATIONS, model)
    checked('timestep', timestep, float, 's', above=0)
    known = [*inspect.signature(_MODELS[model]).parameters][2:]
    errors.check_known(f'option of {model} control', known, *options)
    return _MODELS[model](character, timestep, **options)
