"""Tracking a motion clip in three dimensions: the 3D environments of the Imitation family.

Source: the imitation scenario of the original, as for `trl_suite.tasks.imitation.planar`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from trl_suite.arenas import SpatialArena
from trl_suite.characters import Character
from trl_suite.engine import World
from trl_suite.kinematics.blocks import Block
from trl_suite.kinematics.spatial import SpatialBodyData, breaks_down, look, polar
from trl_suite.kinematics.spatial_reference import SpatialReference, feature, moment
from trl_suite.motion import Clip, quaternion
from trl_suite.tasks.common import rewards
from trl_suite.tasks.common.comparison import (
    Comparison,
    com_error,
    comparison,
    effector_error,
    motion_errors,
)
from trl_suite.tasks.common.goals import GOAL
from trl_suite.tasks.common.rewards import score_tracking
from trl_suite.tasks.common.spatial_rules import (
    Clock,
    Travel,
    View,
    observe_body,
    observe_phase,
    publish,
    tick,
)
from trl_suite.tasks.spatial_task import MirroredConfig, TrackingTask
from trl_suite.tasks.terms import Outcome, conclude
from trl_suite.terrain import SpatialGround
from trl_suite.util.compiled import compiled, packed
from trl_suite.util.options import option

GOAL_AHEAD = (
    3.0  # m; distance of the goal ahead of the root, on the line along +x through the start
)
TYPICAL_POSES = 256  # poses of a cycle; their mean is action 0 of position control


class ImitationData(NamedTuple):
    """Data for the compiled functions of imitation; `period`: that of the clip, s."""

    body: SpatialBodyData
    outcome: Outcome
    given: View
    clock: Clock
    travel: Travel
    period: float
    comparison: Comparison


# A step of simulation i, in order.


@compiled
def finish_step(i: int, data: ImitationData) -> None:
    """Computes reward, failure and observation, after the physics was advanced."""
    body = data.body
    tick(i, data.period, data.clock)
    data.outcome.diverged[i] = breaks_down(i, body)
    if data.outcome.diverged[i]:
        conclude(i, True, data.outcome)
        return
    measure(i, data)
    compare(i, data)
    conclude(i, body.measurement.fallen[i], data.outcome)
    observe(i, data)


@compiled
def measure(i: int, data: ImitationData) -> None:
    """Measures the body, and the distance travelled along +x."""
    look(i, data.body)
    data.travel.distance[i] = data.body.measurement.root[i, 0] - data.travel.origin[i, 0]


@compiled
def compare(i: int, data: ImitationData) -> None:
    """Writes the reward terms, from errors of pose, velocities and end effectors."""
    comparison, measurement = data.comparison, data.body.measurement
    row, fraction = moment(data.clock.phase[i], 0, comparison.tracks)
    pose, velocity, height = motion_errors(i, row, fraction, comparison, measurement)
    end_effector = effector_error(i, row, fraction, comparison, measurement)
    com = com_error(i, row, fraction, 0.0, comparison, measurement)
    terms, outcome = comparison.terms, data.outcome
    score_tracking(i, pose, velocity, end_effector, com, height, terms, outcome)


@compiled
def observe(i: int, data: ImitationData) -> None:
    """Writes the observation."""
    body, columns, full = data.body, data.given.columns, data.given.full
    observe_body(i, columns, body, full)
    observe_phase(i, columns, data.clock, full)
    if columns.reference >= 0:
        tracks, features = data.comparison.tracks, data.comparison.columns
        row, fraction = moment(data.clock.phase[i], 0, tracks)
        full[i, columns.reference] = feature(row, fraction, features.height, tracks)
        for k in range(6 * len(body.ids.links)):  # positions and velocities of the links
            value = feature(row, fraction, features.positions + k, tracks)
            full[i, columns.reference + 1 + k] = value
    aside = data.travel.origin[i, 1] - body.measurement.root[i, 1]
    full[i, columns.goal], full[i, columns.goal + 1] = polar(i, GOAL_AHEAD, aside, body.measurement)
    publish(i, data.given, data.outcome)


def motion_blocks(links: int, reference: bool) -> tuple[Block, ...]:
    """Returns the blocks that `observe` writes after those of the body."""
    return (
        Block(
            'reference', 1 + 6 * links if reference else 0, 'm, m/s',
            'root height, link centres from the root, and velocities of link centres of the reference',
            'the reference is known to the controller',
        ),
        dataclasses.replace(
            GOAL, meaning='bearing (positive to the left) and distance of the point 3 m ahead on the line '
            'along +x through the start',
        ),
    )  # fmt: skip


# Loops over simulations; they take packs.


@compiled
def finish_steps(env_ids: np.ndarray, data: ImitationData) -> None:
    """Finishes steps."""
    for i in env_ids:
        finish_step(i, data)


@compiled
def observe_all(env_ids: np.ndarray, data: ImitationData) -> None:
    """Measures, writes reward terms for the current state, and observes."""
    for i in env_ids:
        measure(i, data)
        compare(i, data)
        observe(i, data)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SpatialImitationConfig(MirroredConfig):
    """Options of `SpatialImitation`."""

    reference_observation: bool = option(
        False, 'observe the state of the reference instead of the phase'
    )


class SpatialImitation(TrackingTask):
    """A spatial character tracks a looping clip along +x, over random terrain.

    The goal is a point on the line through the start along +x. The original observes bearing and
    distance of the start instead, from which the direction +x cannot be derived.

    Mirrored observations and actions are reflected while the phase is 0.5 or more; the block phase
    then has the phase of the single step and the one-hot of its half.
    """

    terms = rewards.IMITATION_TERMS

    CONFIG: Any = SpatialImitationConfig

    def __init__(
        self,
        character: Character,
        arena: SpatialArena,
        clip: Clip,
        config: SpatialImitationConfig = SpatialImitationConfig(),
        *,
        actuation_model: str = 'position',
    ) -> None:
        """Composes the task.

        Args:
          character: a spatial character without actuators; it is attached to the arena.
          arena: the arena with its terrain.
          clip: a looping clip for this character, with a free root.
          config: the options.
          actuation_model: one of `trl_suite.actuation.ACTUATIONS`.

        Raises:
          ValueError: incompatible options, or a clip that does not fit the character.
        """
        check_cycle(clip)
        self.clip, reference = clip, config.reference_observation
        super().__init__(
            character, arena, clip, cycle_poses(clip), config, period=clip.duration,
            actuation_model=actuation_model, phase=not reference,
            extras=motion_blocks(len(character.spec.links), reference),
        )  # fmt: skip

    def bind(self, world: World) -> None:
        view = self._bind_view(world)
        self.reference = SpatialReference.of_clip(self.clip, self.figure.body, world.models[0])
        self._pack = packed(
            ImitationData(
                body=self.figure.data,
                outcome=self.outcome,
                given=view,
                clock=self.clock,
                travel=self.travel,
                period=self.period,
                comparison=comparison(self.character, self.reference, self.terms),
            )
        )

    def _start(
        self, env_ids: np.ndarray, random_states: Sequence[np.random.RandomState]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        for i, random_state in zip(env_ids.tolist(), random_states, strict=True):
            # Drawn even if start_phase is a constant, so that the terrain does not depend on it.
            drawn = random_state.random_sample()
            self.clock.start[i] = self._start_phase(drawn)
            ground = SpatialGround(
                self.arena.terrain,
                self.terrain_seed(i, random_state),
                terrain_level=self.config.terrain_level,
            )
            self.arena.begin_episode(i, ground)
        self._begin_clocks(env_ids)
        return *pose_of_clip(self.clip, self.clock.start[env_ids]), np.zeros((len(env_ids), 3))

    def finish_step(self, env_ids: np.ndarray) -> None:
        finish_steps(env_ids, self._pack)

    def observe(self, env_ids: np.ndarray | None = None) -> None:
        observe_all(self.world.all_ids if env_ids is None else env_ids, self._pack)

    def clip_action(self, env_id: int) -> np.ndarray:
        """Returns the action that moves the joints along the clip, in open loop.

        Raises:
          ValueError: torque control has no such action.
        """
        action = clip_action(self, self.clip, env_id)
        if self.mirrored and self.phase[env_id] >= 0.5:
            assert self._reflection is not None
            action = self._reflection.action(action[None])[0]
        return action

    def reference_pose(self, env_id: int) -> np.ndarray:
        """Returns the pose of the reference from the same start: root, then joints."""
        cycles = np.array([self.clock.start[env_id], self.cycles[env_id]])
        first, pose = self.clip.pose(cycles * self.period)
        pose[:2] += self.travel.origin[env_id, :2] - first[:2]
        env_ids = np.array([env_id])
        pose[2] += self.arena.height(pose[None, :1], pose[None, 1:2], env_ids)[0, 0]
        return pose


def check_cycle(clip: Clip) -> None:
    """Checks that a clip loops and has a free root.

    Raises:
      ValueError: it does not.
    """
    if clip.root != 'free' or not clip.loop:
        raise ValueError(
            f'clip {clip.name!r} (root {clip.root}, {"looping" if clip.loop else "not looping"})'
            ' cannot be used for a spatial task: expected a looping clip with a free root'
        )


def cycle_poses(clip: Clip) -> np.ndarray:
    """Returns poses of a cycle, whose mean is action 0 of position control, (k, columns)."""
    return clip.pose(np.linspace(0, clip.duration, TYPICAL_POSES, endpoint=False))


def pose_of_clip(clip: Clip, cycles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns poses with x = y = 0, and rates, of a clip at times in cycles (m,)."""
    poses, rates = clip.state(cycles * clip.duration)
    poses[:, :2] = 0.0
    return poses, rates


def clip_action(task: TrackingTask, clip: Clip, env_id: int) -> np.ndarray:
    """Returns the action that moves the joints along a clip, in open loop.

    Raises:
      ValueError: torque control has no such action.
    """
    if task.actuation_model not in ('position', 'velocity'):
        raise ValueError(
            f'{task.actuation_model} control cannot follow a clip open loop; position and '
            'velocity control can'
        )
    time = task.phase[env_id : env_id + 1] * task.period
    if task.actuation_model == 'velocity':
        return task.action_map.action(clip.velocity(time)[0, 6:])
    return task.action_map.action(joint_targets(clip, clip.pose(time)[0]))


def joint_targets(clip: Clip, pose: np.ndarray) -> np.ndarray:
    """Returns targets of position control for a pose (columns,): rotation vectors and angles."""
    parts, column = [], 7
    for size in clip.sizes:
        value = pose[column : column + size]
        parts.append(quaternion.rotation_vector(value) if size == 4 else value)
        column += size
    return np.concatenate(parts)
