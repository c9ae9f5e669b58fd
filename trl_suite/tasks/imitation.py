"""Tracking a motion clip over planar terrain: the Imitation and PLAiD families.

Source: the imitation scenario of the original; 'Does the choice of action space matter?' (Peng &
van de Panne 2017) and 'Progressive reinforcement learning with distillation for multi-skilled
motion control' (Berseth et al. 2018).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from trl_suite import actuation, errors, hill
from trl_suite.action_map import Drive, drive
from trl_suite.arenas import PlanarTerrain
from trl_suite.characters import Character
from trl_suite.characters.muscles import PLAIN, Muscle
from trl_suite.engine import World, native
from trl_suite.kinematics.planar import (
    PlanarBody,
    PlanarFigure,
    PlanarMeasurement,
    PlanarState,
    has_fallen,
    leaves,
    measure,
    must_wait,
)
from trl_suite.kinematics.planar_reference import ClipTable, Reference, feature
from trl_suite.motion import Clip
from trl_suite.tasks import rewards
from trl_suite.tasks.task import (
    MAX_JOINT_SPEED,
    MOST_SUBSTEPS,
    Outcome,
    Task,
    begin,
    conclude,
    consecutive,
    drawn_seed,
    outcome,
    start_phases,
    too_fast,
)
from trl_suite.terrain import Strip
from trl_suite.terrain.planar_ground import PlanarGround
from trl_suite.util.compiled import compiled, compiled_loop, packed

CONTROL_TIMESTEP = 1 / 30  # s
SUBSTEPS = 10  # physics at 300 Hz; trained policies score the same from 240 to 1200 Hz
VIEW_BEHIND = 0.5  # m; where the line of terrain samples begins
VIEW_AHEAD = 3.0  # m; where it ends
MOST_SAMPLES = 10_000  # of that line
PHASE_BINS = 4
CENTRES = ('clip', 'posture', 'original')  # of position control

POSE, VELOCITY, END_EFFECTOR, COM, ROOT = range(len(rewards.IMITATION_TERMS))


class ImitationState(NamedTuple):
    """Where each simulation is in the clip, (n,).

    Attributes:
      phase: in [0, 1).
      cycles: time on the clip in periods: the phase, not wrapped.
      start: `cycles` at the start of the episode.
    """

    phase: np.ndarray
    cycles: np.ndarray
    start: np.ndarray


class Layout(NamedTuple):
    """Where things lie: columns of the clip's table, and of the observation (-1: not observed).

    Attributes:
      angles, rates, effectors, com_velocity, height, positions, phase: first columns of features.
      strain_block, phase_block, target_block: where these blocks begin.
      target: number of columns in the target block.
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
    target_block: int
    target: int


_FEATURES = Layout._fields[:7]  # that are columns of the clip's table


class Rules(NamedTuple):
    """All that the rules of imitation work on.

    Attributes:
      ctrl: controls of the physics, (n, ...).
      weights: of pitch and joints in the errors of pose and velocity, (1 + J,).
      term_weights, term_scales: of the reward terms, (5,).
      rest, scale: length of every muscle at rest, and of its fibre, m.
    """

    engine: native.Engine
    body: PlanarBody
    physics: PlanarState
    ground: PlanarGround
    clip: ClipTable
    drive: Drive
    ctrl: np.ndarray
    layout: Layout
    weights: np.ndarray
    term_weights: np.ndarray
    term_scales: np.ndarray
    rest: np.ndarray
    scale: np.ndarray
    found: PlanarMeasurement
    state: ImitationState
    outcome: Outcome


# A step of simulation i, in order.


@compiled
def finish_step(i: int, rules: Rules) -> None:
    """Reward, failure and observation, after the physics has advanced."""
    advance_clock(i, rules.clip, rules.state)
    if breaks_down(i, rules):
        conclude(i, True, rules.outcome)
        return
    measure(i, rules.body, rules.physics, rules.ground, rules.outcome.observation, rules.found)
    compare(i, rules)
    conclude(i, has_fallen(i, rules.body, rules.physics), rules.outcome)
    observe(i, rules)


