"""Tracking a motion clip in three dimensions: the 3D rows of the Imitation family.

Source: the imitation scenario of the original, as for `trl_suite.tasks.imitation`.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace

import numpy as np

from trl_suite.arenas import SpatialTerrain
from trl_suite.characters import Character
from trl_suite.engine import World
from trl_suite.motion import Clip, quaternion
from trl_suite.tasks import rewards
from trl_suite.tasks.figure3d import polar
from trl_suite.tasks.reference3d import SpatialReference
from trl_suite.tasks.reflection3d import Reflection
from trl_suite.tasks.task import drawn_seed
from trl_suite.tasks.tracking3d import SUBSTEPS, Tracking
from trl_suite.terrain import Ground

GOAL_AHEAD = 3.0  # m along x; where the goal on the line through the start lies
CYCLE_SAMPLES = 256  # poses whose mean is the middle of position control


class SpatialImitation(Tracking):
    """A spatial character tracks a looping clip along +x, over random terrain.

    Observation blocks, in this order (N links; heading frame: x along the root's heading, y to the
    left, z up; heights are relative to the ground under the root):
      terrain: the 32 x 32 map of `Surroundings.height_map`, m, if asked for.
      pose: height of the root, then of every link the position of its centre relative to the root
        (3), m, and its orientation (4) as a quaternion wxyz with w not negative; 7N + 1.
      velocity: of every link the velocity of its centre (3), m/s, against the ground under the
        root, and its angular velocity (3), rad/s; 6N.
      phase: phase in [0, 1), then the one-hot of its quarter; 5. Or instead
      target: height of the reference's root, then its link positions relative to its root, then
        its link velocities, in the reference's heading frame; 6N + 1.
      goal: bearing (rad, positive to the left) and distance (m) of the point on the line through
        the start along +x that is 3 m further along than the root: which way is straight on. The
        original has bearing and distance of the start there, of no use to anybody, and its walkers
        cannot tell where +x is.
    Mirrored observations are reflected while the phase is 0.5 or more, and so are their actions; of
    the phase they keep that of the single step and the one-hot of its half.
    """

    TERMS = rewards.IMITATION_TERMS
    ABOUT = 'com'

    def __init__(
        self,
        character: Character,
        arena: SpatialTerrain,
        clip: Clip,
        *,
        actuation_model: str = 'position',
        terrain_map: bool = False,
        target: bool = False,
        mirrored: bool = False,
        substeps: int = SUBSTEPS,
        centre: str = 'clip',
        half_range: float | None = None,
        start_phase: float | Sequence[Sequence[float]] | None = None,
        blend: float = 0.0,
    ) -> None:
        """Composes the task.

        Args:
          character: a spatial character without actuators; it is attached to the arena.
          arena: where it moves.
          clip: a looping clip for this character, with a free root.
          actuation_model: one of `trl_suite.actuation.ACTUATIONS`.
          terrain_map: observe the heights around.
          target: observe the reference's state instead of the phase.
          mirrored: observe and act as if the right foot always stood first.
          substeps: physics steps per control step of 1/30 s.
          centre: for position control, the pose at action 0: the mean pose of the 'clip', left and
            right made alike, the character's working 'posture', or the 'original' map: an angle and
            an axis for every ball joint, in the original's range.
          half_range: for position control, rad per unit action (1 about the clip, 1.5 about the
            posture).
          start_phase: phase of every start, in [0, 1), or pairs between whose numbers it is drawn;
            drawn uniformly if None.
          blend: which mixture of the terrain's parameter sets to draw from.

        Raises:
          ValueError: options out of range, or a clip that does not fit the character.
        """
        if clip.root != 'free' or not clip.loop:
            raise ValueError(
                f'clip {clip.name!r} (root {clip.root}, {"looping" if clip.loop else "not looping"})'
                ' does not serve a spatial imitation task: it needs a free root and a cycle'
            )
        self.clip, self.period, self._target = clip, clip.duration, target
        links = len(character.row.links)
        extras = {'target': 1 + 6 * links if target else 0, **self._goal_blocks()}
        super().__init__(
            character, arena, clip, actuation_model=actuation_model, substeps=substeps,
            centre=centre, half_range=half_range, start_phase=start_phase, terrain_map=terrain_map,
            mirrored=mirrored, blend=blend, phase=not target, extras=extras,
        )  # fmt: skip

    def _goal_blocks(self) -> dict[str, int]:
        """Blocks, with their sizes, that say where to go."""
        return {'goal': 2}

    def _typical_poses(self) -> np.ndarray:
        return self.clip.pose(np.linspace(0, self.period, CYCLE_SAMPLES, endpoint=False))

    def bind(self, world: World) -> None:
        super().bind(world)
        kinematics = self.figure.kinematics
        self.reference = SpatialReference.of_clip(self.clip, kinematics, world.models[0])
        effectors = len(kinematics.effectors)
        columns = np.zeros((len(self._weights), 1))
        columns[self._effector_columns] = 1 / effectors
        pose, velocity, com, root = self._weights.T[..., None]
        # In the order of the terms.
        self._contributions = np.concatenate([pose, velocity, columns, com, root], axis=1)
        own = self.reference.columns
        self._target_columns = np.r_[own['height'], own['positions'], own['velocities']]

    def _start(
        self, rows: np.ndarray, random_states: Sequence[np.random.RandomState]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        for row, random_state in zip(rows.tolist(), random_states, strict=True):
            # Drawn even where it is not asked for, so that the terrain does not depend on it.
            drawn = random_state.random_sample()
            self._start_cycles[row] = self._start_phase(drawn)
            ground = Ground(self.arena.terrain, drawn_seed(random_state), blend=self._blend)
            self.arena.begin_episode(row, ground)
        times = self._start_cycles[rows] * self.period
        poses, rates = self.clip.state(times)
        poses[:, :2] = 0.0
        return poses, rates, np.zeros((len(rows), 3))

    def _compare(self, found: SimpleNamespace) -> None:
        self._reference_now = self.reference.features(self.phase)
        rewards.imitation(self._errors(found, self._reference_now), out=self.reward_terms)

    def _errors(self, found: SimpleNamespace, reference: np.ndarray) -> np.ndarray:
        """Returns the squared errors of the terms of imitation, (n, 5)."""
        error = self.figure.kinematics.compare(
            found.features, reference[:, : found.features.shape[1]]
        )
        error *= error
        # Row by row, so that a row's sums do not depend on how many rows there are.
        return np.matmul(error[:, None], self._contributions)[:, 0]

    def _write_extras(self, found: SimpleNamespace) -> None:
        if self._target:
            target = self._observation[:, self._full['target']]
            self._reference_now.take(self._target_columns, 1, target, 'clip')
        self._write_goal(found)

    def _write_goal(self, found: SimpleNamespace) -> None:
        goal = self._observation[:, self._full['goal']]
        way = np.full((len(goal), 1, 2), GOAL_AHEAD)
        way[:, 0, 1] = self._origin[:, 1] - found.root[:, 1]
        goal[...] = polar(way, found)

    def _extra_mirror(self, name: str) -> Reflection:
        assert name == 'goal', name  # mirrored observations have no target
        return np.arange(2), np.array([-1.0, 1.0])

    def _distance(self, way: np.ndarray) -> np.ndarray:
        return way[:, 0].copy()

    def clip_action(self, row: int) -> np.ndarray:
        """Action that drives joints along the clip, without feedback on balance.

        Raises:
          ValueError: torque control has no such action.
        """
        if self.actuation_model not in ('position', 'velocity'):
            raise ValueError(
                f'{self.actuation_model} control cannot follow a clip open loop; position and '
                'velocity control can'
            )
        phase = self.phase[row : row + 1]
        time = phase * self.period
        if self.actuation_model == 'velocity':
            control = self.clip.velocity(time)[0, 6:]
        else:
            control = joint_targets(self.clip, self.clip.pose(time)[0])
        action = self.action_map.action(control)
        if self.mirrored and phase[0] >= 0.5:
            assert self._reflection is not None
            action = self._reflection.action(action[None])[0]
        return action

    def reference_pose(self, row: int) -> np.ndarray:
        """Pose of the reference beside the simulated character: root, then joints."""
        cycles = np.array([self._start_cycles[row], self.cycles[row]])
        first, pose = self.clip.pose(cycles * self.period)
        pose[:2] += self._origin[row, :2] - first[:2]
        rows = np.array([row])
        pose[2] += self.arena.height(pose[None, :1], pose[None, 1:2], rows)[0, 0]
        return pose


def joint_targets(clip: Clip, pose: np.ndarray) -> np.ndarray:
    """Returns targets of position control that hold a pose (columns,): rotation vectors, angles."""
    parts, column = [], 7
    for size in clip.sizes:
        value = pose[column : column + size]
        parts.append(quaternion.rotation_vector(value) if size == 4 else value)
        column += size
    return np.concatenate(parts)
