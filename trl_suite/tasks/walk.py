"""Walking forward, with nothing to track: for characters without a clip, and to compose tasks of."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from trl_suite import actuation, errors
from trl_suite.action_map import Drive, drive
from trl_suite.arenas import PlanarTerrain, SpatialTerrain
from trl_suite.characters import Character
from trl_suite.engine import World, native
from trl_suite.kinematics import planar, spatial
from trl_suite.kinematics.planar import (
    PlanarBody,
    PlanarFigure,
    PlanarMeasurement,
    PlanarState,
    has_fallen,
    leaves,
    must_wait,
)
from trl_suite.kinematics.planar_reference import link_extents
from trl_suite.kinematics.spatial import (
    SpatialBody,
    SpatialFigure,
    SpatialMeasurement,
    SpatialState,
    write_body,
    write_terrain,
)
from trl_suite.motion import quaternion
from trl_suite.tasks import parts
from trl_suite.tasks.imitation import CONTROL_TIMESTEP, SUBSTEPS, VIEW_AHEAD, VIEW_BEHIND
from trl_suite.tasks.task import (
    MAX_JOINT_SPEED,
    MOST_SUBSTEPS,
    Outcome,
    Task,
    conclude,
    consecutive,
    drawn_seed,
    outcome,
    too_fast,
)
from trl_suite.terrain import Ground, Strip, spatial_ground
from trl_suite.terrain.planar_ground import PlanarGround
from trl_suite.terrain.spatial_ground import SpatialGround
from trl_suite.util.compiled import compiled, compiled_loop, packed

SAMPLES = 50  # heights on the line that a planar character sees
FROUDE = 0.25  # speed^2 / (gravity * height of the root) of a full reward
GRAVITY = 9.8  # m/s^2


class WalkState(NamedTuple):
    """What the task knows of each walker.

    Attributes:
      origin: x, y of the start, (n, 2) m.
      course: direction in which it is to go, rad to the left of +x, (n,).
      distance: travelled along the course, (n,) m.
    """

    origin: np.ndarray
    course: np.ndarray
    distance: np.ndarray


class PlanarRules(NamedTuple):
    """What the rules of a planar walk work on; `ctrl` are the controls of the physics."""

    engine: native.Engine
    body: PlanarBody
    physics: PlanarState
    ground: PlanarGround
    drive: Drive
    ctrl: np.ndarray
    found: PlanarMeasurement
    state: WalkState
    outcome: Outcome


class SpatialRules(NamedTuple):
    """What the rules of a walk in space work on.

    Attributes:
      ctrl: controls of the physics, (n, ...).
      terrain, pose, velocity, course: where these blocks begin; -1: not observed.
      leaving: whether the window of ground has to be laid anew, (n,).
    """

    engine: native.Engine
    body: SpatialBody
    physics: SpatialState
    ground: SpatialGround
    drive: Drive
    ctrl: np.ndarray
    terrain: int
    pose: int
    velocity: int
    course: int
    found: SpatialMeasurement
    state: WalkState
    leaving: np.ndarray
    outcome: Outcome


# In the plane, of simulation i and of all.


@compiled
def look_planar(i: int, rules: PlanarRules) -> None:
    """Measures and observes."""
    observation = rules.outcome.observation
    planar.measure(i, rules.body, rules.physics, rules.ground, observation, rules.found)
    x = rules.physics.qpos[i, rules.body.qpos[0]]
    rules.state.distance[i] = x - rules.state.origin[i, 0]


@compiled_loop
def act_planar(env_ids: np.ndarray, action: np.ndarray, rules: PlanarRules) -> int:
    """Takes actions; returns how many windows of ground must be laid anew."""
    leaving = 0
    for i in env_ids:
        drive(i, action, rules.drive, rules.ctrl)
        leaving += leaves(i, rules.body, rules.physics, rules.ground, rules.found)
    return leaving


@compiled_loop
def finish_planar(env_ids: np.ndarray, stepped: bool, rules: PlanarRules) -> int:
    """Finishes steps, or only observes; returns how many have to wait for ground to be drawn."""
    waiting = 0
    for i in env_ids:
        outcome = rules.outcome
        if stepped:
            outcome.diverged[i] = native.diverged(i, rules.engine) or too_fast(
                i, rules.body.dof[3:], MAX_JOINT_SPEED, rules.physics.qvel
            )
            if outcome.diverged[i]:  # the last finite observation stands
                conclude(i, True, outcome)
                continue
        rules.found.waiting[i] = must_wait(i, rules.body, rules.physics, rules.ground)
        if rules.found.waiting[i]:
            waiting += 1
            continue
        look_planar(i, rules)
        if stepped:
            conclude(i, has_fallen(i, rules.body, rules.physics), outcome)
    return waiting


# In space.


@compiled
def look_spatial(i: int, rules: SpatialRules) -> None:
    """Measures and observes."""
    found, state, observation = rules.found, rules.state, rules.outcome.observation
    spatial_ground.see_movers(i, rules.physics.qpos, rules.ground)
    spatial.measure(i, rules.body, rules.physics, rules.ground, found)
    write_terrain(i, rules.terrain, rules.ground, found, observation)
    write_body(i, rules.pose, rules.velocity, found, observation)
    bearing = state.course[i] - found.heading[i]
    observation[i, rules.course] = math.cos(bearing)
    observation[i, rules.course + 1] = math.sin(bearing)
    x, y = found.root[i, 0] - state.origin[i, 0], found.root[i, 1] - state.origin[i, 1]
    state.distance[i] = math.cos(state.course[i]) * x + math.sin(state.course[i]) * y


@compiled_loop
def act_spatial(env_ids: np.ndarray, action: np.ndarray, rules: SpatialRules) -> int:
    """Takes actions and keeps boxes moving; returns how many windows of ground must be laid."""
    leaving, root = 0, rules.body.links[0]
    for i in env_ids:
        drive(i, action, rules.drive, rules.ctrl)
        x, y = rules.physics.xpos[i, root, 0], rules.physics.xpos[i, root, 1]
        rules.leaving[i] = spatial_ground.has_left(i, x, y, rules.ground)
        if rules.leaving[i]:
            leaving += 1
        elif spatial_ground.keep_moving(
            i, x, y, rules.physics.qpos, rules.physics.qvel, rules.ground
        ):
            native.forward(i, rules.engine)
    return leaving


@compiled_loop
def finish_spatial(env_ids: np.ndarray, stepped: bool, rules: SpatialRules) -> int:
    """Finishes steps, or only observes; none has to wait."""
    for i in env_ids:
        outcome = rules.outcome
        if stepped:
            outcome.diverged[i] = native.diverged(i, rules.engine) or too_fast(
                i, rules.body.joint_dof, MAX_JOINT_SPEED, rules.physics.qvel
            )
            if outcome.diverged[i]:  # the last finite observation stands
                conclude(i, True, outcome)
                continue
        look_spatial(i, rules)
        if stepped:
            conclude(i, rules.found.fallen[i], outcome)
    return 0


class Walk(Task):
    """A character, planar or spatial, stands in its working posture on random terrain.

    It fails when a fall link touches the ground. It has no reward of its own: `suite.build` adds
    `WALK`, or the user's `rewards`. So may a subclass, after `super().finish_step`.

    Observation blocks, in this order: terrain (if seen), pose and velocity as in `Imitation` and
    `SpatialImitation`; of a spatial character
      course: cosine and sine of the bearing of the way it is to go, that of its start; 2.

    Attributes:
      pace: speed of a full reward, m/s.
    """

    def __init__(
        self,
        character: Character,
        arena: PlanarTerrain | SpatialTerrain,
        *,
        actuation_model: str = 'position',
        terrain_view: bool = False,
        substeps: int = SUBSTEPS,
        half_range: float | None = None,
        blend: float = 0.0,
    ) -> None:
        """Composes the task.

        Args:
          character: without actuators; it is attached to the arena.
          arena: where it moves, of as many dimensions.
          actuation_model: one of `trl_suite.actuation.ACTUATIONS`.
          terrain_view: observe the ground: 50 heights from 0.5 m behind to 3 m ahead, or the 32 x 32
            map of a spatial character.
          substeps: physics steps per control step of 1/30 s.
          half_range: for position control, rad per unit action about the working posture.
          blend: which mixture of the terrain's parameter sets to draw from.

        Raises:
          ValueError: options out of range.
        """
        errors.check_whole('substeps', substeps, 4, MOST_SUBSTEPS)
        self.character, self.arena = character, arena
        self._blend, self._spatial = blend, character.row.spatial
        self.terrain_map = terrain_view and self._spatial
        self.figure: Any
        if isinstance(arena, SpatialTerrain):
            self.figure = SpatialFigure(character, arena, terrain_view)
            self.fields = SpatialFigure.fields
        else:
            samples = SAMPLES if terrain_view else 0
            self.figure = PlanarFigure(character, arena, VIEW_BEHIND, VIEW_AHEAD, samples)
        self.set_timesteps(CONTROL_TIMESTEP, CONTROL_TIMESTEP / substeps)
        options = {} if half_range is None else {'half_range': half_range}
        if options and actuation_model != 'position':
            raise ValueError(f'half_range shapes position control, not {actuation_model} control')
        self.action_map = actuation.add(
            character, actuation_model, self.physics_timestep, **options
        )
        self.blocks = consecutive({**self.figure.blocks, 'course': 2 * self._spatial})

    @property
    def root_entity(self) -> PlanarTerrain | SpatialTerrain:
        return self.arena

    @property
    def signature(self) -> str:
        parts = self.character.row.name, self.arena.terrain.name
        return f'{super().signature} of {" / ".join(parts)}'

    def bind(self, world: World) -> None:
        self.world, n = world, world.n
        figure = self.figure
        if isinstance(self.arena, SpatialTerrain):
            figure.bind(world)
        else:
            figure.bind(world, self.blocks)
        self._pose, self._extents = self._posture(world)
        # In m; of the root over the ground, in the working posture.
        standing = self._pose[2 if self._spatial else 1] = -self._extents[2].min()
        self.pace = float(np.sqrt(FROUDE * GRAVITY * max(standing, 0.01)))
        self.state = WalkState(np.zeros((n, 2)), np.zeros(n), np.zeros(n))
        self.outcome = outcome(n, max(part.stop for part in self.blocks.values()), 0)
        self.saved = (self.state, self.outcome)
        self.info_arrays = {
            'reward_terms': {},
            'fell': self.outcome.fell,
            'diverged': self.outcome.diverged,
            'distance': self.state.distance,
        }
        scope = f'{self.character.mjcf_model.model}/'
        # Actuators were added one after the other.
        first = int(world.control_addresses([scope + self.action_map.actuators[0]])[0])
        common: Any = (
            world.engine,
            figure.body,
            figure.state,
            figure.ground,
            self.action_map.drive(first),
        )
        starts = {name: part.start for name, part in self.blocks.items()}
        rules: SpatialRules | PlanarRules
        if self._spatial:
            rules = SpatialRules(  # type: ignore[call-arg]
                *common, world.ctrl,
                *(starts.get(name, -1) for name in ('terrain', 'pose', 'velocity', 'course')),
                figure.found, self.state, np.zeros(n, bool), self.outcome,
            )  # fmt: skip
            self._leaving, self._waiting = rules.leaving, np.zeros(n, bool)
            self._act, self._finish = act_spatial, finish_spatial
        else:
            found = figure.measurement()
            rules = PlanarRules(  # type: ignore[call-arg]
                *common, world.ctrl, found, self.state, self.outcome
            )
            self._leaving, self._waiting = found.leaving, found.waiting
            self._act, self._finish = act_planar, finish_planar
        self._pack = packed(rules)

    @property
    def course(self) -> np.ndarray:
        """Direction in which each walker is to go, rad to the left of +x, (n,)."""
        return self.state.course

    def _posture(self, world: World) -> tuple[np.ndarray, np.ndarray]:
        """Returns the pose of the start about the origin, and the extents of its geoms."""
        figure, row = self.figure, self.character.row
        values: list[float] = [0, 0, 0, 1, 0, 0, 0] if self._spatial else [0, 0, 0]
        for joint, ball in zip(row.joints.values(), self.character.spherical, strict=True):
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
            seed = drawn_seed(random_state)
            if isinstance(self.arena, SpatialTerrain):
                ground = Ground(terrain, seed, blend=self._blend)
                spawns[k] = ground.spawn(random_state)
                self.arena.begin_episode(i, ground, spawns[k, :2])
            else:
                self.arena.begin_episode(i, Strip(terrain, seed, blend=self._blend))
        if self._spatial:
            self.figure.place(env_ids, poses, rates, spawns)
        else:
            self.figure.place(env_ids, poses, rates, np.tile(self._extents, (count, 1, 1)))
        self.state.origin[env_ids], self.course[env_ids] = spawns[:, :2], spawns[:, 2]
        for array in self.outcome[1:]:  # all but the observation
            array[env_ids] = 0
        self.observe(env_ids)

    def apply_action(self, action: np.ndarray, env_ids: np.ndarray) -> None:
        if self._act(env_ids, action, self._pack):
            # Ground is laid before the physics, so that what is rendered afterwards is up to date.
            leaving = env_ids[self._leaving[env_ids]]
            if isinstance(self.arena, SpatialTerrain):
                self.arena.follow(self.world.xpos[leaving, self.figure.links[0], :2], leaving)
            else:
                self.figure.follow(leaving)

    def finish_step(self, env_ids: np.ndarray) -> None:
        if self._finish(env_ids, True, self._pack):
            self._finish(self._widened(env_ids), True, self._pack)

    def observe(self, env_ids: np.ndarray | None = None) -> None:
        env_ids = self.world.all_ids if env_ids is None else env_ids
        if self._finish(env_ids, False, self._pack):
            self._finish(self._widened(env_ids), False, self._pack)

    def _widened(self, env_ids: np.ndarray) -> np.ndarray:
        """Draws the ground that some simulations look back on; returns which have waited for it."""
        waiting = env_ids[self._waiting[env_ids]]
        assert isinstance(self.arena, PlanarTerrain)
        for i in waiting.tolist():
            self.arena.widen(i)
        return waiting

    def along(self, vectors: np.ndarray) -> np.ndarray:
        """Returns the parts of horizontal vectors (n, 2) that go along the course, (n,)."""
        return np.cos(self.course) * vectors[:, 0] + np.sin(self.course) * vectors[:, 1]


def pace(task: Any) -> np.ndarray:
    """Speed along the course in shares of that of a full reward, in [0, 1], (n,)."""
    velocity = task.world.qvel.take(task.figure.pose_dof[:2], 1)
    if not task.character.row.spatial:
        velocity = velocity * [1.0, 0.0]  # the other one is upward
    return np.clip(task.along(velocity) / task.pace, 0, 1)


def upright(task: Any) -> np.ndarray:
    """How upright the root is, in [0, 1], (n,)."""
    return np.maximum(parts.upright(task), 0)


def ease(task: Any) -> np.ndarray:
    """1 less the mean square of the action, (n,)."""
    return 1 - parts.effort(task)


WALK = {'pace': (0.7, pace), 'upright': (0.2, upright), 'ease': (0.1, ease)}
