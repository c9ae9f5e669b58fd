"""Base classes of tasks for a body with a reference motion: clock, actions, observation, start."""

from __future__ import annotations

import abc
from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

import numpy as np

from trl_suite import actuation
from trl_suite.actuation.muscles import PLAIN, Muscle
from trl_suite.arenas import PlanarArena, SpatialArena
from trl_suite.bodies.blocks import Block, action_reflection, columns, layout, reflected
from trl_suite.bodies.body import Body, Measurement, Travel, go
from trl_suite.bodies.planar import PlanarBody
from trl_suite.bodies.reference import (
    CONTROL_TIMESTEP,
    DIGITS,
    PHASE,
    Clock,
    Reference,
    joint_targets,
    tick,
)
from trl_suite.bodies.spatial import SpatialBody
from trl_suite.bodies.state import allocated
from trl_suite.characters import Character
from trl_suite.engine import World
from trl_suite.motion import Clip, FootstepLibrary
from trl_suite.policies.mirror import Mirror
from trl_suite.tasks.common.control import (
    PlanarConfig,
    SpatialConfig,
    check_motion,
    check_position_options,
    position_range,
    start_phases,
)
from trl_suite.tasks.rewards import Comparison, Outcome, comparison
from trl_suite.tasks.task import Task, drawn_seed
from trl_suite.terrain import PlanarGround, SpatialGround
from trl_suite.util.compiled import compiled, compiled_inline, packed

VIEW_BEHIND, VIEW_AHEAD = 0.5, 3.0  # m; range of observed ground heights in the plane


def make_body(
    character: Character,
    arena: PlanarArena | SpatialArena,
    terrain_observation: Any,
    contact: bool = False,
    muscles: tuple[Muscle, ...] = (),
) -> Body:
    """Attaches a character to an arena, planar or spatial as the character.

    Args:
      character: without actuators.
      arena: the arena with its terrain.
      terrain_observation: number of ground heights in the plane; names of maps in three dimensions.
      contact: whether contacts of end effectors are measured in the plane, too.
      muscles: the muscles whose strain is observed, in the plane.
    """
    if isinstance(arena, SpatialArena):
        return SpatialBody(character, arena, 'height' in terrain_observation)
    ground = VIEW_BEHIND, VIEW_AHEAD, terrain_observation
    return PlanarBody(character, arena, *ground, contact, muscles)


