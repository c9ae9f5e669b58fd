"""Walking without a reference motion: for characters without a clip, and for custom tasks."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from trl_suite import actuation
from trl_suite.arenas import PlanarArena, SpatialArena
from trl_suite.bodies.blocks import Block, Noise, columns
from trl_suite.bodies.body import Measurement
from trl_suite.bodies.reference import CONTROL_TIMESTEP, link_extents
from trl_suite.bodies.state import POINT, REAL, allocated
from trl_suite.characters import Character
from trl_suite.engine import World
from trl_suite.motion import quaternion
from trl_suite.tasks import parts
from trl_suite.tasks.common.control import HEIGHT_MAP, check_position_options, maps, planar_heights
from trl_suite.tasks.rewards import Outcome, conclude
from trl_suite.tasks.task import MOST_SUBSTEPS, SUBSTEPS, TERRAIN_LEVEL, Task
from trl_suite.tasks.tracking import make_body
from trl_suite.terrain import PlanarGround, SpatialGround
from trl_suite.util.compiled import compiled, packed
from trl_suite.util.options import Config, option

FROUDE = 0.25  # speed^2 / (gravity * root height) at which the speed reward reaches its maximum
GRAVITY = 9.8  # m/s^2


class WalkState(NamedTuple):
    """State of each walker.

    Attributes:
      origin: x, y of the start, (n, 2) m.
      target_heading: direction to walk in, rad to the left of +x, (n,).
      distance: distance travelled along the target heading, (n,) m.
    """

    origin: np.ndarray = POINT
    target_heading: np.ndarray = REAL
    distance: np.ndarray = REAL


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
    state: WalkState
    outcome: Outcome


@compiled
def observe(i: int, data: WalkData) -> None:
    """Writes the distance, and the block `TARGET_HEADING`."""
    state, columns, measurement = data.state, data.columns, data.measurement
    if columns.target_heading >= 0:
        bearing = state.target_heading[i] - measurement.heading[i]
        data.outcome.observation[i, columns.target_heading] = math.cos(bearing)
        data.outcome.observation[i, columns.target_heading + 1] = math.sin(bearing)
    x, y = measurement.root[i, 0] - state.origin[i, 0], measurement.root[i, 1] - state.origin[i, 1]
    state.distance[i] = (
        math.cos(state.target_heading[i]) * x + math.sin(state.target_heading[i]) * y
    )


TARGET_HEADING = Block(
    'target_heading',
    2,
    '1',
    'cosine and sine of the bearing of the target heading, the heading at the start',
    Noise((0.005, 0.02, 0.05)),
)


@compiled
def finish_all(env_ids: np.ndarray, stepped: bool, data: WalkData) -> None:
    """Finishes steps, or only observes, after bodies were measured; takes a pack."""
    for i in env_ids:
        outcome = data.outcome
        if stepped:
            outcome.diverged[i] = data.diverged[i]
            conclude(i, data.diverged[i] or data.measurement.fallen[i], outcome)
            if data.diverged[i]:  # keeps the last finite observation
                continue
        observe(i, data)


@dataclasses.dataclass(frozen=True, kw_only=True)
class WalkConfig(Config):
    """Options of `Walk`."""

    substeps: int = option(
        SUBSTEPS, 'physics steps per control step of 1/30 s', at_least=4, at_most=MOST_SUBSTEPS
    )
    action_scale: float | None = option(
        None,
        'joint angle per unit action, from the working posture; by default 1.5',
        unit='rad',
        above=0,
        actuation='position',
    )
    terrain_level: float = option(0.0, TERRAIN_LEVEL)


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlanarWalkConfig(WalkConfig):
    """Options of a planar walk."""

    terrain_observation: int = planar_heights()


@dataclasses.dataclass(frozen=True, kw_only=True)
class SpatialWalkConfig(WalkConfig):
    """Options of a walk in three dimensions."""

    terrain_observation: str | Collection[str] = option((), HEIGHT_MAP, choices=('height',))

    def __post_init__(self) -> None:
        super().__post_init__()
        self._set('terrain_observation', maps(self.terrain_observation))


class Walk(Task):
    """A planar or spatial character walks on random terrain, from its working posture.

    An episode fails when a fall link touches the ground. The task has no reward: `suite.build` adds
    `WALK`, unless the option `rewards` is given; a subclass may compute one after
    `super().finish_step`.

    Attributes:
      full_speed: speed at which the reward term `speed_ratio` reaches its maximum, m/s.
    """

    CONFIG: Any = MappingProxyType({False: PlanarWalkConfig, True: SpatialWalkConfig})

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
        self._spatial = character.spec.spatial
        if config is None:
            config = SpatialWalkConfig() if self._spatial else PlanarWalkConfig()
        self.character, self.arena, self.config = character, arena, config
        self.actuation_model = actuation_model
        self.figure: Any = make_body(character, arena, config.terrain_observation)
        self.fields = self.figure.fields
        self.set_timesteps(CONTROL_TIMESTEP, CONTROL_TIMESTEP / config.substeps)
        check_position_options(actuation_model, 'clip', config.action_scale)
        scale = config.action_scale
        options = {} if scale is None else {'action_scale': scale}
        self.action_map = actuation.add(
            character, actuation_model, self.physics_timestep, **options
        )
        self.observed = *self.figure.blocks, TARGET_HEADING.observed_if(self._spatial)

    @property
    def root_entity(self) -> PlanarArena | SpatialArena:
        return self.arena

    def bind(self, world: World) -> None:
        self.world, n = world, world.n
        self.state = allocated(WalkState, n)
        self._allocate(n, self.state.distance)
        self.saved = (self.state, self.outcome)
        figure = self.figure
        figure.bind(world, self.action_map, self.outcome.observation, self.observed)
        self._pose, self._extents = self._posture(world)
        # Height of the root above the ground in the working posture, m.
        standing = self._pose[2 if self._spatial else 1] = -self._extents[2].min()
        self.full_speed = float(np.sqrt(FROUDE * GRAVITY * max(standing, 0.01)))
        data = WalkData(
            measurement=figure.measurement,
            diverged=figure.data.diverged,
            columns=columns(self.observed),
            state=self.state,
            outcome=self.outcome,
        )
        self._pack = packed(data)

    @property
    def target_heading(self) -> np.ndarray:
        """Target heading of each walker, rad to the left of +x, (n,)."""
        return self.state.target_heading

    def _posture(self, world: World) -> tuple[np.ndarray, np.ndarray]:
        """Returns the initial pose, with the root at the origin, and the extents of its geoms."""
        figure, spec = self.figure, self.character.spec
        values: list[float] = [0, 0, 0, 1, 0, 0, 0] if self._spatial else [0, 0, 0]
        for joint, ball in zip(spec.joints.values(), self.character.spherical, strict=True):
            if ball:
                vector = np.broadcast_to(joint.target, 3).astype(float)
                values += quaternion.from_vector(vector).tolist()
            else:
                values.append(float(np.ravel(joint.target)[0]))
        pose = np.array(values)
        data = world.posed(figure.pose_qpos, pose)
        geoms = world.geom_ids([g.full_identifier for g in self.character.collision_geoms])
        return pose, link_extents(world.models[0], data, geoms, np.zeros(2))

    def reset(self, env_ids: np.ndarray, random_states: Sequence[np.random.RandomState]) -> None:
        terrain, count = self.arena.terrain, len(env_ids)
        poses = np.tile(self._pose, (count, 1))
        rates = np.zeros((count, len(self.figure.pose_dof)))
        self.world.reset(env_ids)
        spawns = np.zeros((count, 3))
        for k, (i, random_state) in enumerate(zip(env_ids.tolist(), random_states, strict=True)):
            seed = self.terrain_seed(i, random_state)
            level = self.config.terrain_level
            if isinstance(self.arena, SpatialArena):
                ground = SpatialGround(terrain, seed, terrain_level=level)
                spawns[k] = ground.spawn(random_state)
                self.arena.begin_episode(i, ground, spawns[k, :2])
            else:
                self.arena.begin_episode(i, PlanarGround(terrain, seed, terrain_level=level))
        where = spawns if self._spatial else np.tile(self._extents, (count, 1, 1))
        self.figure.place(env_ids, poses, rates, where)
        self.state.origin[env_ids], self.target_heading[env_ids] = spawns[:, :2], spawns[:, 2]
        for array in self.outcome[1:]:  # all but the observation
            array[env_ids] = 0
        self.observe(env_ids)

    def apply_action(self, action: np.ndarray, env_ids: np.ndarray) -> None:
        self.figure.control(env_ids, action)

    def finish_step(self, env_ids: np.ndarray) -> None:
        self.figure.measure(env_ids, stepped=True)
        finish_all(env_ids, True, self._pack)

    def observe(self, env_ids: np.ndarray | None = None) -> None:
        env_ids = self.world.all_ids if env_ids is None else env_ids
        self.figure.measure(env_ids)
        finish_all(env_ids, False, self._pack)

    def along(self, vectors: np.ndarray) -> np.ndarray:
        """Returns the components of horizontal vectors (n, 2) along the target heading, (n,)."""
        return (
            np.cos(self.target_heading) * vectors[:, 0]
            + np.sin(self.target_heading) * vectors[:, 1]
        )


def speed_ratio(task: Any) -> np.ndarray:
    """Speed along the target heading over `task.full_speed`, clipped to [0, 1], (n,)."""
    velocity = task.world.qvel.take(task.figure.pose_dof[:2], 1)
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
