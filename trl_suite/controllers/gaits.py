"""Gaits: state machines that control a planar character by stable PD.

A cycle has four states; each ends after a time or at a contact. On entry to a state its joint
targets are set; feedback adjusts some of them in every control step. There are the bound of dog and
goat, the stride of raptor and biped, and the hopper's hop. Compiled functions of simulation i.

Source: the controllers of Terrain RL Simulator (2018), of Peng, Berseth, van de Panne (2016); stable
PD after Tan, Liu, Turk (2011); the balance feedback of the stride after Yin, Loken, van de Panne (2007).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from trl_suite.bodies.planar import PlanarState
from trl_suite.bodies.state import FLAG, REAL, WHOLE
from trl_suite.controllers.dynamics import (
    Mechanics,
    Skeleton,
    com_speed,
    solve,
    weight,
    write_inertia,
    write_jacobian,
)
from trl_suite.controllers.parameters import KINDS
from trl_suite.util.compiled import compiled, compiled_inline

GAIT_TIMESTEP = 1 / 600  # s; gaits were tuned at this rate, and characters fall below 300 Hz
STATES = 4
TRANSITION = 0  # index of TransTime, the duration of timed states, in `BOUND` and `STRIDE`
BOUND, STRIDE, HOP = range(len(KINDS))
REGULARISATION = 1e-4  # of the contact forces that support the weight
LAST = STATES - 1


class Machine(NamedTuple):
    """A kind of gait on a character; joints and links by their numbers in link order.

    Attributes:
      kind: `BOUND`, `STRIDE` or `HOP`.
      kp, kd: gains of the joints, (J,).
      limits: torque limits, (J,) N m (prismatic: N).
      rest: targets of joints that no state sets, (J,) rad.
      misc: number of parameters before those of the states.
      per_state: number of parameters of each state.
      absolute: indices of parameters of which the absolute value is used.
      place: index of the parameter of a state that is the target of a joint, for right and left
        stance; -1 if no state sets it, (2, J). Gaits other than `STRIDE` use the first row only.
      legs: joints of each leg, the hip first, (F, K). The targets of hips are world angles.
      feet: links that touch the ground, one for each leg, (F,).
      soles: sites under them, (F,); for a bound only.
      turn, constant: map to the world angles of thighs without the hips' own angles, see
        `dynamics.frame`; (F, D) and (F,).
      contact: address of the contact sensor of the first link; the others follow.
      holds_weight: whether legs on the ground compensate gravity.
      lift: generalised force of the hopper's leg on the ground when it is vertical, N.
    """

    kind: int
    kp: np.ndarray
    kd: np.ndarray
    limits: np.ndarray
    rest: np.ndarray
    misc: int
    per_state: int
    absolute: np.ndarray
    place: np.ndarray
    legs: np.ndarray
    feet: np.ndarray
    soles: np.ndarray
    turn: np.ndarray
    constant: np.ndarray
    contact: int
    holds_weight: bool
    lift: float


class GaitState(NamedTuple):
    """State of the machines of n simulations.

    Attributes:
      vector: parameters of the current cycle, (n, P).
      target: joint targets, (n, J) rad (prismatic: m).
      number: number of the current state, (n,).
      phase: elapsed fraction of the duration of the state, (n,).
      stance: stance leg of a stride, 0 right, 1 left, (n,).
      rising: whether the hopper's root was moving up at the last control step, (n,).
      airborne: whether the next cycle begins in the air, as the first one does, (n,).
    """

    vector: np.ndarray
    target: np.ndarray
    number: np.ndarray = WHOLE
    phase: np.ndarray = REAL
    stance: np.ndarray = WHOLE
    rising: np.ndarray = FLAG
    airborne: np.ndarray = FLAG


class Scratch(NamedTuple):
    """Preallocated memory for intermediate results.

    Attributes:
      torque: joint torques, the result of a control step, (n, J).
      matrix, rhs: matrices, (n, D, D), and right-hand sides, (n, D), of linear equations, whose
        solutions overwrite the latter.
      support: Jacobians of two feet, (n, 4, D).
    """

    torque: np.ndarray
    matrix: np.ndarray
    rhs: np.ndarray
    support: np.ndarray


class GaitData(NamedTuple):
    """Data for the compiled functions of gaits."""

    skeleton: Skeleton
    physics: PlanarState
    mechanics: Mechanics
    machine: Machine
    state: GaitState
    scratch: Scratch


@compiled_inline
def touches(i: int, link: int, gait: GaitData) -> bool:
    """Returns whether a link touches the ground."""
    return gait.physics.sensordata[i, gait.machine.contact + link] > 0.0


@compiled_inline
def of_state(i: int, k: int, gait: GaitData) -> float:
    """Returns parameter k of the current state."""
    first = gait.machine.misc + gait.state.number[i] * gait.machine.per_state
    return gait.state.vector[i, first + k]


@compiled
def enter(i: int, gait: GaitData) -> None:
    """Sets the joint targets of the current state."""
    machine, state = gait.machine, gait.state
    for k in range(len(machine.kp)):
        place = machine.place[state.stance[i], k]
        if place >= 0:
            state.target[i, k] = of_state(i, place, gait)


@compiled
def thigh_base(i: int, leg: int, machine: Machine, skeleton: Skeleton, qpos: np.ndarray) -> float:
    """Returns the world angle that the thigh has when the hip's own angle is 0, rad."""
    angle = 0.0
    for k in range(len(skeleton.qpos)):
        angle += qpos[i, skeleton.qpos[k]] * machine.turn[leg, k]
    return angle + machine.constant[leg]


