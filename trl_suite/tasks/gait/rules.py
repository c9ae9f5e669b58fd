"""Gait tasks: compiled functions of one simulation."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, NamedTuple

import numpy as np

from trl_suite.characters import CharacterSpec
from trl_suite.controllers import CONTROL_TIMESTEP, gaits
from trl_suite.controllers.machine import GaitRules, touches
from trl_suite.controllers.parameters import Parameters
from trl_suite.engine import native
from trl_suite.kinematics.blocks import Block
from trl_suite.kinematics.planar import (
    PlanarIds,
    PlanarMeasurement,
    is_lost,
    leaves,
    measure,
)
from trl_suite.tasks.terms import Outcome, Term, begin, conclude, give, score
from trl_suite.terrain.planar.windows import PlanarWindows
from trl_suite.util.compiled import compiled

SAMPLES, BEHIND, AHEAD = 200, 0.5, 10.0  # number of observed ground heights, and their range, m
SUBSTEPS = 2  # physics steps per control step: 1/1200 s
FRAME = 1 / 30  # s; nominal step, and the actual one with interface 'base_action'
LONGEST_CYCLE = 50  # frames
UPSTREAM_CENTRE = 3.0  # m; boundary of the original's first two segments of ground
INTERFACES = ('parameters', 'base_action')

# Conditions of failure, tested every SAMPLE.
SAMPLE = 0.1  # s
CONTACT_DECAY, CONTACT_GAIN, FALL_THRESHOLD = (
    0.9,
    1 / 11,
    0.25,
)  # of the decaying average of samples with a fall link on the ground
TURNED = 0.8 * np.pi  # rad; largest pitch
PATIENCE, PROGRESS = (
    5.0,
    0.5,
)  # s, m; an episode fails if the root moves less than this in this time
MAX_JOINT_SPEED = 1000.0  # rad/s; high, since these joints have no damping

STUMBLE_SHARPNESS = 10.0
TERMS = (  # of the reward of a cycle; weights are those of the character
    Term(
        'speed', 0.8, 'mean forward speed of the centre of mass in the cycle minus the target speed, squared',
        0.5, 'm^2/s^2',
    ),
    Term(
        'stumble', 0.2, f'1 / (1 + {STUMBLE_SHARPNESS:g} s), s: fraction of time in which a link that should '
        'not touches the ground',
    ),
)  # fmt: skip

_FRAME_STEPS = round(FRAME / CONTROL_TIMESTEP)
_SAMPLE_STEPS = round(SAMPLE / CONTROL_TIMESTEP)
_PATIENCE_STEPS = round(PATIENCE / CONTROL_TIMESTEP)
_OVER, _GROUND, _LOOK = range(3)  # why `go_on` returns: the step is over, the ground, or `watch`


class GaitTaskState(NamedTuple):
    """State of the task for each simulation, (n,); times are in control steps.

    Attributes:
      action: clipped action, (n, k).
      going: whether the current step is not over.
      waiting: whether a cycle is over and the next one needs parameters.
      lasted, stumbled: duration of the step, and time with a stumble link on the ground in it.
      age: time since the start of the episode.
      start: x of the centre of mass at the beginning of the step, m.
      down: decaying average of samples with a fall link on the ground.
      milestone: x and z of the root at the last test of progress, (n, 2) m.
      fell, stuck: whether the episode has ended with a fall, or without progress.
      duration, stumbling: `lasted` and `stumbled` of the last finished step, s.
    """

    action: np.ndarray
    going: np.ndarray
    waiting: np.ndarray
    lasted: np.ndarray
    stumbled: np.ndarray
    age: np.ndarray
    start: np.ndarray
    down: np.ndarray
    milestone: np.ndarray
    fell: np.ndarray
    stuck: np.ndarray
    duration: np.ndarray
    stumbling: np.ndarray


class Options(NamedTuple):
    """Constants of a gait task.

    Attributes:
      by_cycle: whether a step is a cycle, not a frame of 1/30 s.
      substeps: physics steps per control step.
      action_offset: parameters of the gait at action 0, (P,).
      action_scale: change of the parameters that actions set, per unit action, (k,).
      places: indices of these parameters, (k,).
      base_actions: parameters of the base actions, (B, P).
      controls: addresses of the joints' torques in ctrl, (J,).
      fall, stumble: numbers of links whose ground contact is a fall, or reduces the reward.
      forward_only: whether moving backwards is a fall.
      backward_reward: whether the reward of a cycle with negative speed can be positive.
      target_speed: m/s.
      columns: columns of the measurement in the observation, by stance leg, (2, size).
      pitch, pitch_rate: columns of the observation for pitch and its rate; -1: not observed.
    """

    by_cycle: bool
    substeps: int
    action_offset: np.ndarray
    action_scale: np.ndarray
    places: np.ndarray
    base_actions: np.ndarray
    controls: np.ndarray
    fall: np.ndarray
    stumble: np.ndarray
    forward_only: bool
    backward_reward: bool
    target_speed: float
    columns: np.ndarray
    pitch: int
    pitch_rate: int


class Rules(NamedTuple):
    """Data for the compiled functions of gait tasks.

    Attributes:
      ctrl: controls of the physics, (n, ...).
      terms: the reward terms.
      measured: blocks terrain, pose and velocity as `measure` writes them, (n, ...).
      interruption: why `go_on` returned last, (n,).
    """

    engine: native.Engine
    body: PlanarIds
    ground: PlanarWindows
    gait: GaitRules
    ctrl: np.ndarray
    options: Options
    terms: Any
    measured: np.ndarray
    interruption: np.ndarray
    measurement: PlanarMeasurement
    state: GaitTaskState
    outcome: Outcome


# A step of simulation i, in order.


@compiled
def begin_step(i: int, action: np.ndarray, rules: Rules) -> None:
    """Begins a step; the action sets the gait of a cycle that begins with it."""
    state = rules.state
    for k in range(state.action.shape[1]):
        state.action[i, k] = min(max(action[i, k], -1.0), 1.0)
    state.lasted[i] = state.stumbled[i] = 0
    state.going[i] = True
    state.start[i] = rules.gait.physics.subtree_com[i, rules.body.links[0], 0]
    if rules.options.by_cycle or state.waiting[i]:
        set_gait(i, rules)


@compiled
def set_gait(i: int, rules: Rules) -> None:
    """Begins a cycle with the parameters of the current action."""
    options, action, vector = rules.options, rules.state.action, rules.gait.state.vector
    rules.state.waiting[i] = False
    if options.by_cycle:
        for k in range(len(options.action_offset)):
            vector[i, k] = options.action_offset[k]
        for k in range(len(options.places)):
            vector[i, options.places[k]] += options.action_scale[k] * action[i, k]
    else:
        choice = 0
        for k in range(1, len(options.base_actions)):
            if action[i, k] > action[i, choice]:
                choice = k
        for k in range(len(options.action_offset)):
            vector[i, k] = options.base_actions[choice, k]
    gaits.apply(i, rules.gait)


@compiled
def go_on(i: int, watched: bool, rules: Rules) -> int:
    """Continues a step until it is over or interrupted; returns the reason."""
    state, options = rules.state, rules.options
    while state.going[i]:
        if state.lasted[i] % _FRAME_STEPS == 0 and leaves(
            i, rules.body, rules.gait.physics, rules.ground
        ):
            return _GROUND
        gaits.act(i, rules.gait)
        for k in range(len(options.controls)):
            rules.ctrl[i, options.controls[k]] = rules.gait.scratch.torque[i, k]
        native.step(i, options.substeps, rules.engine)
        ended = gaits.advance(i, rules.gait)
        account(i, rules)
        if options.by_cycle:
            over = ended or state.lasted[i] == LONGEST_CYCLE * _FRAME_STEPS
        else:
            over = state.lasted[i] == _FRAME_STEPS
            if ended:
                set_gait(i, rules)
        state.going[i] = not (over or rules.outcome.failed[i])
        if watched and i == 0 and state.age[i] % _FRAME_STEPS == 0:
            return _LOOK
    return _OVER


@compiled
def account(i: int, rules: Rules) -> None:
    """Updates times, stumbling and failure after a control step."""
    state = rules.state
    state.lasted[i] += 1
    state.age[i] += 1
    state.stumbled[i] += any_touches(i, rules.options.stumble, rules.gait)
    if state.age[i] % _SAMPLE_STEPS == 0:
        look(i, rules)


@compiled
def any_touches(i: int, links: np.ndarray, gait: GaitRules) -> bool:
    """Returns whether any of these links touches the ground."""
    for link in links:
        if touches(i, link, gait):
            return True
    return False


@compiled
def look(i: int, rules: Rules) -> None:
    """Tests whether the episode has failed."""
    state, body, physics = rules.state, rules.body, rules.gait.physics
    state.down[i] *= CONTACT_DECAY
    if any_touches(i, rules.options.fall, rules.gait):
        state.down[i] += CONTACT_GAIN
    pitch = physics.qpos[i, body.qpos[2]]
    turn = abs((pitch + np.pi) % (2 * np.pi) - np.pi)
    backwards = rules.options.forward_only and physics.qvel[i, body.dof[0]] < 0.0
    state.fell[i] = state.down[i] > FALL_THRESHOLD or turn > TURNED or backwards
    if state.age[i] % _PATIENCE_STEPS == 0:
        x, z = physics.qpos[i, body.qpos[0]], physics.qpos[i, body.qpos[1]]
        moved = math.hypot(x - state.milestone[i, 0], z - state.milestone[i, 1])
        state.stuck[i] = moved < PROGRESS
        state.milestone[i, 0], state.milestone[i, 1] = x, z
    diverged = breaks_down(i, rules)
    rules.outcome.failed[i] = state.fell[i] or state.stuck[i] or diverged


@compiled
def breaks_down(i: int, rules: Rules) -> bool:
    """Returns whether a simulation diverged or left its ground: it keeps the last observation."""
    joints = rules.body.dof[3:]
    diverged = (
        native.diverged(i, rules.engine)
        or native.too_fast(i, joints, MAX_JOINT_SPEED, rules.gait.physics.qvel)
        or is_lost(i, rules.body, rules.gait.physics, rules.ground)
    )
    rules.outcome.diverged[i] = diverged
    return diverged


@compiled
def finish_step(i: int, rules: Rules) -> None:
    """Computes reward, failure and observation of a step that is over."""
    state, outcome = rules.state, rules.outcome
    state.duration[i] = CONTROL_TIMESTEP * state.lasted[i]
    state.stumbling[i] = CONTROL_TIMESTEP * state.stumbled[i]
    outcome.diverged[i] |= native.diverged(i, rules.engine) or is_lost(
        i, rules.body, rules.gait.physics, rules.ground
    )
    failed = outcome.failed[i] or outcome.diverged[i]
    if outcome.diverged[i]:
        state.fell[i] = state.stuck[i] = False
    else:
        reward(i, rules)
        observe(i, rules)
    conclude(i, failed, outcome)


@compiled
def reward(i: int, rules: Rules) -> None:
    """Writes the reward terms, from mean speed and stumbling time of the cycle."""
    state, options, terms, outcome = rules.state, rules.options, rules.terms, rules.outcome
    travelled = rules.gait.physics.subtree_com[i, rules.body.links[0], 0] - state.start[i]
    speed = travelled / (CONTROL_TIMESTEP * state.lasted[i])
    off = speed - options.target_speed
    share = state.stumbled[i] / state.lasted[i]
    if speed < 0.0 and not options.backward_reward:
        give(i, 0.0, terms.speed, outcome)
        give(i, 0.0, terms.stumble, outcome)
        return
    score(i, off * off, terms.speed, outcome)
    column = terms.stumble.column
    outcome.reward_terms[i, column] = terms.stumble.weight / (1 + STUMBLE_SHARPNESS * share)


@compiled
def observe(i: int, rules: Rules) -> None:
    """Writes the observation, with the stance leg first."""
    options, body, physics = rules.options, rules.body, rules.gait.physics
    measured, observation = rules.measured, rules.outcome.observation
    measure(i, body, physics, rules.ground, measured, rules.measurement)
    stance = rules.gait.state.stance[i]
    for k in range(options.columns.shape[1]):
        observation[i, k] = measured[i, options.columns[stance, k]]
    if options.pitch >= 0:
        observation[i, options.pitch] = physics.qpos[i, body.qpos[2]]
        observation[i, options.pitch_rate] = physics.qvel[i, body.dof[2]]


def observed_blocks(
    measured: tuple[Block, ...], spec: CharacterSpec, parameters: Parameters
) -> tuple[Block, ...]:
    """Returns the blocks that `observe` writes, from those that `measure` writes."""
    terrain, pose, velocity = measured
    stance = '; the stance leg first, then the swing leg' if spec.mirror else ''
    pitch = stance or '; the last z is replaced by the pitch of the root (rad)'
    rate = stance or '; the last z is replaced by the pitch rate of the root (rad/s)'
    return (
        terrain,
        dataclasses.replace(
            pose, size=pose.size - 2, meaning='root height above the ground; then x, z of each other link '
            f'centre from the root{pitch if parameters.observe_pitch else stance}',
        ),
        dataclasses.replace(
            velocity, meaning=f'{velocity.meaning}{rate if parameters.observe_pitch else stance}'
        ),
    )  # fmt: skip


@compiled
def begin_episode(i: int, rules: Rules) -> None:
    """Resets state machine, outcome and state of the task."""
    state, body, physics = rules.state, rules.body, rules.gait.physics
    gaits.begin(i, rules.options.action_offset, rules.gait)
    begin(i, rules.outcome)
    state.going[i], state.waiting[i] = False, True
    state.lasted[i] = state.stumbled[i] = state.age[i] = 0
    state.down[i] = state.duration[i] = state.stumbling[i] = 0.0
    state.fell[i] = state.stuck[i] = False
    state.milestone[i, 0] = physics.qpos[i, body.qpos[0]]
    state.milestone[i, 1] = physics.qpos[i, body.qpos[1]]


# Loops over simulations; they take packs.


@compiled
def begin_steps(env_ids: np.ndarray, action: np.ndarray, rules: Rules) -> None:
    """Begins steps."""
    for i in env_ids:
        begin_step(i, action, rules)


@compiled
def run(env_ids: np.ndarray, watched: bool, rules: Rules) -> int:
    """Continues steps; returns how many were interrupted."""
    interrupted = 0
    for i in env_ids:
        rules.interruption[i] = go_on(i, watched, rules)
        interrupted += rules.interruption[i] != _OVER
    return interrupted


@compiled
def finish_steps(env_ids: np.ndarray, rules: Rules) -> None:
    """Finishes steps."""
    for i in env_ids:
        finish_step(i, rules)


@compiled
def observe_all(env_ids: np.ndarray, fresh: bool, rules: Rules) -> None:
    """Writes observations; if `fresh`, episodes have just begun, and their state is reset."""
    for i in env_ids:
        if fresh:
            begin_episode(i, rules)
        observe(i, rules)
