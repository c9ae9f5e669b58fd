"""Rules of planar imitation: compiled functions of one simulation."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from trl_suite.actuation.action_map import Drive, drive
from trl_suite.engine import native
from trl_suite.kinematics.blocks import CLOCK, Block, Noise
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
from trl_suite.tasks.components.rewards import COM_ERROR_FACTOR
from trl_suite.tasks.task import (
    MAX_JOINT_SPEED,
    Outcome,
    begin,
    conclude,
    too_fast,
)
from trl_suite.tasks.terms import score, wrapped
from trl_suite.terrain.planar.windows import PlanarWindows
from trl_suite.util.compiled import compiled, compiled_loop

CONTROL_TIMESTEP = 1 / 30  # s
SUBSTEPS = 10  # physics at 300 Hz; trained policies score the same from 240 to 1200 Hz
VIEW_BEHIND = 0.5  # m; terrain samples begin this far behind the root
VIEW_AHEAD = 3.0  # m; they end this far ahead of it
PHASE_BINS = 4
ACTION_OFFSETS = ('clip', 'posture', 'original')  # of position control


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


class Rules(NamedTuple):
    """Data of the compiled functions of imitation.

    Attributes:
      ctrl: controls of the physics, (n, controls).
      features: first column of each feature in the clip's table.
      columns: first column of each block in the observation.
      terms: the reward terms.
      weights: weights of pitch and joints in the pose and velocity errors, (1 + J,).
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
    features: Any
    columns: Any
    terms: Any
    weights: np.ndarray
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
def errors(i: int, rules: Rules) -> tuple[float, float, float, float, float]:
    """Returns the errors of pose, velocity, end effectors, centre of mass and height of the root."""
    body, physics, clip, columns = rules.body, rules.physics, rules.clip, rules.features
    phase, measurement = rules.state.phase[i], rules.measurement
    pose = velocity = 0.0
    for k in range(len(rules.weights)):  # pitch, then joints
        angle = physics.qpos[i, body.qpos[2 + k]] - feature(phase, columns.angles + k, clip)
        if k == 0:
            angle = wrapped(angle)
        rate = physics.qvel[i, body.dof[2 + k]] - feature(phase, columns.rates + k, clip)
        pose += rules.weights[k] * (angle * angle)
        velocity += rules.weights[k] * (rate * rate)
    end_effector, count = 0.0, measurement.effectors.shape[1]
    for k in range(count):
        off = measurement.effectors[i, k] - feature(phase, columns.effectors + k, clip)
        end_effector += off * off
    com = 0.0
    for k in range(2):
        off = measurement.com_velocity[i, k] - feature(phase, columns.com_velocity + k, clip)
        com += COM_ERROR_FACTOR * (off * off)
    height = measurement.height[i] - feature(phase, columns.height, clip)
    return pose, velocity, end_effector / (count // 2), com, height * height


@compiled
def compare(i: int, rules: Rules) -> None:
    """Writes the reward terms."""
    pose, velocity, end_effector, com, height = errors(i, rules)
    terms, outcome = rules.terms, rules.outcome
    score(i, pose, terms.pose, outcome)
    score(i, velocity, terms.velocity, outcome)
    score(i, end_effector, terms.end_effector, outcome)
    score(i, com, terms.com, outcome)
    score(i, height, terms.root, outcome)


@compiled
def observe(i: int, rules: Rules) -> None:
    """Writes the blocks after terrain, pose and velocity: strain, and phase or reference."""
    columns, features, observation = rules.columns, rules.features, rules.outcome.observation
    phase = rules.state.phase[i]
    for k in range(len(rules.rest)):
        length = rules.physics.ten_length[i, k] - rules.rest[k]
        observation[i, columns.strain + k] = length / rules.scale[k]
    if columns.phase >= 0:
        for k in range(1 + PHASE_BINS):
            observation[i, columns.phase + k] = feature(phase, features.phase + k, rules.clip)
    if columns.reference >= 0:  # height, positions and velocities
        for k in range(features.root_rate - features.height):
            value = feature(phase, features.height + k, rules.clip)
            observation[i, columns.reference + k] = value


def motion_blocks(muscles: int, links: int, reference: bool) -> tuple[Block, ...]:
    """Returns the blocks that `observe` writes; `reference`: instead of the phase."""
    return (
        Block('strain', muscles, '1', 'strain of each muscle fibre', Noise((0.003, 0.01, 0.02))),
        Block(
            'phase', 0 if reference else 1 + PHASE_BINS, '1',
            'phase of the clip in [0, 1); then the one-hot of its quarter', CLOCK,
        ),
        Block(
            'reference', 4 * links + 1 if reference else 0, 'm, m/s',
            'root height, link centres from the root, and velocities of link centres of the reference',
            'the reference is known to the controller',
        ),
    )  # fmt: skip


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
