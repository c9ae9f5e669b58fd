"""Four actuation models: torque, velocity, position, and muscle where a character has muscles.

Each adds actuators to a character's MJCF and returns an `ActionMap`: the affine map from the
agent's action in [-1, 1] to physical units. No model lets a joint exceed the torque limit of the
character's MJCF (`actuatorfrcrange`).

The servos follow the original's gains, with what explicit simulation needs added and documented:
every actuated joint gets an armature, a joint limit of two physics steps stiffness, and some
passive damping. All of a servo's damping inside its force clamp chatters, all of it outside caps
the joint's speed below what a bound needs, so it is split.

Where a joint is prismatic, read m for rad, N for N m and kg for kg m^2.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence

import numpy as np

from trl_suite import errors, hill
from trl_suite.characters import muscles as muscle_tables
from trl_suite.characters.character import Character
from trl_suite.characters.muscles import Muscle

ARMATURE = 0.01  # kg m^2
DAMPING_DIVISOR = 50.0  # passive damping of torque and position joints: torque limit / this, in s
MUSCLE_DAMPING_DIVISOR = 100.0  # the force-velocity curve damps as well
TORQUE_SCALE = 0.75  # of the limit at full action
FORCE_SCALE = 1.0  # the same of a prismatic joint
VELOCITY_SCALE = 10 * np.pi  # rad/s at full action
SLIDE_VELOCITY_SCALE = 10.0  # m/s; at rest the hopper's leg then meets its force limit
POSITION_HALF_RANGE = 1.5  # rad at full action; of a prismatic joint half its range
EXCITATION_CENTRE, EXCITATION_HALF_RANGE = 0.505, 0.495  # [0.01, 1]


@dataclasses.dataclass(frozen=True)
class ActionMap:
    """The map from an action in [-1, 1] to control: centre + half_range * action.

    Attributes:
      names: what each action drives, shape (k,).
      quantity: what the controls are, e.g. 'target angle'.
      unit: physical unit of the controls; those of prismatic joints by name: 'rad (leg: m)'.
      centre: control at action 0, shape (k,).
      half_range: change of control per unit action, shape (k,).
    """

    names: tuple[str, ...]
    quantity: str
    unit: str
    centre: np.ndarray
    half_range: np.ndarray

    def __len__(self) -> int:
        return len(self.names)

    def control(self, action: np.ndarray) -> np.ndarray:
        """Maps actions (..., k), clipped to [-1, 1], to controls in physical units."""
        low, high, half_range, centre = self._rows
        control = np.maximum(action, low)  # packed rows: quicker than scalars
        np.minimum(control, high, out=control)
        control *= half_range
        control += centre
        return control if np.ndim(action) > 1 else control[0]

    @functools.cached_property
    def _rows(self) -> tuple[np.ndarray, ...]:
        ones = np.ones((1, len(self)))
        return -ones, ones, self.half_range[None], self.centre[None]

    def action(self, control: np.ndarray) -> np.ndarray:
        """Maps controls (..., k) to the actions that cause them; not clipped."""
        return (control - self.centre) / self.half_range


def _prepare(character: Character, timestep: float, damping: np.ndarray) -> None:
    """Gives every joint its armature, passive damping (J,) and a stiff limit."""
    for joint, value in zip(character.joints, damping, strict=True):
        joint.armature = ARMATURE
        joint.damping = value
        joint.solreflimit = (2 * timestep, 1)


def _by_type(character: Character, revolute: float, prismatic: float) -> np.ndarray:
    """Returns one of two figures for each joint, shape (J,)."""
    return np.where(character.prismatic, prismatic, revolute)


def _unit(character: Character, revolute: str, prismatic: str) -> str:
    """Returns the unit of controls that drive joints."""
    slides = np.array(list(character.row.joints))[character.prismatic]
    return f'{revolute} ({", ".join(slides)}: {prismatic})' if len(slides) else revolute


def _add_torque(character: Character, timestep: float, **_: object) -> ActionMap:
    limits = character.torque_limits
    _prepare(character, timestep, limits / DAMPING_DIVISOR)
    for name, joint, limit in zip(character.row.joints, character.joints, limits, strict=True):
        character.mjcf_model.actuator.add(
            'motor', name=name, joint=joint, ctrllimited=True, ctrlrange=(-limit, limit)
        )
    names = tuple(character.row.joints)
    scale = _by_type(character, TORQUE_SCALE, FORCE_SCALE)
    unit = _unit(character, 'N m', 'N')
    return ActionMap(names, 'torque', unit, np.zeros(len(limits)), scale * limits)


def _add_velocity(character: Character, timestep: float, **_: object) -> ActionMap:
    limits = character.torque_limits
    # A passive part would pull every joint towards rest instead of towards the target.
    _prepare(character, timestep, np.zeros(len(limits)))
    gains = [joint.kd for joint in character.row.joints.values()]
    for name, joint, limit, kd in zip(
        character.row.joints, character.joints, limits, gains, strict=True
    ):
        character.mjcf_model.actuator.add(
            'velocity', name=name, joint=joint, kv=kd, ctrllimited=False,
            forcelimited=True, forcerange=(-limit, limit),
        )  # fmt: skip
    names = tuple(character.row.joints)
    return ActionMap(
        names, 'target velocity', _unit(character, 'rad/s', 'm/s'), np.zeros(len(limits)),
        _by_type(character, VELOCITY_SCALE, SLIDE_VELOCITY_SCALE),
    )  # fmt: skip


def _add_position(
    character: Character,
    timestep: float,
    centre: Sequence[float] | np.ndarray | None = None,
    half_range: float | Sequence[float] | np.ndarray | None = None,
    **_: object,
) -> ActionMap:
    limits = character.torque_limits
    joints = list(character.row.joints.values())
    kd = np.array([joint.kd for joint in joints])
    passive = np.minimum(limits / DAMPING_DIVISOR, kd)
    _prepare(character, timestep, passive)
    for name, joint, element, limit, servo in zip(
        character.row.joints, joints, character.joints, limits, kd - passive, strict=True
    ):
        character.mjcf_model.actuator.add(
            'position', name=name, joint=element, kp=joint.kp, kv=servo, ctrllimited=False,
            forcelimited=True, forcerange=(-limit, limit),
        )  # fmt: skip
    middle = np.array([joint.target for joint in joints]) if centre is None else np.array(centre)
    if half_range is None:
        slide = np.ptp(character.joint_ranges, axis=1) / 2
        half_range = np.where(character.prismatic, slide, POSITION_HALF_RANGE)
    reach = np.broadcast_to(np.asarray(half_range, dtype=float), len(joints)).copy()
    if middle.shape != (len(joints),) or not (
        np.all(reach > 0) and np.all(np.isfinite([middle, reach]))
    ):
        raise ValueError(
            f'position control of {character.row.name!r}: centre and half_range must be finite, '
            f'positive in range, and broadcast to ({len(joints)},)'
        )
    unit = _unit(character, 'rad', 'm')
    return ActionMap(tuple(character.row.joints), 'target angle', unit, middle, reach)


def _add_muscle(character: Character, timestep: float, **_: object) -> ActionMap:
    units = character_muscles(character)
    _prepare(character, timestep, character.torque_limits / MUSCLE_DAMPING_DIVISOR)
    joints = dict(zip(character.row.joints, character.joints, strict=True))
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
        np.full(len(units), EXCITATION_CENTRE), np.full(len(units), EXCITATION_HALF_RANGE),
    )  # fmt: skip


_MODELS: dict[str, Callable[..., ActionMap]] = {
    'torque': _add_torque,
    'velocity': _add_velocity,
    'position': _add_position,
    'muscle': _add_muscle,
}
ACTUATIONS = tuple(_MODELS)


def character_muscles(character: Character) -> tuple[Muscle, ...]:
    """Returns a character's muscles.

    Raises:
      ValueError: the character has none.
    """
    try:
        return muscle_tables.MUSCLES[character.row.name]
    except KeyError:
        raise ValueError(
            f'character {character.row.name!r} has no muscles; '
            f'those who have: {", ".join(muscle_tables.MUSCLES)}'
        ) from None


def add(character: Character, model: str, timestep: float, **options: object) -> ActionMap:
    """Adds the actuators of one actuation model to a character.

    Args:
      character: a character without actuators.
      model: one of `ACTUATIONS`.
      timestep: physics time step, s; joint limits are as stiff as it allows.
      **options: for 'position', `centre` (J,) and `half_range`, rad (m where prismatic); by
        default the working posture, and 1.5 rad or half the range of a prismatic joint.

    Returns:
      The map from actions to controls, in the order of the actuators.

    Raises:
      ValueError: unknown model, a character without muscles, or bad options.
    """
    if model not in _MODELS:
        raise ValueError(errors.unknown('actuation', model, ACTUATIONS))
    return _MODELS[model](character, timestep, **options)
