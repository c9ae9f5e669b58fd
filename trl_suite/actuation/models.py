"""Four actuation models: torque, velocity, position, and muscle where a character has muscles.

Each adds actuators to a character's MJCF and returns an `ActionMap`: the affine map from the
agent's action in [-1, 1] to physical units. No model lets a joint exceed the torque limit of the
character's MJCF (`actuatorfrcrange`).

The servos follow the original's gains, with what explicit simulation needs added and documented:
every actuated joint gets an armature, a joint limit of two physics steps stiffness, and some
passive damping. All of a servo's damping inside its force clamp chatters, all of it outside caps
the joint's speed below what a bound needs, so it is split.

Where a joint is prismatic, read m for rad, N for N m and kg for kg m^2. A spherical joint has three
actions, about the x (forward), y (left) and z (up) axes of its link in the zero pose; a limb swings
forward by a rotation about -y. Its torque limit bounds the norm of the three torques; velocity
servos, which MuJoCo clamps axis by axis, get that limit / sqrt(3) about each.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from dm_control import mjcf

from trl_suite.actuation import hill
from trl_suite.actuation import muscles as muscle_tables
from trl_suite.actuation.action_map import AXIS_OFFSET, ActionMap, AngleAxisMap, TorqueMap
from trl_suite.actuation.muscles import Muscle
from trl_suite.characters.character import Character
from trl_suite.util import errors

DAMPING_DIVISOR = 50.0  # passive damping of torque and position joints: torque limit / this, in s
MUSCLE_DAMPING_DIVISOR = 100.0  # the force-velocity curve damps as well
TORQUE_SCALE = 0.75  # of the limit at full action
FORCE_SCALE = 1.0  # the same of a prismatic joint
VELOCITY_SCALE = 10 * np.pi  # rad/s at full action
SLIDE_VELOCITY_SCALE = 10.0  # m/s; at rest the hopper's leg then meets its force limit
POSITION_SCALE = 1.5  # rad at full action; of a prismatic joint half its range
ORIGINAL_SPAN = 2.0  # of the range of a joint; how far the original's position targets go at most
ROTATIONS = ('vector', 'angle_axis')  # how position actions describe the rotation of a ball joint
EXCITATION_OFFSET, EXCITATION_SCALE = 0.505, 0.495  # [0.01, 1]


def _prepare(
    character: Character, timestep: float, damping: np.ndarray, least: np.ndarray | None = None
) -> None:
    """Gives every joint its armature, at least `least` (J,), damping (J,) and a stiff limit."""
    armature = np.array([joint.armature for joint in character.spec.joints.values()])
    armature = armature if least is None else np.maximum(armature, least)
    for joint, inertia, value in zip(character.joints, armature, damping, strict=True):
        joint.armature = inertia
        joint.damping = value
        joint.solreflimit = (2 * timestep, 1)


def _spread(character: Character, per_joint: np.ndarray) -> np.ndarray:
    """Returns figures of joints (J, ...) for every degree of freedom, (D, ...)."""
    return np.repeat(per_joint, character.dofs, axis=0)


def _by_type(character: Character, revolute: float, prismatic: float) -> np.ndarray:
    """Returns one of two figures for each degree of freedom, shape (D,)."""
    return _spread(character, np.where(character.prismatic, prismatic, revolute))


def _unit(character: Character, revolute: str, prismatic: str) -> str:
    """Returns the unit of controls that drive joints."""
    slides = np.array(list(character.spec.joints))[character.prismatic]
    return f'{revolute} ({", ".join(slides)}: {prismatic})' if len(slides) else revolute


def _split(character: Character, parts: Sequence[str]) -> tuple[str, ...]:
    """Returns the names of the joints, each ball joint's once for every part of it."""
    return tuple(
        f'{name}_{part}' if ball else name
        for name, ball in zip(character.spec.joints, character.spherical, strict=True)
        for part in (parts if ball else ('',))
    )


def _balls(character: Character, size: int) -> np.ndarray:
    """Returns where ball joints begin if each takes `size` numbers, shape (B,)."""
    ball = character.spherical
    sizes = np.where(ball, size, 1)
    return (np.cumsum(sizes) - sizes)[ball]