@compiled
def write_local_targets(i: int, gait: GaitData, out: np.ndarray) -> None:
    """Writes the targets relative to parent links into out[i], (J,)."""
    machine, skeleton, qpos = gait.machine, gait.skeleton, gait.physics.qpos
    for k in range(len(machine.kp)):
        out[i, k] = gait.state.target[i, k]
    for leg in range(len(machine.legs)):
        hip = machine.legs[leg, 0]
        own = qpos[i, skeleton.qpos[3 + hip]]
        angle = thigh_base(i, leg, machine, skeleton, qpos) + own
        angle -= 2 * np.pi * np.ceil((angle - np.pi) / (2 * np.pi))  # to (-pi, pi]
        out[i, hip] -= angle - own


@compiled
def stable_pd(i: int, free: int, gait: GaitData) -> None:
    """Writes the torques of stable PD control, which predicts one control step ahead.

    Args:
      i: index of the simulation.
      free: number of a joint without torque; J for none.
      gait: the data.
    """
    skeleton, machine, scratch = gait.skeleton, gait.machine, gait.scratch
    qpos, qvel = gait.physics.qpos, gait.physics.qvel
    matrix, rhs, torque = scratch.matrix, scratch.rhs, scratch.torque
    write_local_targets(i, gait, torque)  # which the loop below replaces by torques
    write_inertia(i, skeleton, gait.mechanics.M, matrix)
    size = len(skeleton.dof)
    for k in range(size):
        rhs[i, k] = -gait.mechanics.qfrc_bias[i, skeleton.dof[k]]
    for k in range(3, size):
        joint = k - 3
        kp, kd, v = machine.kp[joint], machine.kd[joint], qvel[i, skeleton.dof[k]]
        matrix[i, k, k] += GAIT_TIMESTEP * kd
        error = -qpos[i, skeleton.qpos[k]] - GAIT_TIMESTEP * v + torque[i, joint]
        torque[i, joint] = 0.0 if joint == free else kp * error - kd * v
        rhs[i, k] += torque[i, joint]
    solve(i, size, matrix, rhs)
    for joint in range(size - 3):
        if joint != free:
            torque[i, joint] -= machine.kd[joint] * GAIT_TIMESTEP * rhs[i, 3 + joint]


@compiled
def clip_torques(i: int, gait: GaitData) -> None:
    """Clips the torques to their limits."""
    torque, limits = gait.scratch.torque, gait.machine.limits
    for k in range(len(limits)):
        torque[i, k] = min(max(torque[i, k], -limits[k]), limits[k])


# Bound: back stance, extend, front stance, gather; one hind and one fore leg, in this order.
# Parameters: TransTime, Cv, and virtual forces of hind foot and fore foot.


@compiled
def bound_ends(i: int, gait: GaitData) -> bool:
    """Returns whether a state is over: by time, or because the next foot has landed."""
    number = gait.state.number[i]
    if number == 0 or number == 2:
        return gait.state.phase[i] >= 1.0
    return touches(i, gait.machine.feet[1 if number == 1 else 0], gait)


