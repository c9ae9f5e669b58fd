"""The TerrainRL family: an agent sets the parameters of a gait once per cycle.

One step of the environment is one gait cycle: it ends with the cycle, with a fall inside it, or after
`LONGEST_CYCLE`. A user who discounts by time raises gamma to `info['duration']` / their own unit;
the environment's discount is 0 after a fall and 1 otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from trl_suite import actuation, errors
from trl_suite.action_map import ActionMap
from trl_suite.arenas import PlanarTerrain
from trl_suite.characters import Character
from trl_suite.controllers import CONTROL_TIMESTEP, Gait, dynamics, gaits, load
from trl_suite.controllers.machine import GaitRules, touches
from trl_suite.engine import World, native
from trl_suite.kinematics.planar import (
    PlanarBody,
    PlanarFigure,
    PlanarMeasurement,
    leaves,
    measure,
    must_wait,
)
from trl_suite.kinematics.planar_reference import link_extents
from trl_suite.tasks.task import (
    Outcome,
    Task,
    begin,
    check_simulated,
    conclude,
    consecutive,
    drawn_seed,
    outcome,
    too_fast,
)
from trl_suite.terrain import Strip
from trl_suite.terrain.planar_ground import PlanarGround
from trl_suite.util.compiled import compiled, compiled_loop, packed

SAMPLES, BEHIND, AHEAD = 200, 0.5, 10.0  # ground heights seen, and over which stretch, m
SUBSTEPS = 2  # physics steps per control step: 1/1200 s
FRAME = 1 / 30  # s; nominal control step, and the real one with interface 'base_action'
LONGEST_CYCLE = 50  # frames
UPSTREAM_CENTRE = 3.0  # m; where the original's first two stretches of ground meet
INTERFACES = ('parameters', 'base_action')

# Falls, all looked at every SAMPLE.
SAMPLE = 0.1  # s
FADING, SHARE, FALLEN = 0.9, 1 / 11, 0.25  # of the running share of samples with a fall link down
TURNED = 0.8 * np.pi  # rad
PATIENCE, PROGRESS = 5.0, 0.5  # s, m; who moves less than that in that time is stuck
MAX_JOINT_SPEED = 1000.0  # rad/s; feet whip: there is no damping in these joints

# Reward of a cycle: weight * exp(-0.5 (v - target)^2) + weight / (1 + 10 share of time stumbling).
SPEED_SHARPNESS, STUMBLE_SHARPNESS = 0.5, 10.0
TERMS = ('speed', 'stumble')
SPEED, STUMBLE = range(len(TERMS))

_FRAME_STEPS = round(FRAME / CONTROL_TIMESTEP)
_SAMPLE_STEPS = round(SAMPLE / CONTROL_TIMESTEP)
_PATIENCE_STEPS = round(PATIENCE / CONTROL_TIMESTEP)
_OVER, _GROUND, _LOOK = range(3)  # why a step is interrupted: not at all, for ground, for `watch`


class GaitTaskState(NamedTuple):
    """What the task remembers of each simulation, (n,); times are in control steps.

    Attributes:
      action: in [-1, 1], (n, k).
      going: whether the current step is not over.
      waiting: whether a gait's cycle is over and wants parameters.
      lasted, stumbled: time of the last step, and that with a link on the ground that should not be.
      age: time in the episode.
      start: where the centre of mass was at the beginning of the step, m.
      down: running share of samples with a fall link on the ground.
      milestone: x and z of the root at the last test of progress, (n, 2) m.
      fell, stuck: how the episode has ended.
      duration, stumbling: the times in s, of steps that are finished.
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
    """What tells one task from another.

    Attributes:
      by_cycle: whether a step is a cycle, not a frame.
      substeps: physics steps per control step.
      centre: parameters of the gait at action 0, (P,).
      half_range: what action 1 adds to those that actions set, (k,).
      places: which these are, (k,).
      base_actions: parameters that a preference chooses, (B, P).
      controls: addresses of the joints' torques in ctrl, (J,).
      fall, stumble: numbers of links that must not touch the ground, or should not.
      forward_only: whether moving backwards is a fall.
      backward_reward: whether a cycle backwards earns anything.
      target_speed: m/s.
      weights: of the reward terms, (2,).
      columns: of the measurement, which make an observation, by stance leg, (2, size).
      pitch, pitch_rate: columns of the observation that they take, -1 for none.
    """

    by_cycle: bool
    substeps: int
    centre: np.ndarray
    half_range: np.ndarray
    places: np.ndarray
    base_actions: np.ndarray
    controls: np.ndarray
    fall: np.ndarray
    stumble: np.ndarray
    forward_only: bool
    backward_reward: bool
    target_speed: float
    weights: np.ndarray
    columns: np.ndarray
    pitch: int
    pitch_rate: int


