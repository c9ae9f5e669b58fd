"""Rules of planar imitation: compiled functions of one simulation."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trl_suite.actuation.action_map import Drive, drive
from trl_suite.engine import native
from trl_suite.kinematics.planar import (
    PlanarBody,
    PlanarMeasurement,
    PlanarState,
    has_fallen,
    is_lost,
    leaves,
    measure,
)
from trl_suite.kinematics.planar_reference import ClipTable, feature
from trl_suite.tasks.components import rewards
from trl_suite.tasks.task import (
    MAX_JOINT_SPEED,
    Outcome,
    begin,
    conclude,
    too_fast,
)
from trl_suite.terrain.planar.windows import PlanarWindows
from trl_suite.util.compiled import compiled, compiled_loop

CONTROL_TIMESTEP = 1 / 30  # s
SUBSTEPS = 10  # physics at 300 Hz; trained policies score the same from 240 to 1200 Hz
VIEW_BEHIND = 0.5  # m; terrain samples begin this far behind the root
VIEW_AHEAD = 3.0  # m; they end this far ahead of it
PHASE_BINS = 4
ACTION_OFFSETS = ('clip', 'posture', 'original')  # of position control

POSE, VELOCITY, END_EFFECTOR, COM, ROOT = range(len(rewards.IMITATION_TERMS))


class ImitationState(NamedTuple):
    """Clip time of each simulation, (n,).

    Attributes:
      phase: phase of the clip, in [0, 1).
      cycles: number of clip periods, with fraction: the phase before it is wrapped.
      start: `cycles` at the start of the episode.
    """

    phase: np.ndarray
    cycles: np.ndarray
    start: np.ndarray


class Layout(NamedTuple):
    """First columns of features in the clip's table, and of blocks in the observation.

    Attributes:
      angles, rates, effectors, com_velocity, height, positions, phase: first column of each
        feature in the clip's table.
      strain_block, phase_block, reference_block: first column of each block in the observation,
        -1 if the block is not observed.
      reference: number of columns of the reference block.
    """

    angles: int
    rates: int
    effectors: int
    com_velocity: int
    height: int
    positions: int
    phase: int
    strain_block: int
    phase_block: int
    reference_block: int
    reference: int


_FEATURES = Layout._fields[:7]  # fields that are columns of the clip's table


class Rules(NamedTuple):
    """Data of the compiled functions of imitation.

    Attributes:
      ctrl: controls of the physics, (n, controls).
      weights: weights of pitch and joints in the pose and velocity errors, (1 + J,).
      term_weights, term_scales: weights and error scales of the reward terms, (5,).
      rest: tendon length of each muscle at zero strain, m.
      scale: change of tendon length of each muscle per unit of strain, m.
    """

    engine: native.Engine
    body: PlanarBody
    physics: PlanarState
    ground: PlanarWindows
    clip: ClipTable
    drive: Drive
    ctrl: np.ndarray
    layout: Layout
    weights: np.ndarray
    term_weights: np.ndarray
    term_scales: np.ndarray
    rest: np.ndarray
    scale: np.ndarray
    measurement: PlanarMeasurement
    state: ImitationState
    outcome: Outcome


# The step of simulation i. Functions are in the order in which they are called.


@compiled
def finish_step(i: int, rules: Rules) -> None:
    """Computes reward, failure and observation after the physics step."""
    advance_clock(i, rules.clip, rules.state)
    if breaks_down(i, rules):
        conclude(i, True, rules.outcome)
        return
    measure(
        i, rules.body, rules.physics, rules.ground, rules.outcome.observation, rules.measurement
    )
    compare(i, rules)
    conclude(i, has_fallen(i, rules.body, rules.physics), rules.outcome)
    observe(i, rules)


@compiled
def advance_clock(i: int, clip: ClipTable, state: ImitationState) -> None:
    """Advances the phase by a control step."""
    state.cycles[i] += CONTROL_TIMESTEP / clip.period
    state.phase[i] = state.cycles[i] % 1.0


@compiled
def breaks_down(i: int, rules: Rules) -> bool:
    """Returns whether a simulation diverged or left its ground: it keeps the last observation."""
    joints = rules.body.dof[2:]
    diverged = (
        native.diverged(i, rules.engine)
        or too_fast(i, joints, MAX_JOINT_SPEED, rules.physics.qvel)
        or is_lost(i, rules.body, rules.physics, rules.ground)
    )
    rules.outcome.diverged[i] = diverged
    return diverged


@compiled
def compare(i: int, rules: Rules) -> None:
    """Writes the reward terms, from errors of pose, velocities and end effectors."""
    body, physics, clip, layout = rules.body, rules.physics, rules.clip, rules.layout
    phase, measurement, terms = rules.state.phase[i], rules.measurement, rules.outcome.reward_terms
    pose = velocity = 0.0
    for k in range(len(rules.weights)):  # pitch, then joints
        angle = physics.qpos[i, body.qpos[2 + k]] - feature(phase, layout.angles + k, clip)
        if k == 0:
            angle = rewards.wrapped(angle)
        rate = physics.qvel[i, body.dof[2 + k]] - feature(phase, layout.rates + k, clip)
        pose += rules.weights[k] * (angle * angle)
        velocity += rules.weights[k] * (rate * rate)
    end_effector, count = 0.0, measurement.effectors.shape[1]
    for k in range(count):
        off = measurement.effectors[i, k] - feature(phase, layout.effectors + k, clip)
        end_effector += off * off
    com = 0.0
    for k in range(2):
        off = measurement.com_velocity[i, k] - feature(phase, layout.com_velocity + k, clip)
        com += rewards.COM_ERROR_FACTOR * (off * off)
    height = measurement.height[i] - feature(phase, layout.height, clip)

    weights, scales = rules.term_weights, rules.term_scales
    terms[i, POSE] = rewards.term(pose, weights[POSE], scales[POSE])
    terms[i, VELOCITY] = rewards.term(velocity, weights[VELOCITY], scales[VELOCITY])
    end_effector /= count // 2
    terms[i, END_EFFECTOR] = rewards.term(end_effector, weights[END_EFFECTOR], scales[END_EFFECTOR])
    terms[i, COM] = rewards.term(com, weights[COM], scales[COM])
    terms[i, ROOT] = rewards.term(height * height, weights[ROOT], scales[ROOT])


@compiled
def observe(i: int, rules: Rules) -> None:
    """Writes the blocks after terrain, pose and velocity: strain, and phase or reference."""
    layout, clip, observation = rules.layout, rules.clip, rules.outcome.observation
    phase = rules.state.phase[i]
    for k in range(len(rules.rest)):
        length = rules.physics.ten_length[i, k] - rules.rest[k]
        observation[i, layout.strain_block + k] = length / rules.scale[k]
    if layout.phase_block >= 0:
        for k in range(1 + PHASE_BINS):
            observation[i, layout.phase_block + k] = feature(phase, layout.phase + k, clip)
    for k in range(layout.reference):
        observation[i, layout.reference_block + k] = feature(phase, layout.height + k, clip)


# Loops over simulations. `rules` is passed as one pointer (`trl_suite.util.pack`).


@compiled_loop
def apply_actions(env_ids: np.ndarray, action: np.ndarray, rules: Rules) -> int:
    """Applies actions; returns how many ground windows must be moved."""
    leaving = 0
    for i in env_ids:
        drive(i, action, rules.drive, rules.ctrl)
        leaving += leaves(i, rules.body, rules.physics, rules.ground, rules.measurement)
    return leaving


@compiled_loop
def finish_steps(env_ids: np.ndarray, rules: Rules) -> None:
    """Finishes steps."""
    for i in env_ids:
        finish_step(i, rules)


@compiled_loop
def observe_all(env_ids: np.ndarray, fresh: bool, rules: Rules) -> None:
    """Writes observations; if `fresh`, episodes have just begun, and outcomes are reset."""
    for i in env_ids:
        measure(
            i, rules.body, rules.physics, rules.ground, rules.outcome.observation, rules.measurement
        )
        compare(i, rules)
        observe(i, rules)
        if fresh:
            begin(i, rules.outcome)
