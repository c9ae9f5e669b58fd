"""Walking forward, with nothing to track: for characters without a clip, and to compose tasks of."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np

from trl_suite import actuation
from trl_suite.arenas import PlanarTerrain, SpatialTerrain
from trl_suite.characters import Character
from trl_suite.engine import World
from trl_suite.kinematics.planar_reference import link_extents
from trl_suite.tasks import parts
from trl_suite.tasks.batch_task import BatchTask
from trl_suite.tasks.figure import PlanarFigure
from trl_suite.tasks.figure3d import SpatialFigure
from trl_suite.tasks.imitation import CONTROL_TIMESTEP, SUBSTEPS, VIEW_AHEAD, VIEW_BEHIND
from trl_suite.tasks.task import MAX_JOINT_SPEED, consecutive, drawn_seed
from trl_suite.terrain import Ground, Strip

SAMPLES = 50  # heights on the line that a planar character sees
FROUDE = 0.25  # speed^2 / (gravity * height of the root) of a full reward
GRAVITY = 9.8  # m/s^2


class Walk(BatchTask):
    """A character, planar or spatial, stands in its working posture on random terrain.

    It fails when a fall link touches the ground. It has no reward of its own: `suite.build` adds
    `WALK`, or the user's `rewards`. So may a subclass, after `super().finish_step`.

    Observation blocks, in this order: terrain (if seen), pose and velocity as in `Imitation` and
    `SpatialImitation`; of a spatial character
      course: cosine and sine of the bearing of the way it is to go, that of its start; 2.

    Attributes:
      course: that way, rad to the left of +x, (n,).
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
        if int(substeps) != substeps or substeps < 4:
            raise ValueError(f'substeps is {substeps}; expected an integer of at least 4')
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
        if self._spatial:
            figure.bind(world, 'com')
        else:
            figure.bind(world)
        scope = f'{self.character.mjcf_model.model}/'
        first = int(world.control_addresses([scope + self.action_map.actuators[0]])[0])
        self._ctrl = world.ctrl[:, first : first + len(self.action_map)]  # one after the other
        self._root = int(world.body_ids([self.character.root_body.full_identifier])[0])
        self._dof = figure.pose_dof[6 if self._spatial else 3 :]
        self._pose, self._extents = self._posture(world)
        # In m; of the root over the ground, in the working posture.
        standing = self._pose[2 if self._spatial else 1] = -self._extents[2].min()
        self.pace = float(np.sqrt(FROUDE * GRAVITY * max(standing, 0.01)))
        self.course = np.zeros(n)
        self._origin = np.zeros((n, 2))
        self.observation = np.zeros((n, max(part.stop for part in self.blocks.values())))
        self.reward, self.failed, self.diverged = np.zeros(n), np.zeros(n, bool), np.zeros(n, bool)
        if not self._spatial:
            self._view = figure.views(
                self.observation, self.blocks, np.zeros((n, 2 * len(figure.effectors))),
                np.zeros((n, 2)),
            )  # fmt: skip

    def _posture(self, world: World) -> tuple[np.ndarray, np.ndarray]:
        """Returns the pose of the start about the origin, and the extents of its geoms."""
        figure, row = self.figure, self.character.row
        values: list[float] = [0, 0, 0, 1, 0, 0, 0] if self._spatial else [0, 0, 0]
        for joint, ball in zip(row.joints.values(), self.character.spherical, strict=True):
            if ball:
                quaternion = np.zeros(4)
                vector = np.broadcast_to(joint.target, 3).astype(float)
                mujoco.mju_axisAngle2Quat(
                    quaternion, vector / max(np.linalg.norm(vector), 1e-9), np.linalg.norm(vector)
                )
                values += quaternion.tolist()
            else:
                values.append(float(np.ravel(joint.target)[0]))
        pose = np.array(values)
        model = world.models[0]
        data = mujoco.MjData(model)
        data.qpos[figure.pose_qpos] = pose
        mujoco.mj_fwdPosition(model, data)
        geoms = world.geom_ids([g.full_identifier for g in self.character.collision_geoms])
        return pose, link_extents(model, data, geoms, np.zeros(2))

    def begin_episodes(
        self, rows: np.ndarray, random_states: Sequence[np.random.RandomState]
    ) -> None:
        terrain, count = self.arena.terrain, len(rows)
        poses = np.tile(self._pose, (count, 1))
        rates = np.zeros((count, len(self.figure.pose_dof)))
        self.world.reset(rows)
        spawns = np.zeros((count, 3))
        for i, (row, random_state) in enumerate(zip(rows.tolist(), random_states, strict=True)):
            seed = drawn_seed(random_state)
            if isinstance(self.arena, SpatialTerrain):
                ground = Ground(terrain, seed, blend=self._blend)
                spawns[i] = ground.spawn(random_state)
                self.arena.begin_episode(row, ground, spawns[i, :2])
            else:
                self.arena.begin_episode(row, Strip(terrain, seed, blend=self._blend))
        if self._spatial:
            self.figure.place(rows, poses, rates, spawns)
        else:
            self.figure.place(rows, poses, rates, np.tile(self._extents, (count, 1, 1)))
        self._origin[rows], self.course[rows] = spawns[:, :2], spawns[:, 2]
        self.failed[rows] = self.diverged[rows] = False
        self.reward[rows] = 0.0

    def act(self, action: np.ndarray) -> None:
        self._ctrl[...] = self.action_map.control(action)
        # Ground ahead is laid before the physics, so that its pictures are current after it.
        place = self.world.xpos[:, self._root]
        self.arena.follow(place[:, :2] if self._spatial else place[:, :1])

    def finish_step(self, stepped: np.ndarray | None = None) -> None:
        rates = self.world.qvel.take(self._dof, 1)
        self.diverged[:] = False
        if np.vdot(rates, rates) > MAX_JOINT_SPEED**2 or self.world.any_diverged():
            too_fast = np.abs(rates).max(1) > MAX_JOINT_SPEED
            np.logical_or(self.world.diverged(), too_fast, out=self.diverged)
        kept = self.observation[self.diverged]
        with np.errstate(invalid='ignore' if len(kept) else 'warn'):
            found = self._measure()
        self.observation[self.diverged] = kept  # the last finite one stands for what broke down
        np.logical_or(found.fall.any(1), self.diverged, out=self.failed)

    def observe(self, env_ids: np.ndarray | None = None) -> None:
        self._measure()

    def _measure(self) -> SimpleNamespace:
        if not self._spatial:
            self.figure.measure(self._view)
            return self._view
        found = self.figure.measure()
        self.figure.write(found, self.observation, self.blocks)
        bearing = self.course - found.heading
        course = self.observation[:, self.blocks['course']]
        course[:, 0], course[:, 1] = np.cos(bearing), np.sin(bearing)
        return found

    def along(self, vectors: np.ndarray) -> np.ndarray:
        """Returns the parts of horizontal vectors (n, 2) that go along the course, (n,)."""
        return np.cos(self.course) * vectors[:, 0] + np.sin(self.course) * vectors[:, 1]

    def infos(self) -> dict[str, Any]:
        """Fall and divergence flags, and the distance travelled along the course in m."""
        way = self.world.xpos[:, self._root, :2] - self._origin
        return {
            'reward_terms': {},
            'fell': self.failed & ~self.diverged,
            'diverged': self.diverged.copy(),
            'distance': self.along(way),
        }

    def get_state(self, row: int) -> dict[str, Any]:
        return {
            'arena': self.arena.state(row),
            'origin': self._origin[row].copy(),
            'course': float(self.course[row]),
            'observation': self.observation[row].copy(),
            'reward': float(self.reward[row]),
            'failed': bool(self.failed[row]),
            'diverged': bool(self.diverged[row]),
        }

    def set_state(self, row: int, state: dict[str, Any]) -> None:
        self.arena.restore(row, state['arena'])
        self._origin[row], self.course[row] = state['origin'], state['course']
        self.observation[row], self.reward[row] = state['observation'], state['reward']
        self.failed[row], self.diverged[row] = state['failed'], state['diverged']


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