@compiled
def bound_torques(i: int, gait: GaitData) -> None:
    """Writes torques: stable PD, swing legs with speed feedback, virtual forces on the ground."""
    machine, state, torque = gait.machine, gait.state, gait.scratch.torque
    lead = state.vector[i, 1] * com_speed(i, gait.skeleton, gait.mechanics.M, gait.physics.qvel)
    for leg in range(2):
        hip = machine.legs[leg, 0]
        if not touches(i, machine.feet[leg], gait):
            state.target[i, hip] = of_state(i, machine.place[0, hip], gait) + lead
    stable_pd(i, len(machine.kp), gait)
    if touches(i, machine.feet[0], gait) or touches(i, machine.feet[1], gait):
        write_foot_jacobians(i, gait)
        if machine.holds_weight:
            add_weight(i, gait)
        # A force on the body is the opposite force on the ground, of the hind or the fore foot
        # depending on the state.
        leg = 0 if state.number[i] < 2 else 1
        ahead, up = state.vector[i, 2 + 2 * leg], state.vector[i, 3 + 2 * leg]
        support = gait.scratch.support
        for joint in machine.legs[leg]:
            k = 3 + joint
            torque[i, joint] -= ahead * support[i, 2 * leg, k] + up * support[i, 2 * leg + 1, k]
    clip_torques(i, gait)


@compiled
def write_foot_jacobians(i: int, gait: GaitData) -> None:
    """Writes the Jacobians of the feet; 0 for feet in the air."""
    machine, support = gait.machine, gait.scratch.support
    for leg in range(2):
        if touches(i, machine.feet[leg], gait):
            body, sole = gait.skeleton.links[machine.feet[leg]], machine.soles[leg]
            x, z = gait.mechanics.site_xpos[i, sole, 0], gait.mechanics.site_xpos[i, sole, 2]
            anchors = gait.mechanics.xanchor
            write_jacobian(i, body, x, z, 2 * leg, gait.skeleton, anchors, support)
        else:
            for k in range(support.shape[2]):
                support[i, 2 * leg, k] = support[i, 2 * leg + 1, k] = 0.0


@compiled
def add_weight(i: int, gait: GaitData) -> None:
    """Adds torques that compensate gravity by the feet on the ground."""
    skeleton, scratch = gait.skeleton, gait.scratch
    com, anchors = gait.physics.subtree_com, gait.mechanics.xanchor
    support, grip, force = scratch.support, scratch.matrix, scratch.rhs
    # Least squares for the forces f of the feet that hold the root, its three degrees of freedom:
    # (J J' + REGULARISATION) f = -J w, with J `support` and w gravity.
    for row in range(4):
        for column in range(4):
            grip[i, row, column] = 0.0
            for k in range(3):
                grip[i, row, column] += support[i, row, k] * support[i, column, k]
        grip[i, row, row] += REGULARISATION
        force[i, row] = 0.0
        for k in range(3):
            force[i, row] -= support[i, row, k] * weight(i, k, skeleton, com, anchors)
    solve(i, 4, grip, force)
    for joint in range(len(gait.machine.kp)):
        k = 3 + joint
        carried = 0.0
        for row in range(4):
            carried += force[i, row] * support[i, row, k]
        scratch.torque[i, joint] += -weight(i, k, skeleton, com, anchors) - carried


# Stride: one step per cycle; stance and swing leg are then exchanged. States: contact, down,
# passing, up. Parameters: TransTime, Cv, Cd; the first parameter of a state is the root's pitch.


@compiled
def stride_ends(i: int, gait: GaitData) -> bool:
    """Returns whether a state is over: by time, the last one when the swing foot lands."""
    if gait.state.number[i] < LAST:
        return gait.state.phase[i] >= 1.0
    return touches(i, gait.machine.feet[1 - gait.state.stance[i]], gait)


@compiled
def stride_torques(i: int, gait: GaitData) -> None:
    """Writes torques: stable PD, balance feedback by the swing hip, root pitch by the stance hip."""
    machine, state, torque = gait.machine, gait.state, gait.scratch.torque
    skeleton, physics = gait.skeleton, gait.physics
    stance = state.stance[i]
    foot, early = machine.feet[stance], state.number[i] < 2
    hip, swing_hip = machine.legs[stance, 0], machine.legs[1 - stance, 0]
    if early:
        lead = state.vector[i, 1] * com_speed(i, skeleton, gait.mechanics.M, physics.qvel)
    else:
        com = physics.subtree_com[i, skeleton.links[0], 0]
        lead = state.vector[i, 2] * (com - physics.xipos[i, skeleton.links[foot], 0])
    place = machine.place[stance, swing_hip]
    state.target[i, swing_hip] = of_state(i, place, gait) + lead
    loaded = early and touches(i, foot, gait)
    stable_pd(i, hip if loaded else len(machine.kp), gait)
    if loaded:
        pitch, rate = physics.qpos[i, skeleton.qpos[2]], physics.qvel[i, skeleton.dof[2]]
        upright = machine.kp[hip] * (of_state(i, 0, gait) - pitch) - machine.kd[hip] * rate
        torque[i, hip] -= torque[i, swing_hip] + upright
    clip_torques(i, gait)