class ClockedTask(Task):
    """A body with a clock that has the period of its reference motion.

    A subclass defines observation, reward and the start of an episode.

    Attributes:
      figure: the body in every simulation.
      clock: phase of each simulation in its cycle.
      period: duration of a cycle, s.
      joint_map: the map from actions of the joints to actuators.
    """

    ABOUT = 'com'  # origin of end effector positions: 'com' or 'root'
    config: Any  # options of the subclass
    figure: Any  # PlanarBody or SpatialBody

    def __init__(
        self,
        character: Character,
        arena: PlanarArena | SpatialArena,
        motion: Clip | FootstepLibrary,
        typical_poses: np.ndarray,
        config: Any,
        *,
        period: float,
        actuation_model: str = 'position',
        terrain_observation: Any = (),
        contact: bool = False,
    ) -> None:
        """Attaches the character and its actuators to the arena.

        Args:
          character: a character without actuators; it is attached to the arena.
          arena: the arena with its terrain, planar or spatial as the character.
          motion: the reference motion.
          typical_poses: poses whose mean is action 0 of position control, (k, columns of a pose).
          config: the options.
          period: duration of a cycle, s.
          actuation_model: one of `trl_suite.actuation.ACTUATIONS`.
          terrain_observation, contact: see `make_body`.

        Raises:
          ValueError: incompatible options, or a motion that does not fit the character.
        """
        check_motion(character, motion)
        offset = getattr(config, 'action_offset', 'clip'), getattr(config, 'action_scale', None)
        check_position_options(actuation_model, *offset)
        self.character, self.arena, self.motion = character, arena, motion
        self.actuation_model, self.config, self.period = actuation_model, config, period
        muscle_set = getattr(config, 'muscle_set', PLAIN)
        options: dict[str, Any] = {}
        muscles: tuple[Muscle, ...] = ()
        if actuation_model == 'position':
            options = position_range(character, motion, typical_poses, *offset)
        elif actuation_model == 'muscle':
            options = {'muscle_set': muscle_set}
            muscles = actuation.character_muscles(character, muscle_set)
        if muscle_set != PLAIN and not muscles:
            raise ValueError(
                f'muscle_set is an option of muscle control, not {actuation_model} control'
            )
        self.figure = make_body(character, arena, terrain_observation, contact, muscles)
        self.fields = self.figure.fields
        self.set_timesteps(CONTROL_TIMESTEP, CONTROL_TIMESTEP / config.substeps)
        self.joint_map = actuation.add(character, actuation_model, self.physics_timestep, **options)

    # Methods of a subclass.

    @abc.abstractmethod
    def _start(
        self, env_ids: np.ndarray, random_states: Sequence[np.random.RandomState]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Draws ground and initial state; writes `clock.start` and `travel.origin`.

        Returns:
          The arguments of `figure.place`: poses, rates, and extents in the plane, or spawns.
        """

    def _begun_on_ground(self, env_ids: np.ndarray) -> None:
        """Called by `reset` after the characters of some simulations were placed."""

    # Binding.

    @property
    def root_entity(self) -> PlanarArena | SpatialArena:
        return self.arena

    def _bind_clock(self, world: World) -> None:
        """Allocates clock and outcome; a subclass may extend `saved` and `info_arrays` afterwards."""
        self.world, n = world, world.n
        self.clock, self.travel = allocated(Clock, n), allocated(Travel, n)
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
        self.figure.place(env_ids, *self._start(env_ids, random_states))
        for array in self.outcome[1:]:  # all but the observation
            array[env_ids] = 0
        self._begun_on_ground(env_ids)
        self.observe(env_ids)
        self.outcome.reward_terms[env_ids] = 0.0

    def _begin_clocks(self, env_ids: np.ndarray) -> None:
        """Sets the clocks of some simulations to `clock.start`."""
        cycles = np.rint(self.clock.start[env_ids] * DIGITS) / DIGITS
        self.clock.cycles[env_ids], self.clock.phase[env_ids] = cycles, cycles - np.floor(cycles)

    def get_state(self, env_id: int) -> dict[str, Any]:
        random = self._random[env_id].bit_generator.state
        return {**super().get_state(env_id), 'random': random}

    def set_state(self, env_id: int, state: dict[str, Any]) -> None:
        super().set_state(env_id, state)
        self._random[env_id] = np.random.default_rng(0)
        self._random[env_id].bit_generator.state = state['random']


class TrackingTask(ClockedTask):
    """A body whose joints are controlled 30 times per second, as in a reference motion.

    A subclass defines further observation blocks, which follow those of the body and the phase.

    Attributes:
      full: the blocks of the full observation, from which the observation is derived.
      reference: the reference motion, after `bind`.
    """

    draws = True  # whether random numbers are drawn within an episode
    along = False  # whether the distance travelled is along +x
    mirrored = False  # whether observations and actions are mirrored in left stance
    reference: Reference

    def __init__(
        self,
        character: Character,
        arena: PlanarArena | SpatialArena,
        motion: Clip | FootstepLibrary,
        typical_poses: np.ndarray,
        config: PlanarConfig | SpatialConfig,
        *,
        period: float,
        actuation_model: str = 'position',
        phase: bool = True,
        extras: tuple[Block, ...],
        hidden: Collection[str] = (),
    ) -> None:
        """Composes the task; see `ClockedTask` and the subclasses.

        Args:
          character, arena, motion, typical_poses, period, actuation_model: see `ClockedTask`.
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
        names = {block.name for block in extras}
        super().__init__(
            character,
            arena,
            motion,
            typical_poses,
            config,
            period=period,
            actuation_model=actuation_model,
            terrain_observation=config.terrain_observation,
            contact='contact' in names,
        )
        self.action_map = self.joint_map
        self._start_phase = start_phases(config.start_phase)
        self.full = *self.figure.blocks, PHASE.observed_if(phase), *extras
        given = tuple(block for block in self.full if block.name not in hidden)
        self._reflection = self._reflected(self.full)
        self.mirror = None if mirrored else self._reflected(given)
        self._kept: np.ndarray = np.zeros(0, int)  # all
        if mirrored or hidden:
            slices = layout(self.full)
            self._kept = np.concatenate(
                [
                    slices[block.name].start
                    + np.array(block.kept if mirrored and block.kept else range(block.size))
                    for block in given
                    if block.size
                ]
            )
        self.observed = tuple(block.mirrored() for block in given) if mirrored else given

    def _reflected(self, blocks: tuple[Block, ...]) -> Mirror | None:
        """Returns the reflection of these blocks and of actions; None if there is none."""
        slices, spec = layout(blocks), self.character.spec
        if 'phase' not in slices or not (spec.spatial and spec.mirror):
            return None
        actions = action_reflection(self.character, self.action_map)
        return Mirror(*reflected(blocks), *actions, slices['phase'].start)

    @abc.abstractmethod
    def _track(self) -> Reference:
        """Returns the reference, after the body was bound."""

    def _bind_tracking(self, world: World) -> TrackingData:
        """Binds body, reference and full observation."""
        self._bind_clock(world)
        full = self.outcome.observation
        if self.observed != self.full:
            full = np.zeros((world.n, sum(block.size for block in self.full)))
            self.saved = (*self.saved, Full(full))
        self.figure.bind(world, self.joint_map, full, self.full, self.ABOUT)
        self.reference = self._track()
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
        return TrackingData(
            measurement=self.figure.measurement,
            diverged=self.figure.data.diverged,
            outcome=self.outcome,
            given=self._view,
            clock=self.clock,
            travel=self.travel,
            period=self.period,
            along=self.along or not self.character.spec.spatial,
            comparison=comparison(self.character, self.reference, self.terms),
        )

    def apply_action(self, action: np.ndarray, env_ids: np.ndarray) -> None:
        if self.mirrored:
            reflect_all(env_ids, action, self._view_pack)
            action = self._view.action
        self.figure.control(env_ids, action)

    def _begin_grounds(
        self, env_ids: np.ndarray, random_states: Sequence[np.random.RandomState]
    ) -> np.ndarray:
        """Draws phase, ground, random stream and spawn of simulations; returns spawns, (m, 3)."""
        origin = self.travel.origin
        for i, random_state in zip(env_ids.tolist(), random_states, strict=True):
            # Drawn even if start_phase is a constant, so that the terrain does not depend on it.
            self.clock.start[i] = self._start_phase(random_state.random_sample())
            ground = self._ground(i, self.terrain_seed(i, random_state))
            if self.draws:
                self._random[i] = np.random.default_rng(drawn_seed(random_state))
            if isinstance(ground, PlanarGround):
                self.arena.begin_episode(i, ground)
                continue
            if self.draws:
                origin[i] = ground.spawn(self._random[i])
            self.arena.begin_episode(i, ground, origin[i, :2])
        self._begin_clocks(env_ids)
        return origin[env_ids]

    def _ground(self, i: int, seed: np.random.SeedSequence) -> PlanarGround | SpatialGround:
        """Returns the ground of an episode."""
        terrain, level = self.arena.terrain, self.config.terrain_level
        if self.character.spec.spatial:
            return SpatialGround(terrain, seed, terrain_level=level)
        spawn, centre = self.config.spawn, 0.0
        if spawn == 'upstream':
            # The boundary of the original's segments: it builds them before it moves the root to 0.
            assert isinstance(self.motion, Clip)
            centre = self.motion.pose(self.clock.start[i : i + 1] * self.period)[0, 0] - 0.5
        return PlanarGround(terrain, seed, terrain_level=level, spawn=spawn, centre=centre)

    def _clip_start(self, env_ids: np.ndarray, spawns: np.ndarray, tracks: int = 1) -> Any:
        """Returns poses, rates, and extents or spawns, of a clip at `clock.start`."""
        assert isinstance(self.motion, Clip)
        phase = self.clock.start[env_ids]
        if not self.character.spec.spatial:
            share = tracks * phase
            track = np.floor(share)
            return self.reference.planar_state(share - track, track.astype(int))
        poses, rates = self.motion.state(phase * self.period)
        poses[:, :2] = 0.0
        return poses, rates, spawns

    def clip_action(self, env_id: int) -> np.ndarray:
        """Returns the action that moves the joints along the clip, in open loop.

        Raises:
          ValueError: torque and muscle control have no such action, and footsteps no clip.
        """
        if not isinstance(self.motion, Clip):
            raise ValueError('footsteps have no clip to follow')
        if self.actuation_model not in ('position', 'velocity'):
            raise ValueError(
                f'{self.actuation_model} control cannot follow a clip open loop; position and '
                'velocity control can'
            )
        clip, time = self.motion, self.phase[env_id] * self.period
        if self.actuation_model == 'velocity':
            first = 3 if clip.root == 'planar' else 6
            action = self.action_map.action(clip.velocity(time)[first:])
        else:
            action = self.action_map.action(joint_targets(clip, clip.pose(time)))
        if self.mirrored and self.phase[env_id] >= 0.5:
            assert self._reflection is not None
            action = self._reflection.action(action[None])[0]
        return action

    def _on_ground(self, env_id: int, pose: np.ndarray) -> np.ndarray:
        """Returns a pose above level ground of height 0, raised by the height of the ground there."""
        place = pose[None, :2]
        height = 2 if self.character.spec.spatial else 1
        pose[height] += self.figure.heights(np.array([env_id]), place)[0]
        return pose


class Full(NamedTuple):
    """The full observation, as part of the state of a task, (n, size)."""

    observation: np.ndarray


class View(NamedTuple):
    """The full observation, and what of it is observed, with optional mirroring in left stance.

    Attributes:
      full: the full observation, (n, size).
      columns: first columns of its blocks; -1: absent.
      mirrored: whether observations and actions are reflected in left stance.
      source, sign: a reflected full observation is `full[source] * sign`, (size,).
      kept: columns of the full observation that are observed, (k,); all of them if it is empty.
      given_phase: column of the phase in the observation.
      action_source, action_sign: a reflected action is `action[source] * sign`.
      action: actions after reflection, (n, k); scratch.
    """

    full: np.ndarray
    columns: Any
    mirrored: bool
    source: np.ndarray
    sign: np.ndarray
    kept: np.ndarray
    given_phase: int
    action_source: np.ndarray
    action_sign: np.ndarray
    action: np.ndarray


class TrackingData(NamedTuple):
    """Data for the compiled functions of tasks that track a reference motion.

    Attributes:
      measurement: of the bodies, which write their own blocks to `given.full`.
      diverged: whether the physics has diverged in the last step, (n,).
      period: that of the motion, s.
      along: whether the distance travelled is along +x, not in any horizontal direction.
    """

    measurement: Measurement
    diverged: np.ndarray
    outcome: Outcome
    given: View
    clock: Clock
    travel: Travel
    period: float
    along: bool
    comparison: Comparison


@compiled
def proceed(i: int, data: TrackingData) -> bool:
    """Advances clock and distance; returns False if the physics has diverged."""
    tick(i, data.period, data.clock)
    data.outcome.diverged[i] = data.diverged[i]
    if data.diverged[i]:
        return False
    go(i, data.along, data.measurement, data.travel)
    return True


@compiled_inline
def in_left_stance(i: int, view: View) -> bool:
    """Returns whether observation and action are reflected."""
    return view.mirrored and view.full[i, view.columns.phase] >= 0.5


@compiled
def publish(i: int, view: View, outcome: Outcome) -> None:
    """Writes the observation from the full observation."""
    full, observation, left = view.full, outcome.observation, in_left_stance(i, view)
    for k in range(len(view.kept)):
        column = view.kept[k]
        if left:
            observation[i, k] = full[i, view.source[column]] * view.sign[column]
        else:
            observation[i, k] = full[i, column]
    if view.mirrored:  # the phase of the single step
        phase = full[i, view.columns.phase]
        observation[i, view.given_phase] = 2 * (phase - 0.5 if left else phase)


@compiled
def reflect_all(env_ids: np.ndarray, action: np.ndarray, view: View) -> None:
    """Writes `view.action`: actions, which are reflected in left stance. Takes a pack."""
    for i in env_ids:
        left = in_left_stance(i, view)
        for k in range(view.action.shape[1]):
            if left:
                view.action[i, k] = action[i, view.action_source[k]] * view.action_sign[k]
            else:
                view.action[i, k] = action[i, k]
