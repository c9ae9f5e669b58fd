"""Tracking a motion clip over planar terrain: the Imitation and PLAiD families.

Source: the imitation scenario of the original; 'Does the choice of action space matter?' (Peng &
van de Panne 2017) and 'Progressive reinforcement learning with distillation for multi-skilled
motion control' (Berseth et al. 2018).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from trl_suite import actuation
from trl_suite.actuation import hill
from trl_suite.actuation.muscles import PLAIN, Muscle
from trl_suite.arenas import PlanarArena
from trl_suite.characters import Character
from trl_suite.engine import World
from trl_suite.kinematics.blocks import CLOCK, Block, Noise, by_name, columns
from trl_suite.kinematics.planar import PlanarBodyData, breaks_down, has_fallen, look
from trl_suite.kinematics.planar_figure import PlanarFigure
from trl_suite.kinematics.planar_reference import ClipTable, Reference, feature
from trl_suite.motion import Clip
from trl_suite.tasks.common import rewards
from trl_suite.tasks.common.footstep_plan import CONTACT
from trl_suite.tasks.common.rewards import COM_ERROR_FACTOR, score_tracking
from trl_suite.tasks.task import (
    ACTION_OFFSETS,
    CONTROL_TIMESTEP,
    MOST_SAMPLES,
    MOST_SUBSTEPS,
    PHASE_BINS,
    SPAWNS,
    START_PHASE,
    SUBSTEPS,
    TERRAIN_LEVEL,
    Task,
    check_position_options,
    start_phases,
)
from trl_suite.tasks.terms import Outcome, begin, conclude, terms_data, wrapped
from trl_suite.terrain import PlanarGround
from trl_suite.util.compiled import compiled, packed
from trl_suite.util.options import Config, option

VIEW_BEHIND = 0.5  # m; terrain samples begin this far behind the root
VIEW_AHEAD = 3.0  # m; they end this far ahead of it


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


class ImitationData(NamedTuple):
    """Data of the compiled functions of imitation.

    Attributes:
      features: first column of each feature in the clip's table.
      columns: first column of each block in the observation.
      terms: the reward terms.
      weights: weights of pitch and joints in the pose and velocity errors, (1 + J,).
      rest: tendon length of each muscle at zero strain, m.
      scale: change of tendon length of each muscle per unit of strain, m.
    """

    body: PlanarBodyData
    clip: ClipTable
    features: Any
    columns: Any
    terms: Any
    weights: np.ndarray
    rest: np.ndarray
    scale: np.ndarray
    state: ImitationState
    outcome: Outcome


# The step of simulation i. Functions are in the order in which they are called.


@compiled
def finish_step(i: int, data: ImitationData) -> None:
    """Computes reward, failure and observation after the physics step."""
    advance_clock(i, data.clip, data.state)
    body, outcome = data.body, data.outcome
    outcome.diverged[i] = breaks_down(i, body)
    if outcome.diverged[i]:  # keeps the last finite observation
        conclude(i, True, outcome)
        return
    look(i, body, outcome.observation)
    compare(i, data)
    conclude(i, has_fallen(i, body.ids, body.physics), outcome)
    observe(i, data)


@compiled
def advance_clock(i: int, clip: ClipTable, state: ImitationState) -> None:
    """Advances the phase by a control step."""
    state.cycles[i] += CONTROL_TIMESTEP / clip.period
    state.phase[i] = state.cycles[i] % 1.0


@compiled
def errors(i: int, data: ImitationData) -> tuple[float, float, float, float, float]:
    """Returns the errors of pose, velocity, end effectors, centre of mass and height of the root."""
    ids, physics, clip, columns = data.body.ids, data.body.physics, data.clip, data.features
    phase, measurement = data.state.phase[i], data.body.measurement
    pose = velocity = 0.0
    for k in range(len(data.weights)):  # pitch, then joints
        angle = physics.qpos[i, ids.qpos[2 + k]] - feature(phase, columns.angles + k, clip)
        if k == 0:
            angle = wrapped(angle)
        rate = physics.qvel[i, ids.dof[2 + k]] - feature(phase, columns.rates + k, clip)
        pose += data.weights[k] * (angle * angle)
        velocity += data.weights[k] * (rate * rate)
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
def compare(i: int, data: ImitationData) -> None:
    """Writes the reward terms."""
    pose, velocity, end_effector, com, height = errors(i, data)
    terms, outcome = data.terms, data.outcome
    score_tracking(i, pose, velocity, end_effector, com, height, terms, outcome)


@compiled
def observe(i: int, data: ImitationData) -> None:
    """Writes the blocks after terrain, pose and velocity: strain, and phase or reference."""
    columns, features, observation = data.columns, data.features, data.outcome.observation
    phase = data.state.phase[i]
    for k in range(len(data.rest)):
        length = data.body.physics.ten_length[i, k] - data.rest[k]
        observation[i, columns.strain + k] = length / data.scale[k]
    if columns.phase >= 0:
        for k in range(1 + PHASE_BINS):
            observation[i, columns.phase + k] = feature(phase, features.phase + k, data.clip)
    if columns.reference >= 0:  # height, positions and velocities
        for k in range(features.root_rate - features.height):
            value = feature(phase, features.height + k, data.clip)
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


# Loops over simulations; they take packs.


@compiled
def finish_steps(env_ids: np.ndarray, data: ImitationData) -> None:
    """Finishes steps."""
    for i in env_ids:
        finish_step(i, data)


@compiled
def observe_all(env_ids: np.ndarray, fresh: bool, data: ImitationData) -> None:
    """Writes observations; if `fresh`, episodes have just begun, and outcomes are reset."""
    for i in env_ids:
        look(i, data.body, data.outcome.observation)
        compare(i, data)
        observe(i, data)
        if fresh:
            begin(i, data.outcome)


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlanarConfig(Config):
    """Options of tasks that track a clip in the plane."""

    terrain_observation: int = option(
        0,
        'number of observed ground heights, from 0.5 m behind to 3 m ahead of the root; 0: none',
        at_least=0,
        at_most=MOST_SAMPLES,
    )
    substeps: int = option(
        SUBSTEPS, 'physics steps per control step of 1/30 s', at_least=4, at_most=MOST_SUBSTEPS
    )
    action_offset: str = option(
        'clip',
        "pose at action 0: the mean pose of the clip ('clip'), or the working posture ('posture'); "
        "'original': the original's map, where [-1, 1] spans four times the joint range about its middle",
        choices=ACTION_OFFSETS, actuation='position',
    )  # fmt: skip
    action_scale: float | None = option(
        None,
        'joint angle per unit action; by default 1.5',
        unit='rad',
        above=0,
        actuation='position',
    )
    start_phase: float | Sequence[Sequence[float]] | None = option(None, START_PHASE)
    spawn: str = option(
        'intended',
        "position of the flat ground at the start: 'intended', up to 1 m to both sides of the root, or "
        "'upstream', as in the original",
        choices=SPAWNS,
    )  # fmt: skip
    terrain_level: float = option(0.0, TERRAIN_LEVEL)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.terrain_observation == 1:
            raise ValueError('terrain_observation is 1; expected 0, or at least 2 heights')
        start_phases(self.start_phase)


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlanarImitationConfig(PlanarConfig):
    """Options of `PlanarImitation`."""

    reference_observation: bool = option(
        False, 'observe the state of the reference instead of the phase'
    )
    muscle_set: str = option(
        PLAIN,
        "set of muscle parameters: 'plain', or the motion for which they were optimised (biped: 'walk', "
        "'run'; dog: 'bound'; raptor: 'run')",
        actuation='muscle',
    )


class PlanarImitation(Task):
    """A planar character tracks a looping clip over random terrain.

    Positions are observed from the root; x is mirrored while the trunk points backwards.
    """

    terms = rewards.IMITATION_TERMS
    ABOUT = 'com'  # origin of end effector positions: 'com' or 'root'
    EXTRAS: tuple[Block, ...] = ()  # the blocks of a subclass

    CONFIG: Any = PlanarImitationConfig

    def __init__(
        self,
        character: Character,
        arena: PlanarArena,
        clip: Clip,
        config: PlanarConfig = PlanarImitationConfig(),
        *,
        actuation_model: str = 'position',
    ) -> None:
        """Composes the task.

        Args:
          character: a planar character without actuators; it is attached to the arena.
          arena: the arena with its terrain.
          clip: a looping planar clip for this character.
          config: the options.
          actuation_model: one of `trl_suite.actuation.ACTUATIONS`.

        Raises:
          ValueError: incompatible options, or a clip that does not fit the character.
        """
        _check(character, clip, actuation_model, config)
        self.character, self.arena, self.clip, self.config = character, arena, clip, config
        self.actuation_model = actuation_model
        self._start_phase = start_phases(config.start_phase)
        self.figure = PlanarFigure(
            character, arena, VIEW_BEHIND, VIEW_AHEAD, config.terrain_observation,
            CONTACT in self.EXTRAS,
        )  # fmt: skip
        self.set_timesteps(CONTROL_TIMESTEP, CONTROL_TIMESTEP / config.substeps)

        options: dict[str, Any] = {}
        muscles: tuple[Muscle, ...] = ()
        muscle_set = getattr(config, 'muscle_set', PLAIN)
        if actuation_model == 'position':
            options = position_range(character, clip, config.action_offset, config.action_scale)
        elif actuation_model == 'muscle':
            options = {'muscle_set': muscle_set}
            muscles = actuation.character_muscles(character, muscle_set)
        if muscle_set != PLAIN and not muscles:
            raise ValueError(
                f'muscle_set is an option of muscle control, not {actuation_model} control'
            )
        self.action_map = actuation.add(
            character, actuation_model, self.physics_timestep, **options
        )
        reference = getattr(config, 'reference_observation', False)
        own = motion_blocks(len(muscles), len(character.spec.links), reference)
        self.observed = *self.figure.blocks, *own, *self.EXTRAS
        self._scale = np.array([hill.optimal_length(muscle) for muscle in muscles])
        self._rest = np.array([hill.rest_length(muscle) for muscle in muscles])

    @property
    def root_entity(self) -> PlanarArena:
        return self.arena

    def bind(self, world: World) -> None:
        self.world, n = world, world.n
        figure, spec = self.figure, self.character.spec
        figure.bind(world, self.blocks, self.ABOUT, self.action_map)
        self.reference = Reference(
            self.clip, world.models[0], figure.pose_qpos, figure.pose_dof, figure.links,
            figure.effectors, figure.geoms, PHASE_BINS, self.ABOUT,
        )  # fmt: skip
        self.state = ImitationState(*np.zeros((3, n)))
        self._allocate(n, world.qpos[:, figure.pose_qpos[0]])
        self.saved = (self.state, self.outcome)
        self._pack = packed(
            ImitationData(
                body=figure.data,
                clip=self.reference.clip_table,
                features=by_name(
                    'Features', {name: part.start for name, part in self.reference.columns.items()}
                ),
                columns=columns(self.observed),
                terms=terms_data(self.terms),
                weights=np.asarray(spec.weights),
                rest=self._rest,
                scale=self._scale,
                state=self.state,
                outcome=self.outcome,
            )
        )

    @property
    def phase(self) -> np.ndarray:
        """Phase of the clip in [0, 1), (n,)."""
        return self.state.phase

    def reset(self, env_ids: np.ndarray, random_states: Sequence[np.random.RandomState]) -> None:
        terrain, centre = self.arena.terrain, 0.0
        phases = np.empty(len(env_ids))
        for k, (i, random_state) in enumerate(zip(env_ids.tolist(), random_states, strict=True)):
            # Drawn even if start_phase is a constant, so that the terrain does not depend on it.
            drawn = random_state.random_sample()
            phases[k] = self._start_phase(drawn)
            if self.config.spawn == 'upstream':
                # The boundary of the original's segments: it builds them before it moves the root
                # to 0.
                centre = self.clip.pose(phases[k : k + 1] * self.reference.period)[0, 0] - 0.5
            seed = self.terrain_seed(i, random_state)
            strip = PlanarGround(
                terrain,
                seed,
                terrain_level=self.config.terrain_level,
                spawn=self.config.spawn,
                centre=centre,
            )
            self.arena.begin_episode(i, strip)
        for array in self.state:
            array[env_ids] = phases
        self.figure.place(env_ids, *self.reference.state(phases))
        self._begin(env_ids, random_states)
        self._observe(env_ids, True)

    def _begin(self, env_ids: np.ndarray, random_states: Sequence[np.random.RandomState]) -> None:
        """Called by `reset` after the characters were placed; for subclasses."""

    def apply_action(self, action: np.ndarray, env_ids: np.ndarray) -> None:
        self.figure.control(env_ids, action)

    def finish_step(self, env_ids: np.ndarray) -> None:
        finish_steps(env_ids, self._pack)

    def observe(self, env_ids: np.ndarray | None = None) -> None:
        self._observe(self.world.all_ids if env_ids is None else env_ids, False)

    def _observe(self, env_ids: np.ndarray, fresh: bool) -> None:
        observe_all(env_ids, fresh, self._pack)

    def clip_action(self, env_id: int) -> np.ndarray:
        """Returns the action that moves the joints along the clip, in open loop.

        Raises:
          ValueError: torque and muscle control have no such action.
        """
        if self.actuation_model not in ('position', 'velocity'):
            raise ValueError(
                f'{self.actuation_model} control cannot follow a clip open loop; position and '
                'velocity control can'
            )
        time = self.phase[env_id : env_id + 1] * self.reference.period
        sample = self.clip.pose if self.actuation_model == 'position' else self.clip.velocity
        return self.action_map.action(sample(time)[0, 3:])

    def reference_pose(self, env_id: int) -> np.ndarray:
        """Returns the pose of the reference from the same start: x, z, pitch, joints."""
        cycles = np.array([self.state.start[env_id], self.state.cycles[env_id]])
        first, pose = self.clip.pose(cycles * self.reference.period)
        pose[0] -= first[0]
        pose[1] += self.figure.ground_heights(env_id, pose[:1])[0]
        return pose


def _check(character: Character, clip: Clip, model: str, config: PlanarConfig) -> None:
    if tuple(clip.joints) != tuple(character.spec.joints) or clip.root != 'planar':
        raise ValueError(
            f'clip {clip.name!r} (root {clip.root}, joints {", ".join(clip.joints)}) does not '
            f'fit character {character.spec.name!r}, whose root is planar and whose joints are '
            f'{", ".join(character.spec.joints)}'
        )
    if not clip.loop:
        raise ValueError(
            f'clip {clip.name!r} does not loop; an imitation task needs a looping clip'
        )
    check_position_options(model, config.action_offset, config.action_scale)


def position_range(
    character: Character, clip: Clip, action_offset: str, action_scale: float | None
) -> dict[str, Any]:
    """Returns action_offset and action_scale of position control, rad; see `PlanarConfig`."""
    if action_offset == 'original':
        ranges = np.array([
            joint.original_range or limits
            for joint, limits in zip(
                character.spec.joints.values(), character.joint_ranges.tolist(), strict=True
            )
        ])  # fmt: skip
        free = ~np.isfinite(ranges).all(1)
        ranges = np.where(free[:, None], (-np.pi, np.pi), ranges)
        scale = 2 * (ranges[:, 1] - ranges[:, 0]) if action_scale is None else action_scale
        return {'action_offset': ranges.mean(1), 'action_scale': scale}
    options: dict[str, Any] = {} if action_scale is None else {'action_scale': action_scale}
    if action_offset == 'clip':
        times = np.linspace(0, clip.duration, 256, endpoint=False)
        options['action_offset'] = clip.pose(times)[:, 3:].mean(0)
    return options