@compiled
def advance_clock(i: int, clip: ClipTable, state: ImitationState) -> None:
    """Moves on along the clip by a control step."""
    state.cycles[i] += CONTROL_TIMESTEP / clip.period
    state.phase[i] = state.cycles[i] % 1.0


@compiled
def breaks_down(i: int, rules: Rules) -> bool:
    """Whether the physics has diverged; the last finite observation then stands."""
    joints = rules.body.dof[2:]
    diverged = native.diverged(i, rules.engine) or too_fast(
        i, joints, MAX_JOINT_SPEED, rules.physics.qvel
    )
    rules.outcome.diverged[i] = diverged
    return diverged


@compiled
def compare(i: int, rules: Rules) -> None:
    """Writes the reward terms: how near pose, velocities and feet are to those of the clip."""
    body, physics, clip, layout = rules.body, rules.physics, rules.clip, rules.layout
    phase, found, terms = rules.state.phase[i], rules.found, rules.outcome.reward_terms
    pose = velocity = 0.0
    for k in range(len(rules.weights)):  # pitch, then joints
        angle = physics.qpos[i, body.qpos[2 + k]] - feature(phase, layout.angles + k, clip)
        if k == 0:
            angle = rewards.wrapped(angle)
        rate = physics.qvel[i, body.dof[2 + k]] - feature(phase, layout.rates + k, clip)
        pose += rules.weights[k] * (angle * angle)
        velocity += rules.weights[k] * (rate * rate)
    end_effector, count = 0.0, found.effectors.shape[1]
    for k in range(count):
        off = found.effectors[i, k] - feature(phase, layout.effectors + k, clip)
        end_effector += off * off
    com = 0.0
    for k in range(2):
        off = found.com_velocity[i, k] - feature(phase, layout.com_velocity + k, clip)
        com += rewards.COM_ERROR_FACTOR * (off * off)
    height = found.height[i] - feature(phase, layout.height, clip)

    weights, scales = rules.term_weights, rules.term_scales
    terms[i, POSE] = rewards.term(pose, weights[POSE], scales[POSE])
    terms[i, VELOCITY] = rewards.term(velocity, weights[VELOCITY], scales[VELOCITY])
    end_effector /= count // 2
    terms[i, END_EFFECTOR] = rewards.term(end_effector, weights[END_EFFECTOR], scales[END_EFFECTOR])
    terms[i, COM] = rewards.term(com, weights[COM], scales[COM])
    terms[i, ROOT] = rewards.term(height * height, weights[ROOT], scales[ROOT])


@compiled
def observe(i: int, rules: Rules) -> None:
    """Writes the blocks behind terrain, pose and velocity: muscles, and phase or target."""
    layout, clip, observation = rules.layout, rules.clip, rules.outcome.observation
    phase = rules.state.phase[i]
    for k in range(len(rules.rest)):
        length = rules.physics.ten_length[i, k] - rules.rest[k]
        observation[i, layout.strain_block + k] = length / rules.scale[k]
    if layout.phase_block >= 0:
        for k in range(1 + PHASE_BINS):
            observation[i, layout.phase_block + k] = feature(phase, layout.phase + k, clip)
    for k in range(layout.target):
        observation[i, layout.target_block + k] = feature(phase, layout.height + k, clip)


# Loops over simulations; they take packs.


@compiled_loop
def apply_actions(env_ids: np.ndarray, action: np.ndarray, rules: Rules) -> int:
    """Takes actions; returns how many windows of ground must be laid anew."""
    leaving = 0
    for i in env_ids:
        drive(i, action, rules.drive, rules.ctrl)
        leaving += leaves(i, rules.body, rules.physics, rules.ground, rules.found)
    return leaving


@compiled_loop
def finish_steps(env_ids: np.ndarray, rules: Rules) -> int:
    """Finishes the steps of all that can be measured; returns how many have to wait."""
    waiting = 0
    for i in env_ids:
        rules.found.waiting[i] = must_wait(i, rules.body, rules.physics, rules.ground)
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
        rules.found.waiting[i] = must_wait(i, rules.body, rules.physics, rules.ground)
        if rules.found.waiting[i]:
            waiting += 1
            continue
        measure(i, rules.body, rules.physics, rules.ground, rules.outcome.observation, rules.found)
        compare(i, rules)
        observe(i, rules)
        if fresh:
            begin(i, rules.outcome)
    return waiting