def _dofs(character: Character) -> Iterator[tuple[str, mjcf.Element, dict[str, Any]]]:
    """Yields name and joint of every degree of freedom, and what its actuator needs to know."""
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

    Of a ball joint they are the extremes over its three axes.
    """
    ranges = character.joint_ranges
    ranges[character.spherical, 0] = -ranges[character.spherical, 1]
    for i, joint in enumerate(character.spec.joints.values()):
        if joint.original_range is not None:
            ranges[i] = joint.original_range
    free = ~np.isfinite(ranges).all(1)
    return np.where(free[:, None], (-np.pi, np.pi), ranges)


def _add_torque(character: Character, timestep: float, **_: object) -> ActionMap:
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
    affine = names, 'torque', unit, np.zeros(len(names)), scale * each, names
    ball = character.spherical
    if not ball.any():
        return ActionMap(*affine)
    balls = _balls(character, 3)[:, None] + np.arange(3)
    return TorqueMap(*affine, balls=balls, limits=limits[ball])


def _add_velocity(character: Character, timestep: float, **_: object) -> ActionMap:
    limits, ball = character.torque_limits, character.spherical
    kd = np.array([joint.kd for joint in character.spec.joints.values()])
    passive, least, clamps = np.zeros(len(limits)), None, limits
    if ball.any():
        # Limbs on ball joints spin up without passive damping. The drive makes up for its pull
        # towards rest: below the clamp the law is that of a servo with all of kd.
        passive = np.minimum(limits / DAMPING_DIVISOR, kd)
        # With a clamp for every axis thin limbs would shiver for good: a force that changes sign at
        # every step feeds itself unless 2 * inertia > gain * timestep.
        least = (kd - passive) * timestep / 2
        clamps = np.where(ball, limits / np.sqrt(3), limits)
    _prepare(character, timestep, passive, least)
    figures = (_spread(character, each) for each in (clamps, kd, kd - passive))
    for (name, joint, options), limit, gain, damping in zip(
        _dofs(character), *figures, strict=True
    ):
        character.mjcf_model.actuator.add(
            'general', name=name, joint=joint, gaintype='fixed', biastype='affine',
            gainprm=(gain,), biasprm=(0, 0, -damping), ctrllimited=False,
            forcelimited=True, forcerange=(-limit, limit), **options,
        )  # fmt: skip
    names = _split(character, 'xyz')
    return ActionMap(
        names, 'target velocity', _unit(character, 'rad/s', 'm/s'), np.zeros(len(names)),
        _by_type(character, VELOCITY_SCALE, SLIDE_VELOCITY_SCALE), names,
    )  # fmt: skip


def _add_position(
    character: Character,
    timestep: float,
    action_offset: Sequence[float] | np.ndarray | None = None,
    action_scale: float | Sequence[float] | np.ndarray | None = None,
    rotations: str = 'vector',
    **_: object,
) -> ActionMap:
    if rotations not in ROTATIONS:
        raise ValueError(errors.unknown('way to describe rotations', rotations, ROTATIONS))
    limits = character.torque_limits
    joints = list(character.spec.joints.values())
    kd = np.array([joint.kd for joint in joints])
    passive = np.minimum(limits / DAMPING_DIVISOR, kd)
    _prepare(character, timestep, passive)
    for name, joint, element, limit, servo, ball in zip(
        character.spec.joints, joints, character.joints, limits, kd - passive, character.spherical,
        strict=True,
    ):  # fmt: skip
        if ball:
            # Its control is a rotation vector, its force range bounds a norm. At the clamp MuJoCo
            # 3.17 drops or keeps the implicit damping of a step as the norm's last bit has it.
            character.mjcf_model.actuator.add(
                'orientation', name=name, joint=element, kp=joint.kp, kv=servo,
                forcelimited=True, forcerange=(0, limit),
            )  # fmt: skip
        else:
            character.mjcf_model.actuator.add(
                'position', name=name, joint=element, kp=joint.kp, kv=servo, ctrllimited=False,
                forcelimited=True, forcerange=(-limit, limit),
            )  # fmt: skip
    if rotations == 'angle_axis':
        if action_offset is not None or action_scale is not None:
            raise ValueError(
                'angles and axes are those of the original: no action_offset, no action_scale'
            )
        return _angle_axis(character)
    names = _split(character, 'xyz')
    if action_offset is None:
        middle = np.concatenate([
            np.broadcast_to(joint.target, size)
            for joint, size in zip(joints, character.dofs, strict=True)
        ]).astype(float)  # fmt: skip
    else:
        middle = np.array(action_offset)
    if action_scale is None:
        slide = np.ptp(character.joint_ranges, axis=1) / 2
        # Joints that hardly move get the original's reach.
        original = ORIGINAL_SPAN * np.ptp(original_ranges(character), axis=1)
        turn = np.minimum(POSITION_SCALE, original)
        action_scale = _spread(character, np.where(character.prismatic, slide, turn))
    reach = np.broadcast_to(np.asarray(action_scale, dtype=float), len(names)).copy()
    if middle.shape != (len(names),) or not (
        np.all(reach > 0) and np.all(np.isfinite([middle, reach]))
    ):
        raise ValueError(
            f'position control of {character.spec.name!r}: action_offset and action_scale must be finite, '
            f'positive in range, and broadcast to ({len(names)},)'
        )
    quantity = 'target rotation vector' if character.spherical.any() else 'target angle'
    unit = _unit(character, 'rad', 'm')
    return ActionMap(names, quantity, unit, middle, reach, tuple(character.spec.joints))


def _angle_axis(character: Character) -> AngleAxisMap:
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
    return AngleAxisMap(
        names, 'target angle and axis', _unit(character, 'rad and 1', 'm'), action_offset, action_scale,
        tuple(character.spec.joints), angles=angles,
        balls=_balls(character, 3)[:, None] + np.arange(3), hinges=np.array(others),
    )  # fmt: skip


def _add_muscle(
    character: Character, timestep: float, muscle_set: str = muscle_tables.PLAIN, **_: object
) -> ActionMap:
    units = character_muscles(character, muscle_set)
    _prepare(character, timestep, character.torque_limits / MUSCLE_DAMPING_DIVISOR)
    joints = dict(zip(character.spec.joints, character.joints, strict=True))
    for unit in units:
        tendon = character.mjcf_model.tendon.add('fixed', name=unit.name)
        for arm in unit.arms:
            # MuJoCo's moment is d length / d angle and a muscle's force is negative.
            tendon.add('joint', joint=joints[arm.joint], coef=-hill.constant_arm(arm))
        character.mjcf_model.actuator.add(
            'general', name=unit.name, tendon=tendon, ctrllimited=True,
            ctrlrange=(hill.MIN_ACTIVATION, 1), dyntype='none', gaintype='muscle',
            biastype='muscle', **hill.mujoco_parameters(unit),
        )  # fmt: skip
    return ActionMap(
        tuple(unit.name for unit in units), 'excitation', '1',
        np.full(len(units), EXCITATION_OFFSET), np.full(len(units), EXCITATION_SCALE),
        tuple(unit.name for unit in units),
    )  # fmt: skip


_MODELS: dict[str, Callable[..., ActionMap]] = {
    'torque': _add_torque,
    'velocity': _add_velocity,
    'position': _add_position,
    'muscle': _add_muscle,
}
ACTUATIONS = tuple(_MODELS)


def character_muscles(
    character: Character, muscle_set: str = muscle_tables.PLAIN
) -> tuple[Muscle, ...]:
    """Returns a character's muscles: one of the sets of `trl_suite.actuation.muscles.MUSCLES`.

    Raises:
      ValueError: the character has none, or no such set.
    """
    name = character.spec.name
    sets = muscle_tables.MUSCLES.get(name)
    if sets is None:
        raise ValueError(
            f'character {name!r} has no muscles; those who have: {", ".join(muscle_tables.MUSCLES)}'
        )
    if muscle_set not in sets:
        raise ValueError(errors.unknown(f'muscle set of {name!r}', muscle_set, sets))
    return sets[muscle_set]


def add(character: Character, model: str, timestep: float, **options: object) -> ActionMap:
    """Adds the actuators of one actuation model to a character.

    Args:
      character: a character without actuators.
      model: one of `ACTUATIONS`.
      timestep: physics time step, s; joint limits are as stiff as it allows.
      **options: for 'position', `action_offset` and `action_scale` of every degree of freedom, (D,), rad (m
        where prismatic); by default the working posture, and 1.5 rad, half the range of a prismatic
        joint, or for joints that hardly move twice their range. `rotations`: how actions describe
        the rotation of a ball joint: by a rotation vector, 'vector', or by an angle and an axis,
        'angle_axis', in the manner and range of the original. For 'muscle', `muscle_set`: 'plain',
        or the name of a motion that the muscles were optimised for.

    Returns:
      The map from actions to controls, in the order of the actuators.

    Raises:
      ValueError: unknown model, a character without muscles, or bad options.
    """
    if model not in _MODELS:
        raise ValueError(errors.unknown('actuation', model, ACTUATIONS))
    return _MODELS[model](character, timestep, **options)
