"""Tracking a motion clip over planar terrain: the Imitation and PLAiD families.

Source: the imitation scenario of the original; 'Does the choice of action space matter?' (Peng &
van de Panne 2017) and 'Progressive reinforcement learning with distillation for multi-skilled
motion control' (Berseth et al. 2018).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType, SimpleNamespace
from typing import Any

import numpy as np

from trl_suite import actuation, errors, hill
from trl_suite.arenas import PlanarTerrain
from trl_suite.characters import Character
from trl_suite.characters.muscles import PLAIN, Muscle
from trl_suite.engine import World
from trl_suite.motion import Clip
from trl_suite.tasks import rewards
from trl_suite.tasks.batch_task import BatchTask
from trl_suite.tasks.figure import PlanarFigure
from trl_suite.tasks.reference import Reference
from trl_suite.tasks.task import (
    MAX_JOINT_SPEED,
    consecutive,
    drawn_seed,
    start_phases,
)
from trl_suite.terrain import Strip

CONTROL_TIMESTEP = 1 / 30  # s
SUBSTEPS = 10  # physics at 300 Hz; trained policies score the same from 240 to 1200 Hz
VIEW_BEHIND = 0.5  # m; where the line of terrain samples begins
VIEW_AHEAD = 3.0  # m; where it ends
PHASE_BINS = 4
CENTRES = ('clip', 'posture', 'original')  # of position control


class Imitation(BatchTask):
    """A planar character tracks a looping clip over random terrain.

    Observation blocks, in this order (N links, J joints; heading frame: x is mirrored while the
    trunk points backwards, heights are relative to the ground under the root):
      terrain: heights of the ground along the line of samples, m.
      pose: height of the root, then (x, z) of every link centre relative to the root, m; 2N + 1.
      velocity: (x, z) velocity of every link centre, m/s; 2N.
      strain: fibre strain of every muscle, if the character is driven by muscles.
      phase: phase in [0, 1), then the one-hot of its quarter; 5. Or instead
      target: height of the reference's root, then its link positions relative to its root and its
        link velocities; 4N + 1.
    """

    TERMS: Mapping[str, tuple[float, float]] = rewards.IMITATION_TERMS  # weight, scale of the error
    ABOUT = 'com'  # from where end effectors are measured, or 'root'
    EXTRAS: Mapping[str, int] = MappingProxyType({})  # blocks of a subclass, with their sizes

    def __init__(
        self,
        character: Character,
        arena: PlanarTerrain,
        clip: Clip,
        *,
        actuation_model: str = 'position',
        terrain_samples: int = 0,
        target: bool = False,
        substeps: int = SUBSTEPS,
        centre: str = 'clip',
        half_range: float | None = None,
        muscle_set: str = PLAIN,
        start_phase: float | Sequence[Sequence[float]] | None = None,
        spawn: str = 'intended',
        blend: float = 0.0,
    ) -> None:
        """Composes the task.

        Args:
          character: a planar character without actuators; it is attached to the arena.
          arena: where it moves.
          clip: a looping planar clip for this character.
          actuation_model: one of `trl_suite.actuation.ACTUATIONS`.
          terrain_samples: heights observed on the line from 0.5 m behind to 3 m ahead; 0 is blind.
          target: observe the reference's state instead of the phase.
          substeps: physics steps per control step of 1/30 s.
          centre: for position control, the pose at action 0: the mean pose of the 'clip', the
            character's working 'posture', or the 'original' map, whose [-1, 1] spans four times the
            joint range about its middle.
          half_range: for position control, rad per unit action (default 1.5).
          muscle_set: for muscle control, 'plain' or the motion that the muscles were optimised for.
          start_phase: phase of every start, in [0, 1), or pairs between whose numbers it is drawn;
            drawn uniformly if None.
          spawn: where the flat start lies: 'intended' (1 m to both sides of the start) or
            'upstream' (where the original's construction puts it, depending on the start phase).
          blend: which mixture of the terrain's parameter sets to draw from.

        Raises:
          ValueError: options out of range, or a clip that does not fit the character.
        """
        self._check(character, clip, actuation_model, centre, half_range, substeps, terrain_samples)
        self.character, self.arena, self.clip = character, arena, clip
        self.actuation_model = actuation_model
        self._start_phase, self._spawn, self._blend = start_phases(start_phase), spawn, blend
        self.figure = PlanarFigure(
            character, arena, VIEW_BEHIND, VIEW_AHEAD, terrain_samples, 'contact' in self.EXTRAS
        )
        self.set_timesteps(CONTROL_TIMESTEP, CONTROL_TIMESTEP / substeps)

        options: dict[str, Any] = {}
        muscles: tuple[Muscle, ...] = ()
        if actuation_model == 'position':
            options = position_range(character, clip, centre, half_range)
        elif actuation_model == 'muscle':
            options = {'muscle_set': muscle_set}
            muscles = actuation.character_muscles(character, muscle_set)
        if muscle_set != PLAIN and not muscles:
            raise ValueError(f'muscle_set is for muscle control, not for {actuation_model} control')
        self.action_map = actuation.add(
            character, actuation_model, self.physics_timestep, **options
        )
        self.blocks = consecutive({
            **self.figure.blocks,
            'strain': len(muscles),
            'phase': 0 if target else 1 + PHASE_BINS,
            'target': 4 * len(character.row.links) + 1 if target else 0,
            **self.EXTRAS,
        })  # fmt: skip
        self._scale = np.array([hill.optimal_length(muscle) for muscle in muscles])
        self._rest = np.array([hill.rest_length(muscle) for muscle in muscles])

    @staticmethod
    def _check(
        character: Character, clip: Clip, model: str, centre: str, half_range: float | None,
        substeps: int, terrain_samples: int,
    ) -> None:  # fmt: skip
        if tuple(clip.joints) != tuple(character.row.joints) or clip.root != 'planar':
            raise ValueError(
                f'clip {clip.name!r} (root {clip.root}, joints {", ".join(clip.joints)}) does not '
                f'fit character {character.row.name!r}, whose root is planar and whose joints are '
                f'{", ".join(character.row.joints)}'
            )
        if not clip.loop:
            raise ValueError(f'clip {clip.name!r} does not loop; an imitation task needs a cycle')
        if centre not in CENTRES:
            raise ValueError(errors.unknown('centre of position control', centre, CENTRES))
        if model != 'position' and (centre != 'clip' or half_range is not None):
            raise ValueError(f'centre and half_range shape position control, not {model} control')
        if half_range is not None and not 0 < half_range < np.inf:
            raise ValueError(f'half_range is {half_range}; expected a positive number of radians')
        if int(terrain_samples) != terrain_samples or terrain_samples < 0 or terrain_samples == 1:
            raise ValueError(f'terrain_samples is {terrain_samples}; expected 0, or at least 2')
        if int(substeps) != substeps or substeps < 4:
            raise ValueError(
                f'substeps is {substeps}; expected an integer of at least 4 (physics at 120 Hz)'
            )

    @property
    def root_entity(self) -> PlanarTerrain:
        return self.arena

    @property
    def signature(self) -> str:
        parts = self.character.row.name, self.arena.terrain.name, self.clip.name
        return f'{super().signature} of {" / ".join(parts)}'

    def bind(self, world: World) -> None:
        self.world = world
        figure, row = self.figure, self.character.row
        figure.bind(world, self.ABOUT)
        scope = f'{self.character.mjcf_model.model}/'
        controls = world.control_addresses([scope + name for name in self.action_map.names])
        self._ctrl = world.ctrl[:, controls[0] : controls[-1] + 1]  # added one after the other
        self.reference = Reference(
            self.clip, world.models[0], figure.pose_qpos, figure.pose_dof, figure.links,
            figure.effectors, figure.geoms, PHASE_BINS, self.ABOUT,
        )  # fmt: skip
        columns = self.reference.columns
        # Pitch and joints.
        self._angles, self._rates = figure.pose_qpos[2:], figure.pose_dof[2:]
        self._phase_step = np.full(world.n, self.control_timestep / self.reference.period)
        self._target_columns = slice(columns['height'].start, columns['velocities'].stop)
        self._phase_columns = slice(columns['phase'].start, columns['quarter'].stop)
        # What each squared difference contributes to each error, (features compared, terms).
        effectors = len(figure.effectors)
        parts = {
            'angles': row.weights, 'rates': row.weights, 'effectors': np.full(2 * effectors, 1 / effectors),
            'com_velocity': np.full(2, rewards.COM_ERROR_FACTOR), 'height': np.ones(1),
        }  # fmt: skip
        self._compared = {name: columns[name] for name in parts}
        self._weights = np.zeros((columns['height'].stop, len(parts)))
        for term, (name, weight) in enumerate(parts.items()):
            self._weights[columns[name], term] = weight

        n = world.n
        self.observation = np.zeros((n, max(part.stop for part in self.blocks.values())))
        self.reward = np.zeros(n)
        self.reward_terms = np.zeros((n, len(self.TERMS)))
        self.failed, self.diverged = np.zeros(n, bool), np.zeros(n, bool)
        self.phase = np.zeros(n)  # of the clip, in [0, 1)
        self._start_cycles = np.zeros(n)  # phase of the start
        self._ones = np.ones(n)
        self._cycles = np.zeros(n)  # time on the clip in periods: the phase, not wrapped
        self._comparison = np.zeros((n, len(self._weights)))
        self._errors = np.zeros((n, 1, len(parts)))
        self._all = self._views()

    def _views(self) -> SimpleNamespace:
        """The parts of all arrays that an observation reads and writes."""
        part = {name: self._comparison[:, columns] for name, columns in self._compared.items()}
        view = self.figure.views(
            self.observation, self.blocks, part['effectors'], part['com_velocity']
        )
        block = {name: self.observation[:, columns] for name, columns in self.blocks.items()}
        view.angles_out, view.rates_out = part['angles'], part['rates']
        view.height_out = part['height']
        view.strain, view.target = block.get('strain'), block.get('target')
        view.phase_out = block.get('phase')
        return view

    def begin_episodes(
        self, rows: np.ndarray, random_states: Sequence[np.random.RandomState]
    ) -> None:
        terrain, centre = self.arena.terrain, 0.0
        phases = np.empty(len(rows))
        for i, (row, random_state) in enumerate(zip(rows.tolist(), random_states, strict=True)):
            # Drawn even where it is not asked for, so that the terrain does not depend on it.
            drawn = random_state.random_sample()
            phases[i] = self._start_phase(drawn)
            if self._spawn == 'upstream':
                # Where the original's segments meet: it builds them before it moves the root to 0.
                centre = self.clip.pose(phases[i : i + 1] * self.reference.period)[0, 0] - 0.5
            seed = drawn_seed(random_state)
            strip = Strip(terrain, seed, blend=self._blend, spawn=self._spawn, centre=centre)
            self.arena.begin_episode(row, strip)
        self.phase[rows] = self._cycles[rows] = self._start_cycles[rows] = phases
        self.figure.place(rows, *self.reference.state(phases))
        self.failed[rows] = self.diverged[rows] = False
        self.reward[rows] = 0.0

    def act(self, action: np.ndarray) -> None:
        self._ctrl[...] = self.action_map.control(action)
        # Ground ahead is laid before the physics, so that its pictures are current after it.
        self.arena.follow(self._all.x)

    def finish_step(self, stepped: np.ndarray | None = None) -> None:
        v = self._all
        # Not in place: for a single number numpy takes three times as long in place.
        step = self._phase_step if stepped is None else self._phase_step * stepped
        self._cycles = self._cycles + step
        np.remainder(self._cycles, self._ones, self.phase)
        # Sums of squares are the cheapest tests for what happens once in many steps.
        broken = False
        self.diverged.fill(False)
        if np.vdot(v.rates, v.rates) > MAX_JOINT_SPEED**2 or self.world.any_diverged():
            too_fast = np.abs(v.rates).max(1) > MAX_JOINT_SPEED
            np.logical_or(self.world.diverged(), too_fast, out=self.diverged)
            broken = bool(self.diverged.any())  # sums of many rows say little
        self._step()
        if broken:
            # The last finite observation stands for what broke down.
            kept = self.observation[self.diverged]
            self.observe()
            self.observation[self.diverged] = kept
        else:
            self.observe()
        if broken or np.vdot(v.fall, v.fall) > 0:
            np.logical_or(v.fall.any(1), self.diverged, out=self.failed)
            self.reward_terms[self.failed] = 0.0
        else:
            self.failed.fill(False)
        np.add.reduce(self.reward_terms, axis=1, out=self.reward)

    def _step(self) -> None:
        """What a subclass changes between the physics and the observation."""

    def observe(self, env_ids: np.ndarray | None = None) -> None:
        v = self._all
        self.figure.measure(v)
        # What the reward compares, side by side with the same features of the reference.
        reference = self.reference.features(self.phase)
        v.qpos.take(self._angles, 1, v.angles_out, 'clip')
        v.qvel.take(self._rates, 1, v.rates_out, 'clip')
        v.height_out[...] = v.height
        error = self._comparison - reference[:, : self._comparison.shape[1]]
        if v.facing is not None:
            error[:, 0] = rewards.wrap(error[:, 0])
        error *= error
        self._compare(error, reference)

        if v.strain is not None:
            np.subtract(self.world.ten_length, self._rest, out=v.strain)
            v.strain /= self._scale
        if v.target is not None:
            v.target[...] = reference[:, self._target_columns]
        else:
            v.phase_out[...] = reference[:, self._phase_columns]

    def _compare(self, error: np.ndarray, reference: np.ndarray) -> None:
        """Writes the reward terms of squared differences from the features of the reference."""
        # Row by row, so that a row's sums do not depend on how many rows there are.
        np.matmul(error[:, None], self._weights, out=self._errors)
        rewards.imitation(self._errors[:, 0], out=self.reward_terms)

    def infos(self) -> dict[str, Any]:
        """Reward terms, fall and divergence flags, and the distance travelled in m."""
        # An observation has terms, also that of a start; but a start has no reward, nor its parts.
        terms = self.reward_terms.T * (self.reward != 0)
        return {
            'reward_terms': dict(zip(self.TERMS, terms, strict=True)),
            'fell': self.failed > self.diverged,
            'diverged': self.diverged.copy(),
            'distance': self._all.x[:, 0].copy(),
        }

    def clip_action(self, row: int) -> np.ndarray:
        """Action that drives joints along the clip, without feedback on balance.

        Raises:
          ValueError: torque and muscle control have no such action.
        """
        if self.actuation_model not in ('position', 'velocity'):
            raise ValueError(
                f'{self.actuation_model} control cannot follow a clip open loop; position and '
                'velocity control can'
            )
        time = self.phase[row : row + 1] * self.reference.period
        sample = self.clip.pose if self.actuation_model == 'position' else self.clip.velocity
        return self.action_map.action(sample(time)[0, 3:])

    def reference_pose(self, row: int) -> np.ndarray:
        """Pose of the reference beside the simulated character: x, z, pitch, joints."""
        cycles = np.array([self._start_cycles[row], self._cycles[row]])
        first, pose = self.clip.pose(cycles * self.reference.period)
        pose[0] -= first[0]
        pose[1] += self.figure.ground(row, pose[:1])[0]
        return pose

    def get_state(self, row: int) -> dict[str, Any]:
        return {
            'arena': self.arena.state(row),
            'phase': float(self.phase[row]),
            'start_cycles': float(self._start_cycles[row]),
            'cycles': float(self._cycles[row]),
            'observation': self.observation[row].copy(),
            'reward': float(self.reward[row]),
            'reward_terms': self.reward_terms[row].copy(),
            'failed': bool(self.failed[row]),
            'diverged': bool(self.diverged[row]),
        }

    def set_state(self, row: int, state: dict[str, Any]) -> None:
        self.arena.restore(row, state['arena'])
        self.phase[row], self._cycles[row] = state['phase'], state['cycles']
        self._start_cycles[row] = state['start_cycles']
        self.observation[row] = state['observation']
        self.reward[row] = state['reward']
        self.reward_terms[row] = state['reward_terms']
        self.failed[row], self.diverged[row] = state['failed'], state['diverged']


def position_range(
    character: Character, clip: Clip, centre: str, half_range: float | None
) -> dict[str, Any]:
    """Centre and half range of position control, rad (see `Imitation`)."""
    if centre == 'original':
        ranges = np.array([
            joint.original_range or limits
            for joint, limits in zip(
                character.row.joints.values(), character.joint_ranges.tolist(), strict=True
            )
        ])  # fmt: skip
        free = ~np.isfinite(ranges).all(1)
        ranges = np.where(free[:, None], (-np.pi, np.pi), ranges)
        scale = 2 * (ranges[:, 1] - ranges[:, 0]) if half_range is None else half_range
        return {'centre': ranges.mean(1), 'half_range': scale}
    options: dict[str, Any] = {} if half_range is None else {'half_range': half_range}
    if centre == 'clip':
        times = np.linspace(0, clip.duration, 256, endpoint=False)
        options['centre'] = clip.pose(times)[:, 3:].mean(0)
    return options