class Imitation(Task):
    """A planar character tracks a looping clip over random terrain.

    Observation blocks, in this order (N links, J joints; heading frame: x is mirrored while the
    trunk points backwards, heights are relative to the ground under the root):
      terrain: heights of the ground along the line of samples, m.
      pose: height of the root, then (x, z) of every link centre relative to the root, m; 2N + 1.
      velocity: (x, z) velocity of every link centre, m/s; 2N.
      strain: fibre strain of every muscle, if the character is driven by muscles.
      phase: phase in [0, 1), then the one-hot of its quarter; 5. Or instead
      target: height of the reference's root, then its link positions relative to its root and its
        link velocities; 4N + 1.
    """

    TERMS: Mapping[str, tuple[float, float]] = rewards.IMITATION_TERMS  # weight, scale of the error
    ABOUT = 'com'  # from where end effectors are measured, or 'root'
    EXTRAS: Mapping[str, int] = MappingProxyType({})  # blocks of a subclass, with their sizes

    def __init__(
        self,
        character: Character,
        arena: PlanarTerrain,
        clip: Clip,
        *,
        actuation_model: str = 'position',
        terrain_samples: int = 0,
        target: bool = False,
        substeps: int = SUBSTEPS,
        centre: str = 'clip',
        half_range: float | None = None,
        muscle_set: str = PLAIN,
        start_phase: float | Sequence[Sequence[float]] | None = None,
        spawn: str = 'intended',
        blend: float = 0.0,
    ) -> None:
        """Composes the task.

        Args:
          character: a planar character without actuators; it is attached to the arena.
          arena: where it moves.
          clip: a looping planar clip for this character.
          actuation_model: one of `trl_suite.actuation.ACTUATIONS`.
          terrain_samples: heights observed on the line from 0.5 m behind to 3 m ahead; 0 is blind.
          target: observe the reference's state instead of the phase.
          substeps: physics steps per control step of 1/30 s.
          centre: for position control, the pose at action 0: the mean pose of the 'clip', the
            character's working 'posture', or the 'original' map, whose [-1, 1] spans four times the
            joint range about its middle.
          half_range: for position control, rad per unit action (default 1.5).
          muscle_set: for muscle control, 'plain' or the motion that the muscles were optimised for.
          start_phase: phase of every start, in [0, 1), or pairs between whose numbers it is drawn;
            drawn uniformly if None.
          spawn: where the flat start lies: 'intended' (1 m to both sides of the start) or
            'upstream' (where the original's construction puts it, depending on the start phase).
          blend: which mixture of the terrain's parameter sets to draw from.

        Raises:
          ValueError: options out of range, or a clip that does not fit the character.
        """
        self._check(character, clip, actuation_model, centre, half_range, substeps, terrain_samples)
        self.character, self.arena, self.clip = character, arena, clip
        self.actuation_model = actuation_model
        self._start_phase, self._spawn, self._blend = start_phases(start_phase), spawn, blend
        self.figure = PlanarFigure(
            character, arena, VIEW_BEHIND, VIEW_AHEAD, terrain_samples, 'contact' in self.EXTRAS
        )
        self.set_timesteps(CONTROL_TIMESTEP, CONTROL_TIMESTEP / substeps)

        options: dict[str, Any] = {}
        muscles: tuple[Muscle, ...] = ()
        if actuation_model == 'position':
            options = position_range(character, clip, centre, half_range)
        elif actuation_model == 'muscle':
            options = {'muscle_set': muscle_set}
            muscles = actuation.character_muscles(character, muscle_set)
        if muscle_set != PLAIN and not muscles:
            raise ValueError(f'muscle_set is for muscle control, not for {actuation_model} control')
        self.action_map = actuation.add(
            character, actuation_model, self.physics_timestep, **options
        )
        self.blocks = consecutive({
            **self.figure.blocks,
            'strain': len(muscles),
            'phase': 0 if target else 1 + PHASE_BINS,
            'target': 4 * len(character.row.links) + 1 if target else 0,
            **self.EXTRAS,
        })  # fmt: skip
        self._scale = np.array([hill.optimal_length(muscle) for muscle in muscles])
        self._rest = np.array([hill.rest_length(muscle) for muscle in muscles])

    @staticmethod
    def _check(
        character: Character, clip: Clip, model: str, centre: str, half_range: float | None,
        substeps: int, terrain_samples: int,
    ) -> None:  # fmt: skip
        if tuple(clip.joints) != tuple(character.row.joints) or clip.root != 'planar':
            raise ValueError(
                f'clip {clip.name!r} (root {clip.root}, joints {", ".join(clip.joints)}) does not '
                f'fit character {character.row.name!r}, whose root is planar and whose joints are '
                f'{", ".join(character.row.joints)}'
            )
        if not clip.loop:
            raise ValueError(f'clip {clip.name!r} does not loop; an imitation task needs a cycle')
        if centre not in CENTRES:
            raise ValueError(errors.unknown('centre of position control', centre, CENTRES))
        if model != 'position' and (centre != 'clip' or half_range is not None):
            raise ValueError(f'centre and half_range shape position control, not {model} control')
        if half_range is not None and not 0 < half_range < np.inf:
            raise ValueError(f'half_range is {half_range}; expected a positive number of radians')
        if terrain_samples != 0:
            why = ', or 0 for none'
            errors.check_whole('terrain_samples', terrain_samples, 2, MOST_SAMPLES, why)
        errors.check_whole('substeps', substeps, 4, MOST_SUBSTEPS, ' (physics at 120 Hz to 30 kHz)')

    @property
    def root_entity(self) -> PlanarTerrain:
        return self.arena

    @property
    def signature(self) -> str:
        parts = self.character.row.name, self.arena.terrain.name, self.clip.name
        return f'{super().signature} of {" / ".join(parts)}'

    def bind(self, world: World) -> None:
        self.world, n = world, world.n
        figure, row = self.figure, self.character.row
        figure.bind(world, self.blocks, self.ABOUT)
        scope = f'{self.character.mjcf_model.model}/'
        controls = world.control_addresses([scope + name for name in self.action_map.names])
        # They were added one after the other.
        by = self.action_map.drive(int(controls[0]))
        self.reference = Reference(
            self.clip, world.models[0], figure.pose_qpos, figure.pose_dof, figure.links,
            figure.effectors, figure.geoms, PHASE_BINS, self.ABOUT,
        )  # fmt: skip
        self.state = ImitationState(*np.zeros((3, n)))
        self.outcome = outcome(n, max(part.stop for part in self.blocks.values()), len(self.TERMS))
        self.saved = (self.state, self.outcome)
        self.info_arrays = {
            'reward_terms': dict(zip(self.TERMS, self.reward_terms.T, strict=True)),
            'fell': self.outcome.fell,
            'diverged': self.outcome.diverged,
            'distance': world.qpos[:, figure.pose_qpos[0]],
        }
        self._found = figure.measurement()
        terms = np.array(list(self.TERMS.values()))
        self.rules = Rules(
            world.engine, figure.body, figure.state, figure.ground, self.reference.clip_table,
            by, world.ctrl, self._layout(), np.asarray(row.weights), terms[:, 0].copy(), terms[:, 1].copy(),
            self._rest, self._scale, self._found, self.state, self.outcome,
        )  # fmt: skip
        self._pack = packed(self.rules)

    def _layout(self) -> Layout:
        columns = {name: part.start for name, part in self.reference.columns.items()}
        starts = {name: part.start for name, part in self.blocks.items()}
        target = self.blocks.get('target', slice(0, 0))
        return Layout(
            **{name: columns[name] for name in _FEATURES},
            strain_block=starts.get('strain', -1),
            phase_block=starts.get('phase', -1),
            target_block=starts.get('target', -1),
            target=target.stop - target.start,
        )

    @property
    def phase(self) -> np.ndarray:
        """Phase of the clip in [0, 1), (n,)."""
        return self.state.phase

    def reset(self, env_ids: np.ndarray, random_states: Sequence[np.random.RandomState]) -> None:
        terrain, centre = self.arena.terrain, 0.0
        phases = np.empty(len(env_ids))
        for k, (i, random_state) in enumerate(zip(env_ids.tolist(), random_states, strict=True)):
            # Drawn even where it is not asked for, so that the terrain does not depend on it.
            drawn = random_state.random_sample()
            phases[k] = self._start_phase(drawn)
            if self._spawn == 'upstream':
                # Where the original's segments meet: it builds them before it moves the root to 0.
                centre = self.clip.pose(phases[k : k + 1] * self.reference.period)[0, 0] - 0.5
            seed = drawn_seed(random_state)
            strip = Strip(terrain, seed, blend=self._blend, spawn=self._spawn, centre=centre)
            self.arena.begin_episode(i, strip)
        for array in self.state:
            array[env_ids] = phases
        self.figure.place(env_ids, *self.reference.state(phases))
        self._begin(env_ids, random_states)
        self._observe(env_ids, True)

    def _begin(self, env_ids: np.ndarray, random_states: Sequence[np.random.RandomState]) -> None:
        """What a subclass draws at the start, once characters stand."""

    def apply_action(self, action: np.ndarray, env_ids: np.ndarray) -> None:
        if apply_actions(env_ids, action, self._pack):
            # Ground is laid before the physics, so that what is rendered afterwards is up to date.
            self.figure.follow(env_ids[self._found.leaving[env_ids]])

    def finish_step(self, env_ids: np.ndarray) -> None:
        if finish_steps(env_ids, self._pack):
            finish_steps(self._widened(env_ids), self._pack)

    def observe(self, env_ids: np.ndarray | None = None) -> None:
        self._observe(self.world.all_ids if env_ids is None else env_ids, False)

    def _observe(self, env_ids: np.ndarray, fresh: bool) -> None:
        if observe_all(env_ids, fresh, self._pack):
            observe_all(self._widened(env_ids), fresh, self._pack)

    def _widened(self, env_ids: np.ndarray) -> np.ndarray:
        """Draws the ground that some simulations look back on; returns which have waited for it."""
        waiting = env_ids[self._found.waiting[env_ids]]
        for i in waiting.tolist():
            self.arena.widen(i)
        return waiting

    def clip_action(self, row: int) -> np.ndarray:
        """Action that drives joints along the clip, without feedback on balance.

        Raises:
          ValueError: torque and muscle control have no such action.
        """
        if self.actuation_model not in ('position', 'velocity'):
            raise ValueError(
                f'{self.actuation_model} control cannot follow a clip open loop; position and '
                'velocity control can'
            )
        time = self.phase[row : row + 1] * self.reference.period
        sample = self.clip.pose if self.actuation_model == 'position' else self.clip.velocity
        return self.action_map.action(sample(time)[0, 3:])

    def reference_pose(self, row: int) -> np.ndarray:
        """Pose of the reference beside the simulated character: x, z, pitch, joints."""
        cycles = np.array([self.state.start[row], self.state.cycles[row]])
        first, pose = self.clip.pose(cycles * self.reference.period)
        pose[0] -= first[0]
        pose[1] += self.figure.ground_heights(row, pose[:1])[0]
        return pose


def position_range(
    character: Character, clip: Clip, centre: str, half_range: float | None
) -> dict[str, Any]:
    """Centre and half range of position control, rad (see `Imitation`)."""
    if centre == 'original':
        ranges = np.array([
            joint.original_range or limits
            for joint, limits in zip(
                character.row.joints.values(), character.joint_ranges.tolist(), strict=True
            )
        ])  # fmt: skip
        free = ~np.isfinite(ranges).all(1)
        ranges = np.where(free[:, None], (-np.pi, np.pi), ranges)
        scale = 2 * (ranges[:, 1] - ranges[:, 0]) if half_range is None else half_range
        return {'centre': ranges.mean(1), 'half_range': scale}
    options: dict[str, Any] = {} if half_range is None else {'half_range': half_range}
    if centre == 'clip':
        times = np.linspace(0, clip.duration, 256, endpoint=False)
        options['centre'] = clip.pose(times)[:, 3:].mean(0)
    return options
