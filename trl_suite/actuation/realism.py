"""Actuators closer to reality: the options, and what the engine needs for them.

    suite.make(ID, task_kwargs={'actuators': {'torque_speed': True, 'delay': 20, 'strength': (0.8, 1.2)}})

Every task whose joints are driven takes the option. `trl_suite.engine.motors` has the formulas, and
`trl_suite.tasks.variation.motors` draws what changes between episodes.

Torques, gains and limits are those of the actuation model (see `trl_suite.actuation.models`). For a
prismatic joint read m for rad and N for N m.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np

from trl_suite.actuation import series
from trl_suite.characters.character import Character, CharacterSpec
from trl_suite.engine import motors
from trl_suite.util.options import Config, Range, option, within

NOISE_TIME = 0.02  # s; correlation time of the torque noise
LONGEST_DELAY = 1000.0  # ms
GAIT_DELAY = 2.0  # ms; with a longer delay of torques that are feedback, gaits are unstable
_AXES = ('_x', '_y', '_z')
_LATERAL = 1  # the y axis
_VELOCITY, _TENDONS = (
    'the force of a muscle depends on its velocity already',
    'muscles act on links by rigid tendons, which span several joints',
)
NOT_FOR_MUSCLES = {  # option -> the reason
    **dict.fromkeys(('torque_speed', 'no_load_speed', 'braking'), _VELOCITY),
    'torque_pose': 'the force of a muscle depends on its length already',
    'backlash': 'muscles pull on links without gears',
    **dict.fromkeys(('flex', 'flex_damping'), _TENDONS),
}
# Option -> the one that it modifies.
_REQUIRED = {'no_load_speed': 'torque_speed', 'braking': 'torque_speed', 'flex_damping': 'flex'}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Actuators(Config):
    """Options of actuators; with the defaults they are ideal."""

    torque_speed: bool = option(
        False,
        'torque limits depend on joint speed as those of a DC motor: limit * (1 - v / no_load_speed), at '
        "least 0 and at most limit * braking, where v is the speed in the torque's direction",
    )
    no_load_speed: float = option(
        20.0,
        'joint speed at which a motor can only brake; with torque_speed',
        unit='rad/s',
        at_least=1,
    )
    braking: float = option(
        1.5,
        'largest torque against the motion, in torque limits; with torque_speed',
        **within(1, 2),
    )
    torque_pose: Any = option(
        None,
        "factors of the torque limits by joint angle and direction: True for the character's own (bipeds: "
        "human legs), 'human', a JSON file, or a table of joint -> angle (rad), positive, negative",
    )
    delay: Range = option(
        Range(0.0, 0.0),
        'time until a control takes effect, rounded to physics steps; or two bounds, between which it is '
        'drawn for each episode',
        **within(0, LONGEST_DELAY, 'ms'),
    )
    backlash: float = option(
        0.0,
        'free play between motor and link of every joint; of a ball joint the opening angle of a cone',
        **within(0, 0.5, 'rad'),
    )
    flex: float = option(
        0.0,
        'deflection of a spring between motor and link of every joint at the torque limit; its stiffness '
        'is torque limit / flex',
        **within(0, 1, 'rad'),
    )
    flex_damping: float = option(
        0.005,
        'damping of these springs relative to their stiffness',
        **within(0, 1, 's'),
    )
    noise: float = option(
        0.0,
        'standard deviation of torque noise, in torque limits; an Ornstein-Uhlenbeck process for each '
        f'degree of freedom, with a correlation time of {NOISE_TIME:g} s',
        **within(0, 0.5),
    )
    strength: Range = option(
        Range(1.0, 1.0),
        'factor of all torques of a motor or muscle, gains and limits included; or two bounds, between '
        'which it is drawn for each motor and episode',
        above=0,
        at_most=2,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.torque_pose is False:
            self._set('torque_pose', None)
        for name, needed in _REQUIRED.items():
            if not getattr(self, needed) and name in self.changed:
                raise ValueError(f'{name} has no effect without {needed}; give both or none')


class Units:
    """The motors of a character's joints, or its muscles, in a compiled model.

    Attributes:
      names: joint or muscle of each, U of them.
      actuators: ids of the actuators of each.
      joints: id of the joint on which the actuators of a motor act.
      limits: torque limit of each joint, N m, for all J joints of the character.
      muscles: whether they are muscles.
      dofs: addresses in qvel of the joints that are driven, (D,), and the limit of each, (D,) N m.
    """

    def __init__(self, character: Character, model: mujoco.MjModel) -> None:
        """Finds the actuators."""
        scope, name = f'{character.mjcf_model.model}/', character.spec.name
        found = {model.actuator(i).name: i for i in range(model.nactuator)}
        tendons = int(mujoco.mjtTrn.mjTRN_TENDON)
        self.muscles = model.nactuator > 0 and bool((model.actuator_trntype == tendons).all())
        self.limits = character.torque_limits
        joints = [
            mujoco.mj_name2id(model, int(mujoco.mjtObj.mjOBJ_JOINT), scope + joint)
            for joint in character.spec.joints
        ]
        if self.muscles:
            self.names = tuple(actuator.removeprefix(scope) for actuator in found)
            self.actuators = [np.array([i]) for i in found.values()]
        else:
            self.names, self.actuators = tuple(character.spec.joints), []
            for joint in self.names:
                names = [scope + joint]
                if names[0] not in found:
                    names = [scope + joint + axis for axis in _AXES]
                if any(each not in found for each in names):
                    raise ValueError(
                        f'actuators: joint {joint!r} of {name!r} has no actuator of the actuation '
                        'models of the suite'
                    )
                self.actuators.append(np.array([found[each] for each in names]))
            joints = [int(model.actuator_trnid[each[0], 0]) for each in self.actuators]
        self.joints = np.array(joints)
        driven = np.ones(len(joints), bool)
        if self.muscles:
            driven = np.isin(
                self.joints, model.wrap_objid[model.wrap_type == mujoco.mjtWrap.mjWRAP_JOINT]
            )
        sizes = np.where(model.jnt_type[self.joints] == mujoco.mjtJoint.mjJNT_BALL, 3, 1)[driven]
        starts = zip(model.jnt_dofadr[self.joints[driven]].tolist(), sizes.tolist(), strict=True)
        self.dofs = np.array([dof for start, n in starts for dof in range(start, start + n)], int)
        self.dof_limits = np.repeat(self.limits[driven], sizes)


def body(actuators: Actuators, spec: CharacterSpec) -> CharacterSpec:
    """Returns the character with free play and springs in its joints, if there are any."""
    if not (actuators.backlash or actuators.flex):
        return spec
    return series.divided(spec, actuators.backlash, actuators.flex, actuators.flex_damping)


def limits(
    actuators: Actuators, units: Units, model: mujoco.MjModel, curves: Mapping[str, motors.Curves]
) -> motors.Limits:
    """Returns the limits of motors that depend on speed and pose."""
    if not (actuators.torque_speed or curves):
        return motors.Limits()
    axes: list[tuple[float, ...]] = []
    balls: list[tuple[float, ...]] = []
    rows: list[motors.Curves] = []
    for unit, (name, ids, joint, limit) in enumerate(
        zip(units.names, units.actuators, units.joints, units.limits, strict=True)
    ):
        qpos, dof, first = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint]), ids[0]
        ball, curve = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_BALL, -1
        if name in curves:
            angle, positive, negative = curves[name]
            if ball:  # the engine takes rotations about y, and tables have those about -y
                angle, positive, negative = -angle[::-1], negative[::-1], positive[::-1]
            curve = len(rows)
            rows.append(motors.Curves(angle, positive, negative))
        if not ball:
            axes.append((first, qpos, dof, limit, unit, curve, 1))
        elif len(ids) == 3 and model.actuator_biastype[first] != mujoco.mjtBias.mjBIAS_NONE:
            # Velocity servos, each with a limit of its own.
            each = model.actuator_forcerange[first, 1]
            for k in range(3):
                own = curve if k == _LATERAL else -1
                axes.append((ids[k], qpos, dof + k, each, unit, own, -1))
        else:
            output = model.actuator_outadr[first]
            balls.append((first, len(ids), output, qpos, dof, limit, unit, curve))
    found = motors.Limits(motors.table(motors.Axes, axes), motors.table(motors.Balls, balls))
    if rows:  # of one length: they repeat their last knots
        most = max(len(curve.angle) for curve in rows)
        columns = zip(*rows, strict=True)
        padded = ([np.pad(v, (0, most - len(v)), 'edge') for v in column] for column in columns)
        found = found._replace(curves=motors.Curves(*map(np.array, padded)))
    if actuators.torque_speed:
        found = found._replace(no_load=actuators.no_load_speed, braking=actuators.braking)
    return found


def noise(actuators: Actuators, units: Units, timestep: float) -> motors.Noise:
    """Returns the torque noise."""
    if not actuators.noise:
        return motors.Noise()
    deviation = actuators.noise * units.dof_limits
    return motors.Noise(units.dofs, deviation, float(np.exp(-timestep / NOISE_TIME)))


def check(actuators: Actuators, actuation: str) -> None:
    """Checks that the options suit an actuation model, or 'gait'."""
    for name, reason in NOT_FOR_MUSCLES.items():
        if actuation == 'muscle' and name in actuators.changed:
            raise ValueError(f'{name} is not an option of muscle control: {reason}')
    if actuation == 'gait' and actuators.delay.high > GAIT_DELAY:
        raise ValueError(
            f'delay is {actuators.delay.high:g}; expected at most {GAIT_DELAY:g} ms for a gait, whose '
            'torques are computed from the state 600 times a second: it is unstable if they are late'
        )
