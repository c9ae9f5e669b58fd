"""Base class of tasks for a 3D walker: body, clock, actions, observation, reflection."""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

import numpy as np

from trl_suite import actuation
from trl_suite.arenas import SpatialArena
from trl_suite.characters import Character
from trl_suite.engine import World
from trl_suite.kinematics.blocks import Block, columns, layout, reflected
from trl_suite.kinematics.spatial_figure import SpatialFigure
from trl_suite.kinematics.spatial_reference import mean_targets
from trl_suite.motion import Clip, FootstepLibrary
from trl_suite.policies.mirror import Mirror
from trl_suite.tasks.common.reflection import action_reflection
from trl_suite.tasks.common.spatial_rules import (
    _DIGITS,
    ACTION_SCALE,
    HEIGHT_MAP,
    PHASE,
    Clock,
    Travel,
    View,
    reflect_all,
)
from trl_suite.tasks.task import (
    ACTION_OFFSETS,
    CONTROL_TIMESTEP,
    MOST_SUBSTEPS,
    START_PHASE,
    SUBSTEPS,
    TERRAIN_LEVEL,
    Task,
    check_position_options,
    drawn_seed,
    start_phases,
)
from trl_suite.terrain import SpatialGround
from trl_suite.util.compiled import packed
from trl_suite.util.options import Config, option


@dataclasses.dataclass(frozen=True, kw_only=True)
class SpatialConfig(Config):
    """Options of tasks for a 3D walker."""

    terrain_observation: str | Collection[str] = option((), HEIGHT_MAP, choices=('height',))
    substeps: int = option(
        SUBSTEPS, 'physics steps per control step of 1/30 s', at_least=6, at_most=MOST_SUBSTEPS
    )
    action_offset: str = option(
        'clip',
        "pose at action 0: the mean pose of the reference motion, made symmetric ('clip'), or the working "
        "posture ('posture'); 'original': the original's map, with an angle and an axis for every ball joint",
        choices=ACTION_OFFSETS, actuation='position',
    )  # fmt: skip
    action_scale: float | None = option(
        None, "joint angle per unit action; by default 1 with action_offset 'clip', 1.5 with 'posture'",
        unit='rad', above=0, actuation='position',
    )  # fmt: skip
    start_phase: float | Sequence[Sequence[float]] | None = option(None, START_PHASE)
    terrain_level: float = option(0.0, TERRAIN_LEVEL)

    def __post_init__(self) -> None:
        super().__post_init__()
        self._set('terrain_observation', maps(self.terrain_observation))
        start_phases(self.start_phase)
        if self.action_offset == 'original' and self.action_scale is not None:
            raise ValueError("action_offset 'original' has fixed ranges: it takes no action_scale")


@dataclasses.dataclass(frozen=True, kw_only=True)
class MirroredConfig(SpatialConfig):
    """Options of tasks that can mirror observations and actions in left stance."""

    mirrored: bool = option(
        False,
        'mirror observations and actions in left stance, so that every step is in right stance',
    )


def maps(names: str | Collection[str]) -> tuple[str, ...]:
    """Returns one or several names of maps as a tuple."""
    return (names,) if isinstance(names, str) else tuple(names)


