"""What all gaits share: state machines that drive a planar character by stable PD.

Four states are visited in order; time or a contact ends each. On entry to a state its targets are
set; feedback moves single targets in every control step. Compiled functions of simulation i.

Source: the controllers of Terrain RL Simulator (2018), of Peng, Berseth, van de Panne (2016); stable
PD after Tan, Liu, Turk (2011).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from trl_suite.controllers.dynamics import Mechanics, Skeleton, solve, write_inertia
from trl_suite.controllers.parameters import KINDS
from trl_suite.kinematics.planar import PlanarState
from trl_suite.util.compiled import compiled, compiled_inline

CONTROL_TIMESTEP = 1 / 600  # s; gaits were tuned at this rate and fall below 300 Hz
STATES = 4
TRANSITION = 0  # place of the duration of timed states among the parameters of `BOUND` and `STRIDE`
BOUND, STRIDE, HOP = range(len(KINDS))


class Machine(NamedTuple):
    """A kind of gait on a character; joints and links by their numbers in link order.

    Attributes:
      kind: `BOUND`, `STRIDE` or `HOP`.
      kp, kd: gains of the joints, (J,).
      limits: of their torques, (J,) N m (prismatic: N).
      rest: targets of joints that no state moves, (J,) rad.
      misc: how many parameters come before those of the states.
      per_state: how many parameters each state has.
      absolute: places of the parameters whose sign does not count.
      place: which parameter of a state is the target of a joint while the right or the left leg
        stands, -1 for those that no state moves, (2, J). Other gaits use the first simulation.
      legs: joints of each leg, the hip first, (F, K). The targets of hips are world angles.
      feet: links that step, one for each leg, (F,).
      soles: sites under them, (F,); of a bound only.
      turn, constant: world angle of what hangs on the hips, without their own angles; see
        `dynamics.frame`; (F, D) and (F,).
      contact: address of the contact sensor of the first link; the others follow.
      holds_weight: whether legs on the ground compensate gravity.
      lift: force of the hopper's leg on the ground, N.
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
    """Where the machine of each of n simulations is.

    Attributes:
      vector: parameters of the current cycle, (n, P).
      number: of the state, (n,).
      phase: share of the state's time that is over, (n,).
      target: of the joints, (n, J) rad (prismatic: m).
      stance: 0 where the right leg of a stride stands, 1 the left, (n,).
      rising: whether the hopper's root was moving up at the last control step, (n,).
      airborne: whether it has not landed since the start, so that the first action waits, (n,).
    """

    vector: np.ndarray
    number: np.ndarray
    phase: np.ndarray
    target: np.ndarray
    stance: np.ndarray
    rising: np.ndarray
    airborne: np.ndarray


class Scratch(NamedTuple):
    """Room to calculate in.

    Attributes:
      torque: of the joints, the result of a control step, (n, J).
      matrix, vector: of linear equations, (n, D, D) and (n, D).
      support: Jacobians of two feet, (n, 4, D).
    """

    torque: np.ndarray
    matrix: np.ndarray
    vector: np.ndarray
    support: np.ndarray


class GaitRules(NamedTuple):
    """All that gaits work on."""

    skeleton: Skeleton
    physics: PlanarState
    mechanics: Mechanics
    machine: Machine
    state: GaitState
    scratch: Scratch


@compiled_inline
def touches(i: int, link: int, gait: GaitRules) -> bool:
    """Whether a link touches the ground."""
    return gait.physics.sensordata[i, gait.machine.contact + link] > 0.0


@compiled_inline
def of_state(i: int, k: int, gait: GaitRules) -> float:
    """Returns parameter k of the state that a machine is in."""
    first = gait.machine.misc + gait.state.number[i] * gait.machine.per_state
    return gait.state.vector[i, first + k]


@compiled
def enter(i: int, gait: GaitRules) -> None:
    """Sets the joint targets of the state that a machine is in."""
    machine, state = gait.machine, gait.state
    for k in range(len(machine.kp)):
        place = machine.place[state.stance[i], k]
        if place >= 0:
            state.target[i, k] = of_state(i, place, gait)


@compiled
def hip_angle(i: int, leg: int, machine: Machine, skeleton: Skeleton, qpos: np.ndarray) -> float:
    """Returns the world angle of the thigh without the hip's own angle, rad."""
    angle = 0.0
    for k in range(len(skeleton.qpos)):
        angle += qpos[i, skeleton.qpos[k]] * machine.turn[leg, k]
    return angle + machine.constant[leg]


@compiled
def write_local_targets(i: int, gait: GaitRules, out: np.ndarray) -> None:
    """Writes the targets relative to parent links into out[i], (J,)."""
    machine, skeleton, qpos = gait.machine, gait.skeleton, gait.physics.qpos
    for k in range(len(machine.kp)):
        out[i, k] = gait.state.target[i, k]
    for leg in range(len(machine.legs)):
        hip = machine.legs[leg, 0]
        own = qpos[i, skeleton.qpos[3 + hip]]
        angle = hip_angle(i, leg, machine, skeleton, qpos) + own
        angle -= 2 * np.pi * math.ceil((angle - np.pi) / (2 * np.pi))  # to (-pi, pi]
        out[i, hip] -= angle - own


@compiled
def stable_pd(i: int, free: int, gait: GaitRules) -> None:
    """Writes the torques of proportional-derivative control that looks one control step ahead.

    Args:
      i: number of the simulation.
      free: a joint that is left free; J for none.
      gait: all about it.
    """
    skeleton, machine, scratch = gait.skeleton, gait.machine, gait.scratch
    qpos, qvel = gait.physics.qpos, gait.physics.qvel
    matrix, vector, torque = scratch.matrix, scratch.vector, scratch.torque
    write_local_targets(i, gait, torque)
    write_inertia(i, skeleton, gait.mechanics.M, matrix)
    size = len(skeleton.dof)
    for k in range(size):
        vector[i, k] = -gait.mechanics.qfrc_bias[i, skeleton.dof[k]]
    for k in range(3, size):
        joint = k - 3
        kp, kd, v = machine.kp[joint], machine.kd[joint], qvel[i, skeleton.dof[k]]
        matrix[i, k, k] += CONTROL_TIMESTEP * kd
        error = -qpos[i, skeleton.qpos[k]] - CONTROL_TIMESTEP * v + torque[i, joint]
        torque[i, joint] = 0.0 if joint == free else kp * error - kd * v
        vector[i, k] += torque[i, joint]
    solve(i, size, matrix, vector)
    for joint in range(size - 3):
        if joint != free:
            torque[i, joint] -= machine.kd[joint] * CONTROL_TIMESTEP * vector[i, 3 + joint]


@compiled
def limit(i: int, gait: GaitRules) -> None:
    """Keeps the torques within the limits."""
    torque, limits = gait.scratch.torque, gait.machine.limits
    for k in range(len(limits)):
        torque[i, k] = min(max(torque[i, k], -limits[k]), limits[k])
