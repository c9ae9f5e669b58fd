"""Walking without a reference motion: for characters without a clip, and for custom tasks."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from trl_suite.arenas import PlanarArena, SpatialArena
from trl_suite.bodies.blocks import Block, Noise, columns
from trl_suite.bodies.body import Measurement, Travel, write_distance
from trl_suite.bodies.reference import link_extents
from trl_suite.characters import Character
from trl_suite.engine import GRAVITY, World
from trl_suite.motion import quaternion
from trl_suite.tasks import parts
from trl_suite.tasks.body_task import BodyTask
from trl_suite.tasks.common.control import (
    GroundConfig,
    faces,
    joint_angle,
    physics_steps,
    planar_heights,
    terrain_maps,
)
from trl_suite.tasks.rewards import Outcome, conclude
from trl_suite.util.compiled import compiled

FROUDE = 0.25  # speed^2 / (gravity * root height) at which the speed reward reaches its maximum


class WalkData(NamedTuple):
    """Data for the compiled functions of a walk.

    Attributes:
      measurement: of the bodies, which write their own blocks to the observation.
      diverged: whether the physics has diverged in the last step, (n,).
      columns: first columns of the observation blocks.
    """

    measurement: Measurement
    diverged: np.ndarray
    columns: Any
    travel: Travel
    outcome: Outcome


@compiled
def observe(i: int, data: WalkData) -> None:
    """Writes the distance, and the block `TARGET_HEADING`."""
    write_distance(i, True, data.measurement, data.travel)
    if data.columns.target_heading >= 0:
        bearing = data.travel.origin[i, 2] - data.measurement.heading[i]
        data.outcome.observation[i, data.columns.target_heading] = math.cos(bearing)
        data.outcome.observation[i, data.columns.target_heading + 1] = math.sin(bearing)


TARGET_HEADING = Block(
    'target_heading',
    2,
    '1',
    'cosine and sine of the bearing of the target heading, the heading at the start',
    Noise((0.005, 0.02, 0.05)),
)


@compiled
def finish_all(env_ids: np.ndarray, data: WalkData) -> None:
    """Finishes steps, after bodies were measured; takes a pack."""
    for i in env_ids:
        diverged, outcome = data.diverged[i], data.outcome
        outcome.diverged[i] = diverged
        conclude(i, diverged or data.measurement.fallen[i], outcome)
        if not diverged:  # otherwise keeps the last finite observation
            observe(i, data)


@compiled
def observe_all(env_ids: np.ndarray, data: WalkData) -> None:
    """Writes distances and observations; takes a pack."""
    for i in env_ids:
        observe(i, data)


@dataclasses.dataclass(frozen=True, kw_only=True)
class WalkConfig(GroundConfig):
    """Options of `Walk`."""

    substeps: int = physics_steps(4)
    action_scale: float | None = joint_angle(', from the working posture; by default 1.5')


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlanarWalkConfig(WalkConfig):
    """Options of a planar walk."""

    terrain_observation: int = planar_heights()
    face_length: float | None = faces()


@dataclasses.dataclass(frozen=True, kw_only=True)
class SpatialWalkConfig(WalkConfig):
    """Options of a walk in three dimensions."""

    terrain_observation: str | Collection[str] = terrain_maps()


class Walk(BodyTask):
    """A planar or spatial character walks on random terrain, from its working posture.

    An episode fails when a fall link touches the ground. The task has no reward: `suite.build` adds
    `WALK`, unless the option `rewards` is given; a subclass may compute one after
    `super().finish_step`.

    Attributes:
      full_speed: speed at which the reward term `speed_ratio` reaches its maximum, m/s.
    """

    CONFIG: Any = MappingProxyType({False: PlanarWalkConfig, True: SpatialWalkConfig})
    finish_all, observe_all = finish_all, observe_all
    strain = False

    def __init__(
        self,
        character: Character,
        arena: PlanarArena | SpatialArena,
        config: PlanarWalkConfig | SpatialWalkConfig | None = None,
        *,
        actuation_model: str = 'position',
    ) -> None:
        """Composes the task.

        Args:
          character: without actuators; it is attached to the arena.
          arena: the arena with its terrain, planar or spatial as the character.
          config: the options, planar or spatial as the character; by default the defaults.
          actuation_model: one of `trl_suite.actuation.ACTUATIONS`.

        Raises:
          ValueError: incompatible options.
        """
        config = self.CONFIG[character.spec.spatial]() if config is None else config
        observed = config.terrain_observation
        super().__init__(
            character, arena, None, config, actuation_model, terrain_observation=observed
        )
        self.action_map = self.joint_map
        self.observed = *self.body.blocks, TARGET_HEADING.observed_if(self._spatial)

    def _bind_body(self, world: World) -> WalkData:
        body = self.body
        body.bind(world, self.action_map, self.outcome.observation, self.observed)
        self._pose, self._extents = self._posture(world)
        # Height of the root above the ground in the working posture, m.
        standing = self._pose[2 if self._spatial else 1] = -self._extents[2].min()
        self.full_speed = float(np.sqrt(FROUDE * GRAVITY * max(standing, 0.01)))
        return WalkData(
            measurement=body.measurement,
            diverged=body.data.diverged,
            columns=columns(self.observed),
            travel=self.travel,
            outcome=self.outcome,
        )

    @property
    def target_heading(self) -> np.ndarray:
        """Target heading of each walker, rad to the left of +x, (n,)."""
        return self.travel.origin[:, 2]

    def _posture(self, world: World) -> tuple[np.ndarray, np.ndarray]:
        """Returns the initial pose, with the root at the origin, and the extents of its geoms."""
        body, spec = self.body, self.character.spec
        values: list[float] = [0, 0, 0, 1, 0, 0, 0] if self._spatial else [0, 0, 0]
        for joint, ball in zip(spec.joints.values(), self.character.spherical, strict=True):
            if ball:
                vector = np.broadcast_to(joint.target, 3).astype(float)
                values += quaternion.from_vector(vector).tolist()
            else:
                values.append(float(np.ravel(joint.target)[0]))
        pose = np.array(values)
        data = world.posed(body.pose_qpos, pose)
        return pose, link_extents(world.models[0], data, body.geoms, np.zeros(2))

    def _draw_start(
        self, env_ids: np.ndarray, random_states: Sequence[np.random.RandomState]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        for i, random_state in zip(env_ids.tolist(), random_states, strict=True):
            self._begin_ground(i, self.terrain_seed(i, random_state), random_state)
        poses = np.tile(self._pose, (len(env_ids), 1))
        rates = np.zeros((len(env_ids), len(self.body.pose_dof)))
        if self._spatial:
            return poses, rates, self.travel.origin[env_ids]
        return poses, rates, np.tile(self._extents, (len(env_ids), 1, 1))

    def along(self, vectors: np.ndarray) -> np.ndarray:
        """Returns the components of horizontal vectors (n, 2) along the target heading, (n,)."""
        return (
            np.cos(self.target_heading) * vectors[:, 0]
            + np.sin(self.target_heading) * vectors[:, 1]
        )


def speed_ratio(task: Any) -> np.ndarray:
    """Speed along the target heading over `task.full_speed`, clipped to [0, 1], (n,)."""
    velocity = task.world.qvel.take(task.body.pose_dof[:2], 1)
    if not task.character.spec.spatial:
        velocity = velocity * [1.0, 0.0]  # the second component is vertical
    return np.clip(task.along(velocity) / task.full_speed, 0, 1)


def upright(task: Any) -> np.ndarray:
    """Cosine of the angle between the root's z axis and the vertical, at least 0, (n,)."""
    return np.maximum(parts.upright(task), 0)


def low_effort(task: Any) -> np.ndarray:
    """1 minus the mean square of the action, (n,)."""
    return 1 - parts.effort(task)


WALK = {
    'speed_ratio': (0.7, speed_ratio),
    'upright': (0.2, upright),
    'low_effort': (0.1, low_effort),
}
