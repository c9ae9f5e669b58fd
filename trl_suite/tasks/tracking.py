"""A body tracks a reference motion: the task, and the compiled functions that such tasks share."""

from __future__ import annotations

import abc
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from trl_suite.arenas import PlanarArena, SpatialArena
from trl_suite.bodies.blocks import Block, action_reflection, by_name, columns, layout, reflected
from trl_suite.bodies.body import Measurement, Travel, write_distance
from trl_suite.bodies.reference import PHASE, Clock, Reference, joint_targets, tick
from trl_suite.characters import Character
from trl_suite.engine import World
from trl_suite.motion import Clip, FootstepLibrary
from trl_suite.policies.mirror import Mirror
from trl_suite.tasks.body_task import BodyTask
from trl_suite.tasks.common.control import start_phases
from trl_suite.tasks.common.footstep_plan import pose_of_step
from trl_suite.tasks.rewards import Comparison, Outcome, comparison, conclude
from trl_suite.tasks.task import drawn_seed
from trl_suite.util.compiled import compiled, compiled_inline, packed


class TrackingTask(BodyTask):
    """A body tracks a reference motion.

    A subclass defines the observation blocks that follow those of the body and the phase.

    Attributes:
      full: the blocks of the full observation, from which the observation is derived.
      reference: the reference motion, after `bind`.
    """

    draws = True  # whether random numbers are drawn within an episode
    along = False  # whether the distance travelled is along the heading at the start
    mirrored = False  # whether observations and actions are mirrored in left stance
    clip_parts = 1  # a reference has a track for each part of a clip
    hidden: tuple[str, ...] = ()  # names of blocks that are not observed
    reference: Reference

    def __init__(
        self,
        character: Character,
        arena: PlanarArena | SpatialArena,
        motion: Clip | FootstepLibrary,
        config: Any = None,
        *,
        actuation_model: str = 'position',
    ) -> None:
        """Composes the task.

        Args:
          character: a character without actuators; it is attached to the arena.
          arena: the arena with its terrain, planar or spatial as the character.
          motion: the reference motion: a looping clip, or a library of single steps, for this
            character.
          config: the options, a `CONFIG` of the class; by default the defaults.
          actuation_model: one of `trl_suite.actuation.ACTUATIONS`.

        Raises:
          ValueError: incompatible options, or a motion that does not fit the character.
        """
        config = self.CONFIG() if config is None else config
        self.mirrored = mirrored = getattr(config, 'mirrored', False)
        if mirrored and not character.spec.mirror:
            raise ValueError(
                f'character {character.spec.name!r} has no pairs of right and left links; mirrored '
                'observations need them'
            )
        phase = not getattr(config, 'reference_observation', False)
        if mirrored and not phase:
            raise ValueError(
                'mirrored observations need the phase, which determines the stance foot'
            )
        extras, hidden = self._further_blocks(character, config), self.hidden
        super().__init__(
            character,
            arena,
            motion,
            config,
            actuation_model,
            terrain_observation=config.terrain_observation,
            contact='contact' in {block.name for block in extras},
        )
        self.action_map = self.joint_map
        self._start_phase = start_phases(config.start_phase)
        self.full = *self.body.blocks, PHASE.observed_if(phase), *extras
        shown = tuple(block for block in self.full if block.name not in hidden)
        self._reflection = self._reflected(self.full)
        self.mirror = None if mirrored else self._reflected(shown)
        self._kept: np.ndarray = np.zeros(0, int)  # all
        if mirrored or hidden:
            slices = layout(self.full)
            self._kept = np.concatenate(
                [
                    slices[block.name].start
                    + np.array(block.kept if mirrored and block.kept else range(block.size))
                    for block in shown
                    if block.size
                ]
            )
        self.observed = tuple(block.mirrored() for block in shown) if mirrored else shown

    @abc.abstractmethod
    def _further_blocks(self, character: Character, config: Any) -> tuple[Block, ...]:
        """Returns the blocks that follow those of the body and the phase."""

    def _reflected(self, blocks: tuple[Block, ...]) -> Mirror | None:
        """Returns the reflection of these blocks and of actions; None if there is none."""
        slices, spec = layout(blocks), self.character.spec
        if 'phase' not in slices or not (spec.spatial and spec.mirror):
            return None
        actions = action_reflection(self.character, self.action_map)
        return Mirror(*reflected(blocks), *actions, slices['phase'].start)

    def _make_reference(self) -> Reference:
        """Returns the reference; it is measured with the body, which was bound."""
        motion, model = self.motion, self.world.models[0]
        if isinstance(motion, Clip):
            return Reference.of_clip(motion, self.body, model, self.clip_parts)
        return Reference.of_steps(motion, self.body, model)

    def _bind_body(self, world: World) -> Any:
        """Binds body, reference and full observation; returns the `TrackingData`."""
        full = self.outcome.observation
        if self.observed != self.full:
            full = np.zeros((world.n, sum(block.size for block in self.full)))
            self.saved = (*self.saved, by_name('Full', {'observation': full}))
        self.body.bind(world, self.joint_map, full, self.full, self.ABOUT_COM)
        self.reference = self._make_reference()
        none, mirror = np.zeros(0, int), self._reflection if self.mirrored else None
        self._view = View(
            full=full,
            columns=columns(self.full),
            mirrored=self.mirrored,
            source=none if mirror is None else mirror.observation_index,
            sign=np.zeros(0) if mirror is None else mirror.observation_sign,
            kept=self._kept,
            phase=self.blocks['phase'].start if self.mirrored else -1,
            action_source=none if mirror is None else mirror.action_index,
            action_sign=np.zeros(0) if mirror is None else mirror.action_sign,
            action=np.zeros((world.n, len(self.joint_map))),
        )
        self._view_pack = packed(self._view)
        return TrackingData(
            measurement=self.body.measurement,
            diverged=self.body.data.diverged,
            outcome=self.outcome,
            shown=self._view,
            clock=self.clock,
            travel=self.travel,
            period=self.period,
            along=self.along or not self._spatial,
            turn=self.motion.heading_change if getattr(self.motion, 'turning', False) else 0.0,
            comparison=comparison(self.character, self.reference, self.terms),
        )

    def apply_action(self, action: np.ndarray, env_ids: np.ndarray) -> None:
        if self.mirrored:
            reflect_all(env_ids, action, self._view_pack)
            action = self._view.action
        super().apply_action(action, env_ids)

    def _draw_start(
        self, env_ids: np.ndarray, random_states: Sequence[np.random.RandomState]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        for i, random_state in zip(env_ids.tolist(), random_states, strict=True):
            # Drawn even if start_phase is a constant, so that the terrain does not depend on it.
            self.clock.start[i] = self._start_phase(random_state.random_sample())
            seed, random = self.terrain_seed(i, random_state), None
            if self.draws:
                random = self._random[i] = np.random.default_rng(drawn_seed(random_state))
            self._begin_ground(i, seed, random)
        self._begin_clocks(env_ids)
        motion, phase, spawns = self.motion, self.clock.start[env_ids], self.travel.origin[env_ids]
        if isinstance(motion, FootstepLibrary):
            return *pose_of_step(motion, self._first, self.phase[env_ids]), spawns
        if not self._spatial:
            share = self.clip_parts * phase
            track = np.floor(share)
            return self.reference.planar_state(share - track, track.astype(int))
        poses, rates = motion.state(phase * self.period)
        poses[:, :2] = 0.0
        return poses, rates, spawns

    def _flat_part(self, i: int) -> dict[str, Any]:
        spawn, centre = self.config.spawn, 0.0
        if spawn == 'upstream':
            # The boundary of the original's segments, in the middle of what it considers in view: it
            # builds them before it moves the root to 0.
            middle = -0.5 if self.config.terrain_observation else 3.0
            centre = self.clip.pose(self.clock.start[i : i + 1] * self.period)[0, 0] + middle
        return {'spawn': spawn, 'centre': centre}

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
        pose[height] += self.body.heights(np.array([env_id]), place)[0]
        return pose


class View(NamedTuple):
    """The full observation, and what of it is observed, with optional mirroring in left stance.

    Attributes:
      full: the full observation, (n, size).
      columns: first columns of its blocks; -1: absent.
      mirrored: whether observations and actions are reflected in left stance.
      source, sign: a reflected full observation is `full[source] * sign`, (size,).
      kept: columns of the full observation that are observed, (k,); all of them if it is empty.
      phase: column of the phase in the observation.
      action_source, action_sign: a reflected action is `action[source] * sign`.
      action: actions after reflection, (n, k); scratch.
    """

    full: np.ndarray
    columns: Any
    mirrored: bool
    source: np.ndarray
    sign: np.ndarray
    kept: np.ndarray
    phase: int
    action_source: np.ndarray
    action_sign: np.ndarray
    action: np.ndarray


class TrackingData(NamedTuple):
    """Data for the compiled functions of tasks that track a reference motion.

    Attributes:
      measurement: of the bodies, which write their own blocks to `shown.full`.
      diverged: whether the physics has diverged in the last step, (n,).
      period: that of the motion, s.
      along: whether the distance travelled is along the heading at the start, not in any direction.
      turn: change of the motion's heading per period, rad; 0 if it does not accumulate.
    """

    measurement: Measurement
    diverged: np.ndarray
    outcome: Outcome
    shown: View
    clock: Clock
    travel: Travel
    period: float
    along: bool
    turn: float
    comparison: Comparison


@compiled
def proceed(i: int, data: TrackingData) -> bool:
    """Advances clock and distance; returns False if the physics has diverged: the step has failed."""
    tick(i, data.period, data.clock)
    data.outcome.diverged[i] = data.diverged[i]
    if data.diverged[i]:  # keeps the last finite observation
        conclude(i, True, data.outcome)
        return False
    write_distance(i, data.along, data.measurement, data.travel)
    return True


@compiled_inline
def in_left_stance(i: int, view: View) -> bool:
    """Returns whether observation and action are reflected."""
    return view.mirrored and view.full[i, view.columns.phase] >= 0.5


@compiled
def publish(i: int, view: View, outcome: Outcome) -> None:
    """Writes the observation from the full observation, unless they are the same array."""
    full, observation, left = view.full, outcome.observation, in_left_stance(i, view)
    for k in range(len(view.kept)):
        column = view.kept[k]
        if left:
            observation[i, k] = full[i, view.source[column]] * view.sign[column]
        else:
            observation[i, k] = full[i, column]
    if view.mirrored:  # the phase of the single step
        phase = full[i, view.columns.phase]
        observation[i, view.phase] = 2 * (phase - 0.5 if left else phase)


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