class Rules(NamedTuple):
    """All that the rules of gait tasks work on.

    Attributes:
      ctrl: controls of the physics, (n, ...).
      measured: terrain, pose and velocity as `measure` writes them, (n, ...).
      interruption: why the step of each was interrupted, (n,).
    """

    engine: native.Engine
    body: PlanarBody
    ground: PlanarGround
    gait: GaitRules
    ctrl: np.ndarray
    options: Options
    measured: np.ndarray
    interruption: np.ndarray
    found: PlanarMeasurement
    state: GaitTaskState
    outcome: Outcome


# A step of simulation i, in order.


@compiled
def begin_step(i: int, action: np.ndarray, rules: Rules) -> None:
    """Takes an action; it sets the gait of the cycle that begins."""
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
    """Begins a cycle with the parameters that the action means."""
    options, action, vector = rules.options, rules.state.action, rules.gait.state.vector
    rules.state.waiting[i] = False
    if options.by_cycle:
        for k in range(len(options.centre)):
            vector[i, k] = options.centre[k]
        for k in range(len(options.places)):
            vector[i, options.places[k]] += options.half_range[k] * action[i, k]
    else:
        choice = 0
        for k in range(1, len(options.base_actions)):
            if action[i, k] > action[i, choice]:
                choice = k
        for k in range(len(options.centre)):
            vector[i, k] = options.base_actions[choice, k]
    gaits.apply(i, rules.gait)