class SpatialTask(Task):
    """A 3D walker with a clock that has the period of its reference motion.

    A subclass defines observation, reward and the start of an episode.

    Attributes:
      figure: the character in every simulation.
      clock: phase of each simulation in its cycle.
      period: duration of a cycle, s.
      joint_map: the map from actions of the joints to actuators.
      mirror: reflection of observations and actions, for policies; None if it is not available.
    """

    ABOUT = 'com'  # origin of end effector positions: 'com' or 'root'
    fields: tuple[str, ...] = SpatialFigure.fields
    config: Any  # options of the subclass
    mirror: Mirror | None = None
    mirrored = False  # whether observations and actions are mirrored in left stance

    def __init__(
        self,
        character: Character,
        arena: SpatialArena,
        motion: Clip | FootstepLibrary,
        typical_poses: np.ndarray,
        config: Any,
        *,
        period: float,
        actuation_model: str = 'position',
        action_offset: str = 'clip',
        action_scale: float | None = None,
        terrain_observation: bool = False,
    ) -> None:
        """Attaches the walker and its actuators to the arena.

        Args:
          character: a spatial character without actuators; it is attached to the arena.
          arena: the arena with its terrain.
          motion: the reference motion.
          typical_poses: poses whose mean is action 0 of position control, (k, columns of a pose).
          config: the options, of which `substeps` and `terrain_level` are used here.
          period: duration of a cycle, s.
          actuation_model: one of `trl_suite.actuation.ACTUATIONS`.
          action_offset, action_scale: options of position control; see `SpatialConfig`.
          terrain_observation: whether the figure has a block of ground heights.

        Raises:
          ValueError: incompatible options, or a motion that does not fit the character.
        """
        check_motion(character, motion)
        check_position_options(actuation_model, action_offset, action_scale)
        self.character, self.arena, self.motion = character, arena, motion
        self.actuation_model, self.config, self.period = actuation_model, config, period
        self.figure = SpatialFigure(character, arena, terrain_observation)
        self.set_timesteps(CONTROL_TIMESTEP, CONTROL_TIMESTEP / config.substeps)
        options: dict[str, Any] = {}
        if actuation_model == 'position':
            options = position_range(typical_poses, motion, action_offset, action_scale)
        self.joint_map = actuation.add(character, actuation_model, self.physics_timestep, **options)

    # Methods of a subclass.

    @abc.abstractmethod
    def _start(
        self, env_ids: np.ndarray, random_states: Sequence[np.random.RandomState]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Draws ground and initial state of some simulations, and writes phases to `clock.start`.

        Returns:
          Poses, rates and spawns, see `SpatialFigure.place`.
        """

    def _begun_on_ground(self, env_ids: np.ndarray) -> None:
        """Called by `reset` after the characters of some simulations were placed."""

    # Binding.

    @property
    def root_entity(self) -> SpatialArena:
        return self.arena

    def _bind_walker(self, world: World) -> None:
        """Binds the walker; a subclass may extend `saved` and `info_arrays` afterwards."""
        self.world, n = world, world.n
        self.figure.bind(world, self.joint_map, self.ABOUT)
        self.clock = Clock(np.zeros(n), np.zeros(n, int), np.zeros(n), np.zeros(n))
        self.travel = Travel(np.zeros((n, 3)), np.zeros(n))
        self._random = [np.random.default_rng(0)] * n  # for draws within an episode
        self._allocate(n, self.travel.distance)
        self.saved = (self.clock, self.travel, self.outcome)

    @property
    def phase(self) -> np.ndarray:
        """Phase of the cycle in [0, 1), (n,)."""
        return self.clock.phase

    @property
    def cycles(self) -> np.ndarray:
        """Time in periods of the motion: the phase, not wrapped, (n,)."""
        return self.clock.cycles

    # Episodes.

    def reset(self, env_ids: np.ndarray, random_states: Sequence[np.random.RandomState]) -> None:
        self.world.reset(env_ids)
        self.clock.steps[env_ids] = 0
        poses, rates, spawns = self._start(env_ids, random_states)
        self.travel.origin[env_ids] = spawns
        self.figure.place(env_ids, poses, rates, spawns)
        for array in self.outcome[1:]:  # all but the observation
            array[env_ids] = 0
        self._begun_on_ground(env_ids)
        self.observe(env_ids)
        self.outcome.reward_terms[env_ids] = 0.0

    def _begin_clocks(self, env_ids: np.ndarray) -> None:
        """Sets the clocks of some simulations to `clock.start`."""
        cycles = np.rint(self.clock.start[env_ids] * _DIGITS) / _DIGITS
        self.clock.cycles[env_ids], self.clock.phase[env_ids] = cycles, cycles - np.floor(cycles)

    def get_state(self, env_id: int) -> dict[str, Any]:
        return {
            **super().get_state(env_id),
            'random': self._random[env_id].bit_generator.state,
        }

    def set_state(self, env_id: int, state: dict[str, Any]) -> None:
        super().set_state(env_id, state)
        self._random[env_id] = np.random.default_rng(0)
        self._random[env_id].bit_generator.state = state['random']


class TrackingTask(SpatialTask):
    """A 3D walker whose joints are controlled 30 times per second, as in a reference motion.

    A subclass defines further observation blocks, which follow terrain, pose, velocity and phase.

    Attributes:
      full: the blocks of the full observation, from which the observation is derived.
    """

    def __init__(
        self,
        character: Character,
        arena: SpatialArena,
        motion: Clip | FootstepLibrary,
        typical_poses: np.ndarray,
        config: SpatialConfig,
        *,
        period: float,
        actuation_model: str = 'position',
        phase: bool = True,
        extras: tuple[Block, ...],
        hidden: Collection[str] = (),
    ) -> None:
        """Composes the task; see `SpatialTask` and the subclasses.

        Args:
          character, arena, motion, typical_poses, period, actuation_model: see `SpatialTask`.
          config: the options.
          phase: whether the phase is observed.
          extras: the blocks of a subclass.
          hidden: names of blocks that are not observed.

        Raises:
          ValueError: incompatible options, or a motion that does not fit the character.
        """
        self.mirrored = mirrored = getattr(config, 'mirrored', False)
        if mirrored and not character.spec.mirror:
            raise ValueError(
                f'character {character.spec.name!r} has no pairs of right and left links; mirrored '
                'observations need them'
            )
        if mirrored and not phase:
            raise ValueError(
                'mirrored observations need the phase, which determines the stance foot'
            )
        super().__init__(
            character, arena, motion, typical_poses, config, period=period,
            actuation_model=actuation_model, action_offset=config.action_offset,
            action_scale=config.action_scale,
            terrain_observation='height' in config.terrain_observation,
        )  # fmt: skip
        self.action_map = self.joint_map
        self._start_phase = start_phases(config.start_phase)
        self.full = *self.figure.blocks, PHASE.observed_if(phase), *extras
        given = tuple(block for block in self.full if block.name not in hidden)
        self._reflection = self._reflected(self.full)
        self.mirror = None if mirrored else self._reflected(given)
        self._kept: np.ndarray = np.zeros(0, int)  # all
        if mirrored or hidden:
            slices = layout(self.full)
            self._kept = np.concatenate([
                slices[block.name].start + np.array(
                    block.kept if mirrored and block.kept else range(block.size)
                ) for block in given if block.size
            ])  # fmt: skip
        self.observed = tuple(block.mirrored() for block in given) if mirrored else given

    def _reflected(self, blocks: tuple[Block, ...]) -> Mirror | None:
        """Returns the reflection of these blocks and of actions; None if there is none."""
        slices = layout(blocks)
        if 'phase' not in slices or not self.character.spec.mirror:
            return None
        actions = action_reflection(self.character, self.action_map)
        return Mirror(*reflected(blocks), *actions, slices['phase'].start)

    def _bind_view(self, world: World) -> View:
        """Binds walker and full observation."""
        self._bind_walker(world)
        full = self.outcome.observation
        if self.observed != self.full:
            full = np.zeros((world.n, sum(block.size for block in self.full)))
            self.saved = (*self.saved, Full(full))
        none, mirror = np.zeros(0, int), self._reflection if self.mirrored else None
        self._view = View(
            full=full,
            columns=columns(self.full),
            mirrored=self.mirrored,
            source=none if mirror is None else mirror.observation_index,
            sign=np.zeros(0) if mirror is None else mirror.observation_sign,
            kept=self._kept,
            given_phase=self.blocks['phase'].start if self.mirrored else -1,
            action_source=none if mirror is None else mirror.action_index,
            action_sign=np.zeros(0) if mirror is None else mirror.action_sign,
            action=np.zeros((world.n, len(self.joint_map))),
        )
        self._view_pack = packed(self._view)
        return self._view

    def apply_action(self, action: np.ndarray, env_ids: np.ndarray) -> None:
        if self.mirrored:
            reflect_all(env_ids, action, self._view_pack)
            action = self._view.action
        self.figure.control(env_ids, action)

    def _begin_grounds(
        self, env_ids: np.ndarray, random_states: Sequence[np.random.RandomState]
    ) -> np.ndarray:
        """Draws phase, ground, random stream and spawn of simulations; returns spawns, (m, 3)."""
        spawns = np.zeros((len(env_ids), 3))
        for k, (i, random_state) in enumerate(zip(env_ids.tolist(), random_states, strict=True)):
            drawn = random_state.random_sample()
            self.clock.start[i] = self._start_phase(drawn)
            ground = SpatialGround(
                self.arena.terrain,
                self.terrain_seed(i, random_state),
                terrain_level=self.config.terrain_level,
            )
            self._random[i] = np.random.default_rng(drawn_seed(random_state))
            spawns[k] = ground.spawn(self._random[i])
            self.arena.begin_episode(i, ground, spawns[k, :2])
        self._begin_clocks(env_ids)
        return spawns


class Full(NamedTuple):
    """The full observation, as part of the state of a task, (n, size)."""

    observation: np.ndarray


def check_motion(character: Character, motion: Clip | FootstepLibrary) -> None:
    """Checks that a motion is for this spatial character.

    Raises:
      ValueError: it is not; the message has the joints of both.
    """
    spec = character.spec
    if not spec.spatial or tuple(motion.joints) != tuple(spec.joints):
        raise ValueError(
            f'motion {motion.name!r} (joints {", ".join(motion.joints)}) does not fit character '
            f'{spec.name!r}: expected a spatial character with these joints, not '
            f'{"one" if spec.spatial else "a planar one"} with {", ".join(spec.joints)}'
        )
    sizes = tuple(np.where(character.spherical, 4, 1).tolist())
    if motion.sizes != sizes:
        raise ValueError(
            f'motion {motion.name!r} has {motion.sizes} columns for its joints; character '
            f'{spec.name!r} has {sizes}'
        )


def position_range(
    typical_poses: np.ndarray,
    motion: Clip | FootstepLibrary,
    action_offset: str,
    action_scale: float | None,
) -> dict[str, Any]:
    """Returns the arguments of position control for an action_offset and an action_scale."""
    if action_offset == 'original':
        return {'rotations': 'angle_axis'}
    options: dict[str, Any] = {} if action_scale is None else {'action_scale': action_scale}
    if action_offset == 'clip':
        options.setdefault('action_scale', ACTION_SCALE)
        options['action_offset'] = mean_targets(typical_poses, motion)
    return options