# Hop. States: descent, down stance, up stance, ascent; a cycle ends at touch-down. Parameter:
# MagicGain.
DESCENT, DOWN, UP, ASCENT = range(STATES)


@compiled
def hop_advance(i: int, gait: GaitData) -> bool:
    """Advances the hopper's state; returns whether it lands, which ends the cycle."""
    state = gait.state
    landed = touches(i, gait.machine.feet[0], gait)
    number, following = state.number[i], state.number[i]
    was, rising = state.rising[i], gait.physics.qvel[i, gait.skeleton.dof[1]] > 0.0
    state.rising[i] = rising
    if number == DOWN and rising and not was:
        following = UP
    elif number == UP and not landed:
        following = ASCENT
    elif number == ASCENT and landed:
        following = UP
    elif number == ASCENT and was and not rising:
        following = DESCENT
    if following != number:
        state.number[i] = following
        enter(i, gait)
    return number == DESCENT and landed


@compiled
def hop_torques(i: int, gait: GaitData) -> None:
    """Writes torques: stable PD; on the ground, root pitch by the hip, weight by the leg."""
    machine, state, torque = gait.machine, gait.state, gait.scratch.torque
    skeleton, qpos, qvel = gait.skeleton, gait.physics.qpos, gait.physics.qvel
    hip, leg = machine.legs[0, 0], machine.legs[0, 1]
    stable_pd(i, len(machine.kp), gait)
    if state.number[i] == DOWN or state.number[i] == UP:
        pitch, rate = qpos[i, skeleton.qpos[2]], qvel[i, skeleton.dof[2]]
        upright = -machine.kp[hip] * pitch - machine.kd[hip] * rate
        torque[i, hip] -= state.vector[i, 0] * upright
    if touches(i, machine.feet[0], gait):
        thigh = thigh_base(i, 0, machine, skeleton, qpos) + qpos[i, skeleton.qpos[3 + hip]]
        torque[i, leg] += machine.lift * math.cos(thigh)
    clip_torques(i, gait)


# Any gait.


@compiled
def begin_cycle(i: int, gait: GaitData) -> None:
    """Begins a cycle with the parameters in `state.vector`."""
    machine, state = gait.machine, gait.state
    for place in machine.absolute:
        state.vector[i, place] = abs(state.vector[i, place])
    # A hopper's cycle begins at touch-down, except the first one, which begins in the air.
    state.number[i] = DOWN if machine.kind == HOP and not state.airborne[i] else 0
    state.airborne[i] = False
    state.phase[i] = 0.0
    enter(i, gait)


@compiled
def act(i: int, gait: GaitData) -> None:
    """Writes the torques of the next control step, within limits."""
    if gait.machine.kind == BOUND:
        bound_torques(i, gait)
    elif gait.machine.kind == STRIDE:
        stride_torques(i, gait)
    else:
        hop_torques(i, gait)


@compiled
def advance(i: int, gait: GaitData) -> bool:
    """Advances a state machine after a control step; returns whether its cycle has ended.

    A machine whose cycle has ended stays in its last state until `begin_cycle`.
    """
    machine, state = gait.machine, gait.state
    if machine.kind == HOP:
        return hop_advance(i, gait)
    state.phase[i] += GAIT_TIMESTEP / state.vector[i, TRANSITION]
    leaving = bound_ends(i, gait) if machine.kind == BOUND else stride_ends(i, gait)
    if not leaving:
        return False
    if state.number[i] < LAST:
        state.number[i] += 1
        state.phase[i] = 0.0
        enter(i, gait)
        return False
    if machine.kind == STRIDE:
        state.stance[i] = 1 - state.stance[i]
    return True


@compiled
def begin(i: int, vector: np.ndarray, gait: GaitData) -> None:
    """Resets a state machine to the start of its first cycle, with parameters (P,)."""
    state = gait.state
    state.stance[i] = 0
    state.rising[i], state.airborne[i] = False, True
    for k in range(len(gait.machine.rest)):
        state.target[i, k] = gait.machine.rest[k]
    for k in range(len(vector)):
        state.vector[i, k] = vector[k]
    begin_cycle(i, gait)
    # `begin_cycle` has cleared it; the first action must begin in the air, too.
    state.airborne[i] = True
