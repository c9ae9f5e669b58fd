"""What the tasks of a tracked motion in three dimensions share: body, reference, comparison."""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

from trl_suite import actuation, errors
from trl_suite.arenas import SpatialTerrain
from trl_suite.characters import Character
from trl_suite.engine import World
from trl_suite.motion import Clip, Steps
from trl_suite.symmetry import Mirror
from trl_suite.tasks import reflection3d, rewards
from trl_suite.tasks.batch_task import BatchTask
from trl_suite.tasks.figure3d import SpatialFigure
from trl_suite.tasks.reference3d import SpatialReference, mean_targets
from trl_suite.tasks.task import (
    MAX_JOINT_SPEED,
    consecutive,
    drawn_seed,
    start_phases,
)
from trl_suite.terrain import Ground

CONTROL_TIMESTEP = 1 / 30  # s
SUBSTEPS = 10  # physics at 300 Hz: trained walks score the same there and at 600 Hz, less below 180
HALF_RANGE = 1.0  # rad per unit action about the mean pose of the motion
PHASE_BINS = 4
MIRRORED_BINS = 2  # of the phase of a single step
CENTRES = ('clip', 'posture', 'original')  # of position control
_DIGITS = 9  # of the clock, in cycles


class Tracking(BatchTask):
    """A spatial character is compared with a reference motion, over a clock that never stops.

    A subclass says what the reference is, how an episode starts, and what else is observed and
    rewarded. It adds its blocks behind terrain, pose, velocity and phase.
    """

    TERMS: Mapping[str, tuple[float, float]]  # reward terms: weight, and scale of the error
    ABOUT: str  # from where end effectors are measured, 'com' or 'root'
    fields: tuple[str, ...] = SpatialFigure.fields
    reference: SpatialReference
    period: float  # s, of the cycle

    def __init__(
        self,
        character: Character,
        arena: SpatialTerrain,
        motion: Clip | Steps,
        *,
        actuation_model: str,
        substeps: int,
        centre: str,
        half_range: float | None,
        start_phase: float | Sequence[Sequence[float]] | None,
        terrain_map: bool,
        mirrored: bool,
        blend: float,
        phase: bool,
        extras: dict[str, int],
    ) -> None:
        """Composes the task; see the subclasses.

        Raises:
          ValueError: options out of range, or a motion that does not fit the character.
        """
        row = character.row
        if not row.spatial or tuple(motion.joints) != tuple(row.joints):
            raise ValueError(
                f'motion {motion.name!r} (joints {", ".join(motion.joints)}) does not fit character '
                f'{row.name!r}: expected a spatial character with these joints, not '
                f'{"one" if row.spatial else "a planar one"} with {", ".join(row.joints)}'
            )
        if centre not in CENTRES:
            raise ValueError(errors.unknown('centre of position control', centre, CENTRES))
        if actuation_model != 'position' and (centre != 'clip' or half_range is not None):
            raise ValueError(
                f'centre and half_range shape position control, not {actuation_model} control'
            )
        if centre == 'original' and half_range is not None:
            raise ValueError("centre 'original' has ranges of its own: give no half_range")
        if half_range is not None and not 0 < half_range < np.inf:
            raise ValueError(f'half_range is {half_range}; expected a positive number of radians')
        if int(substeps) != substeps or substeps < 6:
            raise ValueError(
                f'substeps is {substeps}; expected an integer of at least 6 (physics at 180 Hz)'
            )
        if mirrored and not row.mirror:
            raise ValueError(
                f'character {row.name!r} has no pairs of right and left links; mirrored observations '
                'need them'
            )
        if mirrored and not phase:
            raise ValueError('mirrored observations need the phase, which tells left from right')
        self.character, self.arena, self.motion = character, arena, motion
        self.actuation_model, self.terrain_map = actuation_model, terrain_map
        self._start_phase, self._blend = start_phases(start_phase), blend
        self.figure = SpatialFigure(character, arena, terrain_map)
        self.set_timesteps(CONTROL_TIMESTEP, CONTROL_TIMESTEP / substeps)
        self.action_map = actuation.add(
            character, actuation_model, self.physics_timestep,
            **(self._range(centre, half_range) if actuation_model == 'position' else {}),
        )  # fmt: skip
        self._drive = self.action_map  # from actions to the actuators
        full = {**self.figure.blocks, 'phase': 1 + PHASE_BINS if phase else 0, **extras}
        self._full = consecutive(full)
        self._reflection = self._mirror() if phase and row.mirror else None
        self.mirrored = mirrored
        # How a policy may reflect what it observes; what is mirrored already has nothing to reflect.
        self.mirror = None if mirrored else self._reflection
        self.blocks = self._full
        if mirrored:
            self._kept = self._canonical_columns()
            self.blocks = consecutive({
                **self.figure.blocks, 'phase': 1 + MIRRORED_BINS, **self._canonical_extras(extras)
            })  # fmt: skip

    def _range(self, centre: str, half_range: float | None) -> dict[str, Any]:
        """Options of position control."""
        if centre == 'original':
            return {'rotations': 'angle_axis'}
        options: dict[str, Any] = {} if half_range is None else {'half_range': half_range}
        if centre == 'clip':
            options.setdefault('half_range', HALF_RANGE)
            options['centre'] = mean_targets(self._typical_poses(), self.motion)
        return options

    # What a subclass has.

    @abc.abstractmethod
    def _typical_poses(self) -> np.ndarray:
        """Returns poses whose mean is action 0 of position control, (k, columns of a pose)."""

    @abc.abstractmethod
    def _start(
        self, rows: np.ndarray, random_states: Sequence[np.random.RandomState]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Begins the grounds of some rows; returns poses, rates, spawns (see `figure.place`).

        Phases must be in `_start_cycles` afterwards.
        """

    @abc.abstractmethod
    def _extra_mirror(self, name: str) -> reflection3d.Reflection:
        """Returns how a block of the subclass is reflected."""

    def _canonical_extras(self, extras: dict[str, int]) -> dict[str, int]:
        """Returns blocks of the subclass, with their sizes, as mirrored observations have them."""
        return extras

    def _canonical_extra_columns(self, name: str) -> np.ndarray:
        """Returns which columns of a block of the subclass mirrored observations keep."""
        part = self._full[name]
        return np.arange(part.start, part.stop)

    @property
    def root_entity(self) -> SpatialTerrain:
        return self.arena

    @property
    def signature(self) -> str:
        parts = self.character.row.name, self.arena.terrain.name, self.motion.name
        return f'{super().signature} of {" / ".join(parts)}'

    def bind(self, world: World) -> None:
        self.world, n = world, world.n
        self.figure.bind(world, self.ABOUT)
        scope = f'{self.character.mjcf_model.model}/'
        names = [scope + name for name in self._drive.actuators]
        first = int(world.control_addresses(names[:1])[0])  # added one after the other
        self._ctrl = world.ctrl[:, first : first + self._controls]
        kinematics = self.figure.kinematics
        row, columns = self.character.row, kinematics.columns
        self._weights = self._error_weights(row.weights, columns)
        self.reward = np.zeros(n)
        self.reward_terms = np.zeros((n, len(self.TERMS)))
        self.failed, self.diverged = np.zeros(n, bool), np.zeros(n, bool)
        self._start_cycles = np.zeros(n)  # phase of the start
        self._random = [np.random.default_rng(0)] * n  # what is drawn within an episode
        self._count = np.zeros(n, int)  # control steps since
        self._origin = np.zeros((n, 3))  # x, y, heading of the start
        self._observation = np.zeros((n, max(part.stop for part in self._full.values())))
        self.observation = self._observation
        if self.mirrored:
            self.observation = np.zeros((n, max(part.stop for part in self.blocks.values())))

    @property
    def _controls(self) -> int:
        """Number of controls of the actuators."""
        return int(self.character.dofs.sum())

    def _error_weights(self, weights: np.ndarray, columns: dict[str, slice]) -> np.ndarray:
        """What each squared difference adds to the errors of pose, velocity, com and root height.

        Returns:
          Shape (compared columns, 4); see `Kinematics.compare`.
        """
        ball = self.character.spherical
        hinges = np.flatnonzero(~ball)
        balls = np.flatnonzero(ball)
        joints = weights[1:]
        rates = np.concatenate([np.full(3, weights[0]), np.repeat(joints, self.character.dofs)])
        effectors = columns['effectors'].stop - columns['effectors'].start
        parts = [
            (0, np.concatenate([weights[:1], joints[balls], joints[hinges]])), (1, rates),
            (0, np.zeros(effectors)), (2, np.full(3, rewards.COM_ERROR_FACTOR)), (3, np.ones(1)),
        ]  # fmt: skip
        result = np.zeros((sum(len(values) for _, values in parts), 4))
        start = 0
        for term, values in parts:
            result[start : start + len(values), term] = values
            start += len(values)
        rotations = 1 + len(balls)
        offset = columns['rotations'].stop - rotations
        self._effector_columns = slice(
            columns['effectors'].start - offset, columns['effectors'].stop - offset
        )
        return result

    def _begin_grounds(
        self, rows: np.ndarray, random_states: Sequence[np.random.RandomState]
    ) -> np.ndarray:
        """Draws phases, grounds, generators and starts of some rows; returns spawns, (m, 3)."""
        spawns = np.zeros((len(rows), 3))
        for i, (row, random_state) in enumerate(zip(rows.tolist(), random_states, strict=True)):
            drawn = random_state.random_sample()
            self._start_cycles[row] = self._start_phase(drawn)
            ground = Ground(self.arena.terrain, drawn_seed(random_state), blend=self._blend)
            self._random[row] = np.random.default_rng(drawn_seed(random_state))
            spawns[i] = ground.spawn(self._random[row])
            self.arena.begin_episode(row, ground, spawns[i, :2])
        return spawns

    def begin_episodes(
        self, rows: np.ndarray, random_states: Sequence[np.random.RandomState]
    ) -> None:
        self.world.reset(rows)
        self._count[rows] = 0
        poses, rates, spawns = self._start(rows, random_states)
        self._origin[rows] = spawns
        self.figure.place(rows, poses, rates, spawns)
        self.failed[rows] = self.diverged[rows] = False
        self.reward[rows] = 0.0
        self._begun_on_ground(rows)

    def _begun_on_ground(self, rows: np.ndarray) -> None:
        """What a subclass does once the characters of some rows stand."""

    def act(self, action: np.ndarray) -> None:
        if self.mirrored:
            action = np.asarray(action, dtype=float)
            assert self._reflection is not None
            action = self._reflection.answered(action, self._reflection.left(self._observation))
        self._ctrl[...] = self._drive.control(action)
        root = self.figure.kinematics.links[0]
        # Ground ahead is laid before the physics, so that its pictures are current after it.
        self.arena.follow(self.world.xpos[:, root, :2])

    def finish_step(self, stepped: np.ndarray | None = None) -> None:
        self._count += 1 if stepped is None else stepped
        rates = self.world.qvel.take(self.figure.kinematics.joint_dof, 1)
        if np.vdot(rates, rates) > MAX_JOINT_SPEED**2 or self.world.any_diverged():
            too_fast = np.abs(rates).max(1) > MAX_JOINT_SPEED
            np.logical_or(self.world.diverged(), too_fast, out=self.diverged)
        else:
            self.diverged[:] = False
        kept = self._observation[self.diverged]
        with np.errstate(invalid='ignore' if len(kept) else 'warn'):
            found = self.figure.measure()
            self._step(found)
            self._observe(found)
        self._observation[self.diverged] = kept  # the last finite one stands for what broke down
        self._publish()
        np.logical_or(found.fall.any(1), self.diverged, out=self.failed)
        self.failed |= self._gone()
        self.reward_terms[self.failed] = 0.0
        np.add.reduce(self.reward_terms, axis=1, out=self.reward)

    def _step(self, found: SimpleNamespace) -> None:
        """What changes between the physics and the observation."""

    def _gone(self) -> np.ndarray | bool:
        """Which rows fail by rules of the subclass."""
        return False

    def observe(self, env_ids: np.ndarray | None = None) -> None:
        self._observe(self.figure.measure())
        self._publish()

    def _observe(self, found: SimpleNamespace) -> None:
        """Writes the full observation and the reward terms."""
        self.figure.write(found, self._observation, self._full)
        if 'phase' in self._full:
            self._write_phase()
        self._compare(found)
        self._write_extras(found)

    def _write_phase(self) -> None:
        phase = self.phase
        part = self._observation[:, self._full['phase']]
        part[:, 0] = phase
        part[:, 1:] = np.floor(phase * PHASE_BINS)[:, None] == np.arange(PHASE_BINS)

    def _publish(self) -> None:
        """Writes the mirrored observation from the full one."""
        if not self.mirrored:
            return
        assert self._reflection is not None
        canonical, _ = self._reflection.canonical(self._observation)
        canonical.take(self._kept, 1, self.observation, 'clip')
        self.observation[:, self.blocks['phase'].start] *= 2  # of the single step

    @abc.abstractmethod
    def _compare(self, found: SimpleNamespace) -> None:
        """Writes the reward terms."""

    @abc.abstractmethod
    def _write_extras(self, found: SimpleNamespace) -> None:
        """Writes the blocks of the subclass into `_observation`."""

    @property
    def cycles(self) -> np.ndarray:
        """Time on the motion in periods: the phase, not wrapped, (n,)."""
        cycles = self._start_cycles + self._count * (CONTROL_TIMESTEP / self.period)
        return np.round(cycles, _DIGITS)  # half a cycle is half a cycle, however it was counted

    @property
    def phase(self) -> np.ndarray:
        """Phase of the cycle in [0, 1), (n,)."""
        cycles = self.cycles
        return cycles - np.floor(cycles)

    # Left and right.

    def _mirror(self) -> Mirror:
        """How full observations and actions are reflected."""
        parts = reflection3d.body(self.character)
        parts['phase'] = reflection3d.phase(PHASE_BINS)
        parts |= {name: self._extra_mirror(name) for name in self._full if name not in parts}
        return Mirror(
            *reflection3d.joined(self._full, parts),
            *reflection3d.actions(self.character, self.action_map),
            self._full['phase'].start,
        )

    def _canonical_columns(self) -> np.ndarray:
        """Which columns of a full observation in right stance a mirrored one has."""
        columns = []
        for name, part in self._full.items():
            if name == 'phase':
                columns.append(np.arange(part.start, part.start + 1 + MIRRORED_BINS))
            elif name in self.figure.blocks:
                columns.append(np.arange(part.start, part.stop))
            else:
                columns.append(self._canonical_extra_columns(name))
        return np.concatenate(columns)

    def infos(self) -> dict[str, Any]:
        """Reward terms, fall and divergence flags, and the distance from the start in m."""
        # An observation has terms, also that of a start; but a start has no reward, nor its parts.
        terms = self.reward_terms.T * (self.reward != 0)
        root = self.world.xpos[:, self.figure.kinematics.links[0], :2]
        return {
            'reward_terms': dict(zip(self.TERMS, terms, strict=True)),
            'fell': self.failed & ~self.diverged,
            'diverged': self.diverged.copy(),
            'distance': self._distance(root - self._origin[:, :2]),
        }

    def _distance(self, way: np.ndarray) -> np.ndarray:
        """Distance travelled, (n,) m, from the way from the start, (n, 2) m."""
        return np.sqrt(way[:, 0] ** 2 + way[:, 1] ** 2)

    _KEPT: tuple[str, ...] = ()  # arrays of n rows that a subclass has in its state

    def get_state(self, row: int) -> dict[str, Any]:
        return {
            'arena': self.arena.state(row),
            'start_cycles': float(self._start_cycles[row]),
            'count': int(self._count[row]),
            'origin': self._origin[row].copy(),
            'full': self._observation[row].copy(),
            'observation': self.observation[row].copy(),
            'reward': float(self.reward[row]),
            'reward_terms': self.reward_terms[row].copy(),
            'failed': bool(self.failed[row]),
            'diverged': bool(self.diverged[row]),
            'random': self._random[row].bit_generator.state,
            **{name: getattr(self, name)[row].copy() for name in self._KEPT},
        }

    def set_state(self, row: int, state: dict[str, Any]) -> None:
        self.arena.restore(row, state['arena'])
        self._start_cycles[row], self._count[row] = state['start_cycles'], state['count']
        self._origin[row] = state['origin']
        self._observation[row] = state['full']
        self.observation[row] = state['observation']
        self.reward[row] = state['reward']
        self.reward_terms[row] = state['reward_terms']
        self.failed[row], self.diverged[row] = state['failed'], state['diverged']
        random = np.random.default_rng(0)
        random.bit_generator.state = state['random']
        self._random[row] = random
        for name in self._KEPT:
            getattr(self, name)[row] = state[name]
