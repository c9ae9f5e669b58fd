"""Gait tasks: compiled functions of one simulation."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, NamedTuple

import numpy as np

from trl_suite.bodies.blocks import Block
from trl_suite.bodies.body import BodyData
from trl_suite.bodies.planar import has_diverged, has_left, measure, observe_body
from trl_suite.bodies.reference import CONTROL_TIMESTEP
from trl_suite.bodies.state import FLAG, POINT, REAL, WHOLE
from trl_suite.characters import CharacterSpec
from trl_suite.controllers import GAIT_TIMESTEP, gaits
from trl_suite.controllers.gaits import GaitData, touches
from trl_suite.controllers.parameters import Parameters
from trl_suite.engine import native
from trl_suite.tasks.rewards import (
    FALL_THRESHOLD,
    Outcome,
    Term,
    conclude,
    give,
    sample_fall,
    score,
)
from trl_suite.util.compiled import compiled

SAMPLES, BEHIND, AHEAD = 200, 0.5, 10.0  # number of observed ground heights, and their range, m
SUBSTEPS = 2  # physics steps, of 1/1200 s, per control step of 1/600 s
LONGEST_CYCLE = 50  # control timesteps
UPSTREAM_CENTRE = 3.0  # m; boundary of the original's first two segments of ground
INTERFACES = ('parameters', 'base_action')

# Conditions of failure, tested every SAMPLE.
SAMPLE = 0.1  # s
TURNED = 0.8 * np.pi  # rad; largest pitch
PATIENCE, PROGRESS = 5.0, 0.5  # s, m; least distance of the root in a time
MAX_UNDAMPED_SPEED = 1000.0  # rad/s; joints of gaits have no damping, and turn faster than others

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

_FRAME_STEPS = round(CONTROL_TIMESTEP / GAIT_TIMESTEP)
_SAMPLE_STEPS = round(SAMPLE / GAIT_TIMESTEP)
_PATIENCE_STEPS = round(PATIENCE / GAIT_TIMESTEP)
# Why `go_on` returns: the step is over; Python must move the ground window, or call `watch`.
OVER, GROUND, WATCH = range(3)


class GaitTaskState(NamedTuple):
    """State of the task for each simulation, (n,); times are in control steps.

    Attributes:
      action: clipped action, (n, k).
      going: whether the current step is not over.
      lasted, stumbled: duration of the step, and time with a stumble link on the ground in it.
      age: time since the start of the episode.
      start: x of the centre of mass at the beginning of the step, m.
      down: decaying average of samples with a fall link on the ground.
      milestone: x and z of the root at the last test of progress, (n, 2) m.
      fell, stuck: whether the episode has ended with a fall, or without progress.
      distance: x of the root, m; of a diverged episode the last that was observed.
      duration, stumbling: `lasted` and `stumbled` of the last finished step, s.
    """

    action: np.ndarray
    going: np.ndarray = FLAG
    lasted: np.ndarray = WHOLE
    stumbled: np.ndarray = WHOLE
    age: np.ndarray = WHOLE
    start: np.ndarray = REAL
    down: np.ndarray = REAL
    milestone: np.ndarray = POINT
    fell: np.ndarray = FLAG
    stuck: np.ndarray = FLAG
    distance: np.ndarray = REAL
    duration: np.ndarray = REAL
    stumbling: np.ndarray = REAL


class GaitTaskData(NamedTuple):
    """Data for the compiled functions of gait tasks.

    Attributes:
      body: the body, which writes its blocks to `body.observation`, (n, ...).
      terms: the reward terms.
      interruption: why `go_on` returned last, (n,).
      by_cycle: whether a step is a cycle, not a frame of 1/30 s.
      substeps: physics steps per control step.
      action_offset: parameters of the gait at action 0, (P,).
      action_scale: change of the parameters that actions set, per unit action, (k,).
      places: indices of these parameters, (k,).
      base_actions: parameters of the base actions, (B, P).
      fall, stumble: numbers of links whose ground contact is a fall, or reduces the reward.
      forward_only: whether moving backwards is a fall.
      backward_reward: whether the reward of a cycle with negative speed can be positive.
      target_speed: m/s.
      sources: columns of `body.observation` that are copied to the observation, by stance leg, (2, size).
      pitch, pitch_rate: columns of the observation for pitch and its rate; -1: not observed.
    """

    body: BodyData
    gait: GaitData
    terms: Any
    interruption: np.ndarray
    state: GaitTaskState
    outcome: Outcome
    by_cycle: bool
    substeps: int
    action_offset: np.ndarray
    action_scale: np.ndarray
    places: np.ndarray
    base_actions: np.ndarray
    fall: np.ndarray
    stumble: np.ndarray
    forward_only: bool
    backward_reward: bool
    target_speed: float
    sources: np.ndarray
    pitch: int
    pitch_rate: int


# A step of simulation i.


@compiled
def set_gait(i: int, data: GaitTaskData) -> None:
    """Begins a cycle with the parameters of the current action."""
    action, vector = data.state.action, data.gait.state.vector
    if data.by_cycle:
        for k in range(len(data.action_offset)):
            vector[i, k] = data.action_offset[k]
        for k in range(len(data.places)):
            vector[i, data.places[k]] += data.action_scale[k] * action[i, k]
    else:
        choice = 0
        for k in range(1, len(data.base_actions)):
            if action[i, k] > action[i, choice]:
                choice = k
        for k in range(len(data.action_offset)):
            vector[i, k] = data.base_actions[choice, k]
    gaits.begin_cycle(i, data.gait)


@compiled
def go_on(i: int, watched: bool, data: GaitTaskData) -> int:
    """Continues a step until it is over or interrupted; returns the reason."""
    state = data.state
    while state.going[i]:
        if state.lasted[i] % _FRAME_STEPS == 0 and has_left(i, data.body):
            return GROUND
        gaits.act(i, data.gait)
        # The actuators of these joints take torques.
        for k in range(data.gait.scratch.torque.shape[1]):
            data.body.ctrl[i, data.body.drive.first + k] = data.gait.scratch.torque[i, k]
        native.step(i, data.substeps, data.body.engine)
        ended = gaits.advance(i, data.gait)
        account(i, data)
        if data.by_cycle:
            over = ended or state.lasted[i] == LONGEST_CYCLE * _FRAME_STEPS
        else:
            over = state.lasted[i] == _FRAME_STEPS
            if ended:
                set_gait(i, data)
        state.going[i] = not (over or data.outcome.failed[i])
        if watched and i == 0 and state.age[i] % _FRAME_STEPS == 0:
            return WATCH
    return OVER


@compiled
def account(i: int, data: GaitTaskData) -> None:
    """Updates times, stumbling and failure after a control step."""
    state = data.state
    state.lasted[i] += 1
    state.age[i] += 1
    state.stumbled[i] += any_touches(i, data.stumble, data.gait)
    if state.age[i] % _SAMPLE_STEPS == 0:
        judge(i, data)


@compiled
def any_touches(i: int, links: np.ndarray, gait: GaitData) -> bool:
    """Returns whether any of these links touches the ground."""
    for link in links:
        if touches(i, link, gait):
            return True
    return False


@compiled
def judge(i: int, data: GaitTaskData) -> None:
    """Tests whether the episode has failed."""
    state, ids, physics = data.state, data.body.ids, data.body.physics
    sample_fall(i, any_touches(i, data.fall, data.gait), state.down)
    pitch = physics.qpos[i, ids.qpos[2]]
    turn = abs((pitch + np.pi) % (2 * np.pi) - np.pi)
    backwards = data.forward_only and physics.qvel[i, ids.dof[0]] < 0.0
    state.fell[i] = state.down[i] > FALL_THRESHOLD or turn > TURNED or backwards
    if state.age[i] % _PATIENCE_STEPS == 0:
        x, z = physics.qpos[i, ids.qpos[0]], physics.qpos[i, ids.qpos[1]]
        moved = math.hypot(x - state.milestone[i, 0], z - state.milestone[i, 1])
        state.stuck[i] = moved < PROGRESS
        state.milestone[i, 0], state.milestone[i, 1] = x, z
    diverged = has_diverged(i, MAX_UNDAMPED_SPEED, data.body)
    data.outcome.diverged[i] = diverged
    data.outcome.failed[i] = state.fell[i] or state.stuck[i] or diverged


@compiled
def reward(i: int, data: GaitTaskData) -> None:
    """Writes the reward terms, from mean speed and stumbling time of the cycle."""
    state, terms, outcome = data.state, data.terms, data.outcome
    travelled = data.body.physics.subtree_com[i, data.body.ids.links[0], 0] - state.start[i]
    speed = travelled / (GAIT_TIMESTEP * state.lasted[i])
    off = speed - data.target_speed
    share = state.stumbled[i] / state.lasted[i]
    if speed < 0.0 and not data.backward_reward:
        give(i, 0.0, terms.speed, outcome)
        give(i, 0.0, terms.stumble, outcome)
        return
    score(i, off * off, terms.speed, outcome)
    column = terms.stumble.column
    outcome.reward_terms[i, column] = terms.stumble.weight / (1 + STUMBLE_SHARPNESS * share)


@compiled
def observe(i: int, data: GaitTaskData) -> None:
    """Writes the observation, with the stance leg first."""
    ids, physics = data.body.ids, data.body.physics
    measured, observation = data.body.observation, data.outcome.observation
    data.state.distance[i] = physics.qpos[i, ids.qpos[0]]
    measure(i, data.body)
    observe_body(i, data.body.columns, data.body, measured)
    stance = data.gait.state.stance[i]
    for k in range(data.sources.shape[1]):
        observation[i, k] = measured[i, data.sources[stance, k]]
    if data.pitch >= 0:
        observation[i, data.pitch] = physics.qpos[i, ids.qpos[2]]
        observation[i, data.pitch_rate] = physics.qvel[i, ids.dof[2]]


def observed_blocks(
    measured: tuple[Block, ...], spec: CharacterSpec, parameters: Parameters
) -> tuple[Block, ...]:
    """Returns the blocks that `observe` writes, from those that `observe_body` writes."""
    terrain, pose, velocity, _ = measured
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


# Loops over simulations; they take packs.


@compiled
def begin_episodes(env_ids: np.ndarray, data: GaitTaskData) -> None:
    """Begins the gaits of episodes, after bodies were placed, and writes observations."""
    ids, qpos, milestone = data.body.ids, data.body.physics.qpos, data.state.milestone
    for i in env_ids:
        gaits.begin(i, data.action_offset, data.gait)
        milestone[i, 0], milestone[i, 1] = qpos[i, ids.qpos[0]], qpos[i, ids.qpos[1]]
        observe(i, data)


@compiled
def begin_steps(env_ids: np.ndarray, action: np.ndarray, data: GaitTaskData) -> None:
    """Begins steps; an action sets the gait of a cycle that begins with its step.

    With the interface 'base_action', only the first cycle of an episode does; `go_on` begins the others.
    """
    state, root = data.state, data.body.ids.links[0]
    for i in env_ids:
        for k in range(state.action.shape[1]):
            state.action[i, k] = min(max(action[i, k], -1.0), 1.0)
        state.lasted[i] = state.stumbled[i] = 0
        state.going[i] = True
        state.start[i] = data.body.physics.subtree_com[i, root, 0]
        if data.by_cycle or state.age[i] == 0:
            set_gait(i, data)


@compiled
def run(env_ids: np.ndarray, watched: bool, data: GaitTaskData) -> int:
    """Continues steps; returns how many were interrupted."""
    interrupted = 0
    for i in env_ids:
        data.interruption[i] = go_on(i, watched, data)
        interrupted += data.interruption[i] != OVER
    return interrupted


@compiled
def finish_steps(env_ids: np.ndarray, data: GaitTaskData) -> None:
    """Computes reward, failure and observation of steps that are over."""
    state, outcome = data.state, data.outcome
    for i in env_ids:
        state.duration[i] = GAIT_TIMESTEP * state.lasted[i]
        state.stumbling[i] = GAIT_TIMESTEP * state.stumbled[i]
        # `judge` tests joint speeds, every SAMPLE; here, whether the state can be observed.
        outcome.diverged[i] |= has_diverged(i, math.inf, data.body)
        failed = outcome.failed[i] or outcome.diverged[i]
        if outcome.diverged[i]:  # keeps the last finite observation
            state.fell[i] = state.stuck[i] = False
        else:
            reward(i, data)
            observe(i, data)
        conclude(i, failed, outcome)


@compiled
def observe_all(env_ids: np.ndarray, data: GaitTaskData) -> None:
    """Writes observations."""
    for i in env_ids:
        observe(i, data)
