"""Imperfect motors: limits that depend on speed and pose, torque noise, and delayed controls.

All of these change between physics steps, so that compiled code writes them into MuJoCo's data and
model before each step; see `trl_suite.engine.native.step`. `trl_suite.actuation.realism` decides what
they are.

A motor's torque t, in the direction in which it acts, is at most

    limit * strength * pose factor * speed factor,

where the speed factor is that of a DC motor, 1 - v / no_load, clipped to [0, braking], and v is the
joint's velocity in the direction of the torque. For the motor of a ball joint, t is the norm of the
torque, v the component of the angular velocity along it, and the pose factor that of an ellipsoid:
1 / norm((t_x, t_y / f, t_z) / t), where f is the pose factor of a torque about the lateral axis y.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from trl_suite.util import random
from trl_suite.util.compiled import address, compiled, compiled_inline, floats_at

QPOS, QVEL, CTRL, APPLIED, FORCE, RANGE = range(6)  # columns of `Motors.fields`
UNLIMITED = 1e10  # N m


class Curves(NamedTuple):
    """Factors of torque limits by joint angle, for positive and negative torques, (curves, knots).

    Of a single curve, (knots,).
    Between the knots they are interpolated, beyond the ends constant.
    """

    angle: np.ndarray
    positive: np.ndarray
    negative: np.ndarray


class Axes(NamedTuple):
    """Motors about one axis whose limits depend on speed or pose, S of them.

    Attributes:
      actuator: id of the actuator.
      qpos, dof: addresses in qpos and in qvel: of the joint's position, and of the motor's own axis.
      limit: torque limit without these factors, N m.
      unit: index of the motor's strength.
      curve: index of the curve in `curves`; -1 for none.
      sign: +1 if the angle of the curve is qpos itself; -1 if it is the y component of the rotation
        vector of a ball joint.
    """

    actuator: np.ndarray
    qpos: np.ndarray
    dof: np.ndarray
    limit: np.ndarray
    unit: np.ndarray
    curve: np.ndarray
    sign: np.ndarray


class Balls(NamedTuple):
    """Motors of ball joints, the norm of whose torque is limited, B of them.

    Attributes:
      actuator: id of the first actuator.
      actuators: how many there are: one for the whole torque, or three, with consecutive ids.
      output: address of the torque in actuator_force.
      qpos, dof, limit, unit, curve: as of `Axes`; dof is the first of the joint.
    """

    actuator: np.ndarray
    actuators: np.ndarray
    output: np.ndarray
    qpos: np.ndarray
    dof: np.ndarray
    limit: np.ndarray
    unit: np.ndarray
    curve: np.ndarray


def table(kind: Any, rows: Sequence[tuple[float, ...]]) -> Any:
    """Returns `Axes` or `Balls` with an array for each column of some rows."""
    types = (float if name == 'limit' else int for name in kind._fields)
    return kind(*(np.array([row[k] for row in rows], type_) for k, type_ in enumerate(types)))


class Limits(NamedTuple):
    """Limits of motors that depend on speed or pose; by default none."""

    axes: Axes = table(Axes, [])
    balls: Balls = table(Balls, [])
    curves: Curves = Curves(*np.zeros((3, 0, 1)))
    no_load: float = math.inf
    braking: float = 1.0


class Noise(NamedTuple):
    """Torque noise: an Ornstein-Uhlenbeck process for each of D degrees of freedom; by default none.

    Attributes:
      dof: addresses in qvel, (D,).
      deviation: standard deviation, (D,) N m.
      decay: factor by which the process decays in a physics step.
    """

    dof: np.ndarray = np.zeros(0, int)
    deviation: np.ndarray = np.zeros(0)
    decay: float = 0.0


class MotorState(NamedTuple):
    """State of the motors, (n, ...): drawn per episode, or changed by physics steps.

    Attributes:
      strength: factor of the torques of each motor or muscle, (n, U).
      lag: delay of controls in physics steps, (n,).
      age: physics steps since the start of the episode, (n,).
      given: number of controls that were given since then, (n,).
      used: number of the control in use, (n,).
      times: age at which the latest controls were given, (n, K).
      controls: these controls, (n, K, nu); K = 0 without delay.
      noise: value of each noise process in standard deviations, (n, D).
      stream: random streams of the noise, (n, 6).
    """

    strength: np.ndarray
    lag: np.ndarray
    age: np.ndarray
    given: np.ndarray
    used: np.ndarray
    times: np.ndarray
    controls: np.ndarray
    noise: np.ndarray
    stream: np.ndarray


class Motors(NamedTuple):
    """Imperfect motors of n simulations.

    Attributes:
      fields: addresses of qpos, qvel, ctrl, qfrc_applied, actuator_force in the data of each
        simulation and of actuator_forcerange in its model, (n, 6).
    """

    fields: np.ndarray
    limits: Limits
    noise: Noise
    state: MotorState


def motors(
    models: list[mujoco.MjModel],
    data: list[mujoco.MjData],
    limits: Limits,
    noise: Noise,
    units: int,
    slots: int,
) -> Motors:
    """Returns motors of simulations.

    Args:
      models, data: one for each simulation.
      limits: see `Limits`; the simulations' actuators must have `actuator_forcelimited`.
      noise: see `Noise`.
      units: number of motors that have a strength.
      slots: number of controls that are kept for delays; 0 for no delays.
    """
    fields = [
        [
            address(array)
            for array in (
                each.qpos, each.qvel, each.ctrl, each.qfrc_applied, each.actuator_force,
                model.actuator_forcerange,
            )
        ]
        for model, each in zip(models, data, strict=True)
    ]  # fmt: skip
    n, dofs = len(models), len(noise.dof)
    state = MotorState(
        strength=np.ones((n, units)),
        lag=np.zeros(n, int),
        age=np.zeros(n, int),
        given=np.zeros(n, int),
        used=np.zeros(n, int),
        times=np.zeros((n, slots), int),
        controls=np.zeros((n, slots, models[0].nu)),
        noise=np.zeros((n, dofs)),
        stream=np.zeros((n, 6), np.uint64),
    )
    return Motors(np.array(fields, np.int64), limits, noise, state)


@compiled_inline
def get(address: int, k: int) -> float:
    """Returns float k at an address."""
    return floats_at(address, k + 1)[k]


@compiled_inline
def put(address: int, k: int, value: float) -> None:
    """Writes float k at an address."""
    floats_at(address, k + 1)[k] = value


# Functions of simulation i.


@compiled_inline
def speed_factor(v: float, no_load: float, braking: float) -> float:
    """Factor of the torque limit of a DC motor at a velocity v in the direction of the torque."""
    return min(max(1.0 - v / no_load, 0.0), braking)


@compiled
def pose_factor(curve: int, angle: float, positive: bool, curves: Curves) -> float:
    """Factor of the limit of positive or negative torques at a joint angle."""
    if curve < 0:
        return 1.0
    angles = curves.angle[curve]
    values = curves.positive[curve] if positive else curves.negative[curve]
    after = np.searchsorted(angles, angle, side='right')
    if after == 0 or after == len(angles):
        return values[0] if after == 0 else values[-1]
    begin, end = angles[after - 1], angles[after]
    share = (angle - begin) / (end - begin)
    return values[after - 1] + share * (values[after] - values[after - 1])


@compiled
def lateral_angle(qpos: int, first: int) -> float:
    """The y component of the rotation vector of a ball joint, rad, from its quaternion in qpos."""
    w, y = get(qpos, first), get(qpos, first + 2)
    x, z = get(qpos, first + 1), get(qpos, first + 3)
    sine = math.sqrt(x * x + y * y + z * z)
    if sine == 0.0:
        return 0.0
    angle = 2.0 * math.atan2(sine, w)
    if angle > math.pi:
        angle -= 2.0 * math.pi
    return angle * y / sine


@compiled
def limit_axes(i: int, motors: Motors) -> None:
    """Writes the force ranges of the motors that act about one axis."""
    own, axes, fields = motors.limits, motors.limits.axes, motors.fields
    for k in range(len(axes.actuator)):
        v = get(fields[i, QVEL], axes.dof[k])
        limit = axes.limit[k] * motors.state.strength[i, axes.unit[k]]
        high = limit * speed_factor(v, own.no_load, own.braking)
        low = limit * speed_factor(-v, own.no_load, own.braking)
        if axes.curve[k] >= 0:
            if axes.sign[k] < 0:
                angle = lateral_angle(fields[i, QPOS], axes.qpos[k])
            else:
                angle = get(fields[i, QPOS], axes.qpos[k])
            high *= pose_factor(axes.curve[k], angle, True, own.curves)
            low *= pose_factor(axes.curve[k], angle, False, own.curves)
        put(fields[i, RANGE], 2 * axes.actuator[k], -low)
        put(fields[i, RANGE], 2 * axes.actuator[k] + 1, high)


@compiled
def free_balls(i: int, motors: Motors) -> None:
    """Removes the limits of the motors of ball joints, so that MuJoCo computes what they intend."""
    balls, ranges = motors.limits.balls, motors.fields[i, RANGE]
    for ball in range(len(balls.limit)):
        least = 0.0 if balls.actuators[ball] == 1 else -UNLIMITED  # a single range bounds a norm
        for k in range(balls.actuator[ball], balls.actuator[ball] + balls.actuators[ball]):
            put(ranges, 2 * k, least)
            put(ranges, 2 * k + 1, UNLIMITED)


@compiled
def limit_balls(i: int, motors: Motors) -> None:
    """Writes the force ranges of the motors of ball joints, from the torques that they intend."""
    own, balls, fields = motors.limits, motors.limits.balls, motors.fields
    ranges = fields[i, RANGE]
    for ball in range(len(balls.limit)):
        first, dof, actuator = balls.output[ball], balls.dof[ball], balls.actuator[ball]
        x, y = get(fields[i, FORCE], first), get(fields[i, FORCE], first + 1)
        z = get(fields[i, FORCE], first + 2)
        norm = math.sqrt(x * x + y * y + z * z)
        limit = balls.limit[ball] * motors.state.strength[i, balls.unit[ball]]
        if norm > 0.0:
            v = x * get(fields[i, QVEL], dof) + y * get(fields[i, QVEL], dof + 1)
            v = (v + z * get(fields[i, QVEL], dof + 2)) / norm
            limit *= speed_factor(v, own.no_load, own.braking)
            if balls.curve[ball] >= 0:
                angle = lateral_angle(fields[i, QPOS], balls.qpos[ball])
                factor = pose_factor(balls.curve[ball], angle, y > 0.0, own.curves)
                across = y / max(factor, 1e-9)
                limit *= norm / math.sqrt(x * x + across * across + z * z)
        if balls.actuators[ball] == 1:
            put(ranges, 2 * actuator + 1, limit)
            continue
        share = min(1.0, limit / norm) if norm > 0.0 else 1.0
        for k in range(3):
            bound = abs(get(fields[i, FORCE], first + k)) * share
            put(ranges, 2 * (actuator + k), -bound)
            put(ranges, 2 * (actuator + k) + 1, bound)


@compiled
def give(i: int, motors: Motors) -> None:
    """Stores the controls that the task has written, which take effect after the delay."""
    state, slots = motors.state, motors.state.times.shape[1]
    if slots == 0:
        return
    count, size = state.given[i], state.controls.shape[2]
    if count > 0:  # the same controls again need no place
        same = True
        for k in range(size):
            last = state.controls[i, (count - 1) % slots, k]
            same &= last == get(motors.fields[i, CTRL], k)
        if same:
            return
    slot = count % slots
    state.times[i, slot] = state.age[i]
    for k in range(size):
        state.controls[i, slot, k] = get(motors.fields[i, CTRL], k)
    state.given[i] += 1


@compiled
def use(i: int, number: int, motors: Motors) -> None:
    """Writes a stored control to the physics."""
    state, slots = motors.state, motors.state.times.shape[1]
    for k in range(state.controls.shape[2]):
        put(motors.fields[i, CTRL], k, state.controls[i, number % slots, k])


@compiled
def delay(i: int, motors: Motors) -> None:
    """Writes the latest controls that were given long enough ago; at first the first ones."""
    state, slots = motors.state, motors.state.times.shape[1]
    if slots == 0:
        return
    used = state.used[i]
    while used + 1 < state.given[i] and (
        state.times[i, (used + 1) % slots] + state.lag[i] <= state.age[i]
    ):
        used += 1
    state.used[i] = used
    use(i, used, motors)


@compiled
def restore(i: int, motors: Motors) -> None:
    """Writes the controls that the task has written last, since it may read them."""
    if motors.state.times.shape[1] > 0:
        use(i, motors.state.given[i] - 1, motors)


@compiled
def add_noise(i: int, motors: Motors) -> None:
    """Advances the noise by a physics step, and writes its torques."""
    own, value = motors.noise, motors.state.noise
    kick = math.sqrt(1.0 - own.decay * own.decay)
    for k in range(len(own.dof)):
        drawn = random.standard_normal(i, motors.state.stream)
        value[i, k] = own.decay * value[i, k] + kick * drawn
        put(motors.fields[i, APPLIED], own.dof[k], own.deviation[k] * value[i, k])


@compiled
def prepare(i: int, motors: Motors) -> None:
    """Prepares a physics step, except the limits of ball joints."""
    delay(i, motors)
    if len(motors.noise.dof) > 0:
        add_noise(i, motors)
    limit_axes(i, motors)
    motors.state.age[i] += 1
