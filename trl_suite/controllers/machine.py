"""Common parts of all gaits: state machines that control a planar character by stable PD.

A cycle has four states; each ends after a time or at a contact. On entry to a state its joint
targets are set; feedback adjusts some of them in every control step. Compiled functions of
simulation i.

Source: the controllers of Terrain RL Simulator (2018), of Peng, Berseth, van de Panne (2016); stable
PD after Tan, Liu, Turk (2011).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trl_suite.bodies.planar import PlanarState
from trl_suite.controllers.dynamics import Mechanics, Skeleton, solve, write_inertia
from trl_suite.controllers.parameters import KINDS
from trl_suite.util.compiled import compiled, compiled_inline

CONTROL_TIMESTEP = 1 / 600  # s; gaits were tuned at this rate, and characters fall below 300 Hz
STATES = 4
TRANSITION = 0  # index of TransTime, the duration of timed states, in `BOUND` and `STRIDE`
BOUND, STRIDE, HOP = range(len(KINDS))


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
      number: number of the current state, (n,).
      phase: elapsed fraction of the duration of the state, (n,).
      target: joint targets, (n, J) rad (prismatic: m).
      stance: stance leg of a stride, 0 right, 1 left, (n,).
      rising: whether the hopper's root was moving up at the last control step, (n,).
      airborne: whether the next cycle begins in the air, as the first one does, (n,).
    """

    vector: np.ndarray
    number: np.ndarray
    phase: np.ndarray
    target: np.ndarray
    stance: np.ndarray
    rising: np.ndarray
    airborne: np.ndarray


class Scratch(NamedTuple):
    """Preallocated memory for intermediate results.

    Attributes:
      torque: joint torques, the result of a control step, (n, J).
      matrix, vector: systems of linear equations, (n, D, D) and (n, D).
      support: Jacobians of two feet, (n, 4, D).
    """

    torque: np.ndarray
    matrix: np.ndarray
    vector: np.ndarray
    support: np.ndarray


class GaitRules(NamedTuple):
    """Data for the compiled functions of gaits."""

    skeleton: Skeleton
    physics: PlanarState
    mechanics: Mechanics
    machine: Machine
    state: GaitState
    scratch: Scratch


@compiled_inline
def touches(i: int, link: int, gait: GaitRules) -> bool:
    """Returns whether a link touches the ground."""
    return gait.physics.sensordata[i, gait.machine.contact + link] > 0.0


@compiled_inline
def of_state(i: int, k: int, gait: GaitRules) -> float:
    """Returns parameter k of the current state."""
    first = gait.machine.misc + gait.state.number[i] * gait.machine.per_state
    return gait.state.vector[i, first + k]


@compiled
def enter(i: int, gait: GaitRules) -> None:
    """Sets the joint targets of the current state."""
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
        angle -= 2 * np.pi * np.ceil((angle - np.pi) / (2 * np.pi))  # to (-pi, pi]
        out[i, hip] -= angle - own


@compiled
def stable_pd(i: int, free: int, gait: GaitRules) -> None:
    """Writes the torques of stable PD control, which predicts one control step ahead.

    Args:
      i: index of the simulation.
      free: number of a joint without torque; J for none.
      gait: the data.
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
    """Clips the torques to their limits."""
    torque, limits = gait.scratch.torque, gait.machine.limits
    for k in range(len(limits)):
        torque[i, k] = min(max(torque[i, k], -limits[k]), limits[k])