@compiled
def go_on(i: int, watched: bool, rules: Rules) -> int:
    """Goes on with a step until it is over, or is interrupted; returns why."""
    state, options = rules.state, rules.options
    while state.going[i]:
        if state.lasted[i] % _FRAME_STEPS == 0 and leaves(
            i, rules.body, rules.gait.physics, rules.ground, rules.found
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
    """Time, stumbling and falls after a control step."""
    state = rules.state
    state.lasted[i] += 1
    state.age[i] += 1
    state.stumbled[i] += any_touches(i, rules.options.stumble, rules.gait)
    if state.age[i] % _SAMPLE_STEPS == 0:
        look(i, rules)


@compiled
def any_touches(i: int, links: np.ndarray, gait: GaitRules) -> bool:
    """Whether any of some links touches the ground."""
    for link in links:
        if touches(i, link, gait):
            return True
    return False


@compiled
def look(i: int, rules: Rules) -> None:
    """Looks whether the episode has failed."""
    state, body, physics = rules.state, rules.body, rules.gait.physics
    state.down[i] *= FADING
    if any_touches(i, rules.options.fall, rules.gait):
        state.down[i] += SHARE
    pitch = physics.qpos[i, body.qpos[2]]
    turn = abs((pitch + np.pi) % (2 * np.pi) - np.pi)
    backwards = rules.options.forward_only and physics.qvel[i, body.dof[0]] < 0.0
    state.fell[i] = state.down[i] > FALLEN or turn > TURNED or backwards
    if state.age[i] % _PATIENCE_STEPS == 0:
        x, z = physics.qpos[i, body.qpos[0]], physics.qpos[i, body.qpos[1]]
        moved = math.hypot(x - state.milestone[i, 0], z - state.milestone[i, 1])
        state.stuck[i] = moved < PROGRESS
        state.milestone[i, 0], state.milestone[i, 1] = x, z
    diverged = breaks_down(i, rules)
    rules.outcome.failed[i] = state.fell[i] or state.stuck[i] or diverged


@compiled
def breaks_down(i: int, rules: Rules) -> bool:
    """Whether the physics has diverged; the last finite observation then stands."""
    joints = rules.body.dof[3:]
    diverged = native.diverged(i, rules.engine) or too_fast(
        i, joints, MAX_JOINT_SPEED, rules.gait.physics.qvel
    )
    rules.outcome.diverged[i] = diverged
    return diverged


@compiled
def finish_step(i: int, rules: Rules) -> None:
    """Reward, failure and observation of a step that is over."""
    state, outcome = rules.state, rules.outcome
    state.duration[i] = CONTROL_TIMESTEP * state.lasted[i]
    state.stumbling[i] = CONTROL_TIMESTEP * state.stumbled[i]
    outcome.diverged[i] |= native.diverged(i, rules.engine)
    failed = outcome.failed[i] or outcome.diverged[i]
    if outcome.diverged[i]:
        state.fell[i] = state.stuck[i] = False
    else:
        reward(i, rules)
        observe(i, rules)
    conclude(i, failed, outcome)


@compiled
def reward(i: int, rules: Rules) -> None:
    """Writes the reward terms: speed, and how long it has not stumbled."""
    state, options, terms = rules.state, rules.options, rules.outcome.reward_terms
    travelled = rules.gait.physics.subtree_com[i, rules.body.links[0], 0] - state.start[i]
    speed = travelled / (CONTROL_TIMESTEP * state.lasted[i])
    off = speed - options.target_speed
    share = state.stumbled[i] / state.lasted[i]
    terms[i, SPEED] = options.weights[SPEED] * math.exp(-SPEED_SHARPNESS * (off * off))
    terms[i, STUMBLE] = options.weights[STUMBLE] / (1 + STUMBLE_SHARPNESS * share)
    if speed < 0.0 and not options.backward_reward:
        terms[i, SPEED] = terms[i, STUMBLE] = 0.0


@compiled
def observe(i: int, rules: Rules) -> None:
    """Writes the observation: the swing leg comes last."""
    options, body, physics = rules.options, rules.body, rules.gait.physics
    measured, observation = rules.measured, rules.outcome.observation
    measure(i, body, physics, rules.ground, measured, rules.found)
    stance = rules.gait.state.stance[i]
    for k in range(options.columns.shape[1]):
        observation[i, k] = measured[i, options.columns[stance, k]]
    if options.pitch >= 0:
        observation[i, options.pitch] = physics.qpos[i, body.qpos[2]]
        observation[i, options.pitch_rate] = physics.qvel[i, body.dof[2]]


@compiled
def begin_episode(i: int, rules: Rules) -> None:
    """Puts machine, outcome and what the task remembers to their starts."""
    state, body, physics = rules.state, rules.body, rules.gait.physics
    gaits.begin(i, rules.options.centre, rules.gait)
    begin(i, rules.outcome)
    state.going[i], state.waiting[i] = False, True
    state.lasted[i] = state.stumbled[i] = state.age[i] = 0
    state.down[i] = state.duration[i] = state.stumbling[i] = 0.0
    state.fell[i] = state.stuck[i] = False
    state.milestone[i, 0] = physics.qpos[i, body.qpos[0]]
    state.milestone[i, 1] = physics.qpos[i, body.qpos[1]]


# Loops over simulations; they take packs.


@compiled_loop
def begin_steps(env_ids: np.ndarray, action: np.ndarray, rules: Rules) -> None:
    """Takes actions."""
    for i in env_ids:
        begin_step(i, action, rules)


@compiled_loop
def run(env_ids: np.ndarray, watched: bool, rules: Rules) -> int:
    """Goes on with steps; returns how many were interrupted."""
    interrupted = 0
    for i in env_ids:
        rules.interruption[i] = go_on(i, watched, rules)
        interrupted += rules.interruption[i] != _OVER
    return interrupted


@compiled_loop
def finish_steps(env_ids: np.ndarray, rules: Rules) -> int:
    """Finishes the steps of all that can be measured; returns how many have to wait."""
    waiting = 0
    for i in env_ids:
        rules.found.waiting[i] = must_wait(i, rules.body, rules.gait.physics, rules.ground)
        if rules.found.waiting[i]:
            waiting += 1
        else:
            finish_step(i, rules)
    return waiting


@compiled_loop
def observe_all(env_ids: np.ndarray, fresh: bool, rules: Rules) -> int:
    """Observes all that can be measured, at their starts if they are; returns how many wait."""
    waiting = 0
    for i in env_ids:
        rules.found.waiting[i] = must_wait(i, rules.body, rules.gait.physics, rules.ground)
        if rules.found.waiting[i]:
            waiting += 1
            continue
        if fresh:
            begin_episode(i, rules)
        observe(i, rules)
    return waiting


class GaitTask(Task):
    """Travel at the target speed by setting a gait's parameters.

    Observation blocks: 'terrain', 200 ground heights from 0.5 m behind to 10 m ahead of the root,
    relative to the ground under it; 'pose', height of the root and (x, z) of every other link
    relative to it; 'velocity', (x, z) of every link. Bipeds show the leg that is to swing last; of
    the hopper's last link z becomes the root's pitch in pose and its rate in velocity.

    Attributes:
      gait: the state machines.
      state: what the task remembers, after `bind`.
      watch: called at every multiple of 1/30 s of the first simulation's episode, within steps too;
        for pictures.
    """

    state: GaitTaskState
    fields = dynamics.FIELDS
    watch: Callable[[], None] | None = None

    def __init__(
        self,
        character: Character,
        arena: PlanarTerrain,
        *,
        interface: str = 'parameters',
        base_actions: str = 'default',
        substeps: int = SUBSTEPS,
        spawn: str = 'intended',
        blend: float = 0.0,
        start_noise: float = 0.0,
    ) -> None:
        """Attaches character and gait to an arena.

        Args:
          character: one with a gait, see `trl_suite.controllers.available`.
          arena: planar terrain.
          interface: 'parameters': a step is a cycle, and an action sets the gait's parameters, 0 the
            default and +-1 the largest deviation of any base action. 'base_action': a step is 1/30
            s, and an action is one preference per base action, of which the largest counts when
            the next cycle begins.
          base_actions: 'default', or 'original': those of the papers, where the default ones are our
            own.
          substeps: physics steps per control step of 1/600 s.
          spawn: where the ground begins, see `trl_suite.terrain.Strip`.
          blend: which of the terrain's parameter sets.
          start_noise: standard deviation that is added to the joints' angles (rad) at the start,
            and ten times that to their rates and to the speed (m/s).

        Raises:
          ValueError: no gait drives the character, or an option makes no sense.
        """
        if interface not in INTERFACES:
            raise ValueError(errors.unknown('interface', interface, INTERFACES))
        if int(substeps) != substeps or substeps < 1:
            raise ValueError(f'substeps is {substeps}; expected a positive integer')
        if not 0 <= start_noise < np.inf:
            raise ValueError(f'start_noise is {start_noise}; expected 0 or a positive number')
        self.character, self.arena, self.interface = character, arena, interface
        self.figure = PlanarFigure(character, arena, BEHIND, AHEAD, SAMPLES)
        parameters = load(character.row.name, base_actions)
        self.gait = Gait(character, arena.ground_body, arena.mjcf_model, parameters)
        self._spawn, self._blend, self._noise = spawn, blend, float(start_noise)
        self._control_substeps = int(substeps)
        timestep = CONTROL_TIMESTEP / substeps
        self.set_timesteps(FRAME, timestep)
        actuation.add(character, 'torque', timestep)
        for joint in character.joints:  # the gaits were tuned without
            joint.damping = joint.armature = 0
        if interface == 'parameters':
            names = tuple(parameters.names[i] for i in parameters.actions)
            self.action_map = ActionMap(
                names, 'gait parameter', 'rad, m, N or 1', parameters.centre[parameters.actions],
                parameters.half_range[parameters.actions],
            )  # fmt: skip
        else:
            count = len(parameters.base_actions)
            self.action_map = ActionMap(
                tuple(f'base_action_{i}' for i in range(count)), 'preference', '1',
                np.zeros(count), np.ones(count),
            )  # fmt: skip
        links = len(character.row.links)
        self.blocks = consecutive({
            'terrain': SAMPLES, 'pose': 2 * links - 1, 'velocity': 2 * links,
        })  # fmt: skip

    @property
    def root_entity(self) -> PlanarTerrain:
        return self.arena

    @property
    def signature(self) -> str:
        parts = self.character.row.name, self.arena.terrain.name, self.interface
        return f'{super().signature} of {" / ".join(parts)}'

    def bind(self, world: World) -> None:
        self.world, n = world, world.n
        figure, gait = self.figure, self.gait
        blocks = consecutive(figure.blocks)
        figure.bind(world, blocks)
        gait.bind(world)
        parameters = gait.parameters
        options = self._options(figure.body)
        self.state = GaitTaskState(
            action=np.zeros((n, len(self.action_map))),
            going=np.zeros(n, bool),
            waiting=np.zeros(n, bool),
            lasted=np.zeros(n, int),
            stumbled=np.zeros(n, int),
            age=np.zeros(n, int),
            start=np.zeros(n),
            down=np.zeros(n),
            milestone=np.zeros((n, 2)),
            fell=np.zeros(n, bool),
            stuck=np.zeros(n, bool),
            duration=np.zeros(n),
            stumbling=np.zeros(n),
        )
        size = max(part.stop for part in self.blocks.values())
        self.outcome = outcome(n, size, len(parameters.reward))
        self.saved = (self.state, gait.state, self.outcome)
        self.info_arrays = {
            'reward_terms': dict(zip(parameters.reward, self.reward_terms.T, strict=True)),
            'fell': self.state.fell,
            'stuck': self.state.stuck,
            'diverged': self.outcome.diverged,
            'distance': world.qpos[:, figure.pose_qpos[0]],
            'duration': self.state.duration,
            'stumbled': self.state.stumbling,
        }
        self.rules = Rules(
            world.engine, figure.body, figure.ground, gait.rules, world.ctrl, options,
            np.zeros((n, sum(figure.blocks.values()))), np.zeros(n, int), figure.measurement(),
            self.state, self.outcome,
        )  # fmt: skip
        self._pack = packed(self.rules)
        self._start = self._start_pose()

    def _options(self, body: PlanarBody) -> Options:
        parameters, row = self.gait.parameters, self.character.row
        scope = f'{self.character.mjcf_model.model}/'
        controls = self.world.control_addresses([scope + name for name in row.joints])
        fall = [self.gait.link[name] for name in row.fall_links]
        stumble = [i for i, name in enumerate(row.links) if name not in row.stumble_exempt]
        pitch = parameters.observe_pitch
        return Options(
            by_cycle=self.interface == 'parameters',
            substeps=self._control_substeps,
            centre=parameters.centre.copy(),
            half_range=parameters.half_range[parameters.actions],
            places=parameters.actions,
            base_actions=parameters.base_actions,
            controls=controls,
            fall=np.array(fall),
            stumble=np.array(stumble),
            forward_only=parameters.forward_only,
            backward_reward=parameters.backward_reward,
            target_speed=float(parameters.target_speed),
            weights=np.array([parameters.reward[name] for name in TERMS]),
            columns=self._columns(body),
            pitch=self.blocks['pose'].stop - 1 if pitch else -1,
            pitch_rate=self.blocks['velocity'].stop - 1 if pitch else -1,
        )

    def _columns(self, body: PlanarBody) -> np.ndarray:
        """Columns of the measurement that make an observation, by stance leg, (2, size)."""
        links = self.character.row.links
        order = np.arange(len(links))
        mirrored = order.copy()
        for right, left in self.character.row.mirror:
            i, j = links.index(right), links.index(left)
            mirrored[i], mirrored[j] = j, i
        arranged = []
        for each in (order, mirrored):
            pairs = 2 * each[:, None] + np.arange(2)
            arranged.append(np.concatenate([
                np.arange(SAMPLES) + body.terrain, [body.pose],
                (pairs[1:] + body.pose + 1).ravel(), (pairs + body.velocity).ravel(),
            ]))  # fmt: skip
        return np.array(arranged)

    def _start_pose(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pose and rates of the first instant, (1, D), and extents of the geoms, (1, 3, G)."""
        start, figure = self.gait.parameters.start, self.figure
        pose, rates = np.zeros((2, 1, len(figure.pose_qpos)))
        pose[0, 1:3], rates[0, :3] = (start['height'], start['pitch']), start['velocity']
        for name, (angle, rate) in start['joints'].items():
            pose[0, 3 + self.gait.number[name]] = angle
            rates[0, 3 + self.gait.number[name]] = rate
        data = self.world.posed(figure.pose_qpos, pose[0])
        root = data.xpos[figure.links[0]][::2]
        extents = link_extents(self.world.models[0], data, figure.geoms, root)
        return pose, rates, extents[None]

    def reset(self, env_ids: np.ndarray, random_states: Sequence[np.random.RandomState]) -> None:
        poses, rates, extents = (np.repeat(part, len(env_ids), axis=0) for part in self._start)
        for k, (i, random_state) in enumerate(zip(env_ids.tolist(), random_states, strict=True)):
            noise = self._noise * random_state.standard_normal((2, poses.shape[1] - 3))
            push = self._noise * random_state.standard_normal()
            poses[k, 3:] += noise[0]
            rates[k, 3:] += 10 * noise[1]
            rates[k, 0] += 10 * push
            strip = Strip(
                self.arena.terrain,
                drawn_seed(random_state),
                blend=self._blend,
                spawn=self._spawn,
                centre=UPSTREAM_CENTRE,
            )
            self.arena.begin_episode(i, strip)
        self.figure.place(env_ids, poses, rates, extents)
        self._observe(env_ids, True)

    def apply_action(self, action: np.ndarray, env_ids: np.ndarray) -> None:
        begin_steps(env_ids, action, self._pack)

    def simulate(self, env_ids: np.ndarray) -> None:
        """Runs each simulation to the end of its cycle, or for a frame."""
        interruption = self.rules.interruption
        while run(env_ids, self.watch is not None, self._pack):
            leaving = env_ids[interruption[env_ids] == _GROUND]
            if len(leaving):
                self.figure.follow(leaving)
            if self.watch is not None and (interruption[env_ids] == _LOOK).any():
                self.watch()

    def finish_step(self, env_ids: np.ndarray) -> None:
        check_simulated(self.state.lasted[env_ids])
        if finish_steps(env_ids, self._pack):
            finish_steps(self._widened(env_ids), self._pack)

    def observe(self, env_ids: np.ndarray | None = None) -> None:
        self._observe(self.world.all_ids if env_ids is None else env_ids, False)

    def _observe(self, env_ids: np.ndarray, fresh: bool) -> None:
        if observe_all(env_ids, fresh, self._pack):
            observe_all(self._widened(env_ids), fresh, self._pack)

    def _widened(self, env_ids: np.ndarray) -> np.ndarray:
        """Draws the ground that some simulations look back on; returns which have waited for it."""
        waiting = env_ids[self.rules.found.waiting[env_ids]]
        for i in waiting.tolist():
            self.arena.widen(i)
        return waiting
