"""Tracking a motion clip over planar terrain: the Imitation and PLAiD families.

Source: the imitation scenario of the original; 'Does the choice of action space matter?' (Peng &
van de Panne 2017) and 'Progressive reinforcement learning with distillation for multi-skilled
motion control' (Berseth et al. 2018).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from trl_suite import actuation, errors, hill
from trl_suite.arenas import PlanarTerrain
from trl_suite.characters import Character
from trl_suite.motion import Clip
from trl_suite.tasks import rewards
from trl_suite.tasks.reference import Reference, link_velocities
from trl_suite.tasks.task import MAX_JOINT_SPEED, Task, consecutive
from trl_suite.terrain import Strip
from trl_suite.world import World

CONTROL_TIMESTEP = 1 / 30  # s
SUBSTEPS = 10  # physics at 300 Hz; trained policies score the same from 240 to 1200 Hz
VIEW_BEHIND = 0.5  # m; where the line of terrain samples begins
VIEW_AHEAD = 3.0  # m; where it ends
CLEARANCE = 0.001  # m; left under every link at the start
PHASE_BINS = 4
_BINS = np.arange(PHASE_BINS)
CENTRES = ('clip', 'posture', 'original')  # of position control


class Imitation(Task):
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
        start_phase: float | None = None,
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
          start_phase: phase of every start, in [0, 1); drawn uniformly if None.
          spawn: where the flat start lies: 'intended' (1 m to both sides of the start) or
            'upstream' (where the original's construction puts it, depending on the start phase).
          blend: which mixture of the terrain's parameter sets to draw from.

        Raises:
          ValueError: options out of range, or a clip that does not fit the character.
        """
        self._check(
            character, clip, actuation_model, centre, half_range, start_phase, substeps,
            terrain_samples,
        )  # fmt: skip
        self.character, self.arena, self.clip = character, arena, clip
        self.actuation_model = actuation_model
        self._start_phase, self._spawn, self._blend = start_phase, spawn, blend
        character.create_root_joints(arena.attach(character))
        self.set_timesteps(CONTROL_TIMESTEP, CONTROL_TIMESTEP / substeps)

        options: dict[str, Any] = {}
        if actuation_model == 'position':
            options = position_range(character, clip, centre, half_range)
        self.action_map = actuation.add(
            character, actuation_model, self.physics_timestep, **options
        )
        # Terrain contact of each fall link; a body's sensor counts the contacts.
        self._fall_sensors = []
        for link in character.row.fall_links:
            body = character.mjcf_model.find('body', link)
            name = f'fall_{body.full_identifier.replace("/", "_")}'
            arena.mjcf_model.sensor.add(
                'contact', name=name, body1=body, body2=arena.ground_body, num=1, data='found'
            )
            self._fall_sensors.append(name)

        links = len(character.row.links)
        muscles = (
            actuation.character_muscles(character) if actuation_model == 'muscle' else ()
        )
        self.blocks = consecutive({
            'terrain': terrain_samples,
            'pose': 2 * links + 1,
            'velocity': 2 * links,
            'strain': len(muscles),
            'phase': 0 if target else 1 + PHASE_BINS,
            'target': 4 * links + 1 if target else 0,
        })
        self._samples = np.linspace(-VIEW_BEHIND, VIEW_AHEAD, terrain_samples)
        self._scale = np.array([hill.optimal_length(muscle) for muscle in muscles])
        self._rest = np.array([hill.rest_length(muscle) for muscle in muscles])

    @staticmethod
    def _check(
        character: Character, clip: Clip, model: str, centre: str, half_range: float | None,
        start_phase: float | None, substeps: int, terrain_samples: int,
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
        if start_phase is not None and not 0 <= start_phase < 1:
            raise ValueError(f'start_phase is {start_phase}; expected a number in [0, 1)')
        if int(terrain_samples) != terrain_samples or terrain_samples < 0 or terrain_samples == 1:
            raise ValueError(f'terrain_samples is {terrain_samples}; expected 0, or at least 2')
        if int(substeps) != substeps or substeps < 4:
            raise ValueError(
                f'substeps is {substeps}; expected an integer of at least 4 (physics at 120 Hz)'
            )

    @property
    def root_entity(self) -> PlanarTerrain:
        return self.arena

    def bind(self, world: World) -> None:
        self.world = world
        self.arena.bind(world)
        row, model = self.character.row, self.character.mjcf_model
        scope = f'{model.model}/'
        self._root_qpos, self._root_dof = world.joint_addresses(
            [f'{scope}{joint}/' for joint in ('root_x', 'root_z', 'root_pitch')]
        )
        self._joint_qpos, self._joint_dof = world.joint_addresses(
            [joint.full_identifier for joint in self.character.joints]
        )
        self._links = world.body_ids([body.full_identifier for body in self.character.bodies])
        self._effectors = world.body_ids(
            [body.full_identifier for body in self.character.end_effectors]
        )
        self._geoms = world.geom_ids(
            [geom.full_identifier for geom in self.character.collision_geoms]
        )
        self._controls = world.control_addresses([scope + name for name in self.action_map.names])
        self._fall = world.sensor_addresses(self._fall_sensors)
        # Links' mass share; the reward's weights of root and joints.
        mass = world.models[0].body_mass[self._links]
        self._share = mass / mass.sum()
        self._root_weight = row.weights[0]
        self._joint_weights_twice = np.tile(row.weights[1:], 2)  # of angles, then of rates
        self.reference = Reference(
            self.clip, world.models[0], self._root_qpos, self._root_dof, self._joint_qpos,
            self._joint_dof, self._links, self._effectors,
        )  # fmt: skip

        columns = self.reference.columns
        self._target_columns = slice(columns['height'].start, columns['velocities'].stop)

        n = world.n
        self.observation = np.zeros((n, max(part.stop for part in self.blocks.values())))
        self.reward = np.zeros(n)
        self.reward_terms = np.zeros((n, len(rewards.IMITATION_TERMS)))
        self.failed, self.diverged = np.zeros(n, bool), np.zeros(n, bool)
        self._start_time = np.zeros(n)  # s; time of the clip at the start of the episode
        self._steps = np.zeros(n, np.int64)
        # One ground query serves samples, root and end effectors.
        self._ground_x = np.zeros((n, len(self._samples) + 1 + len(self._effectors)))

    @property
    def clip_time(self) -> np.ndarray:
        """Time on the clip that every simulation is at, s, shape (n,)."""
        return self._start_time + self._steps * self.control_timestep

    @property
    def phase(self) -> np.ndarray:
        """Phase of the clip in [0, 1), shape (n,)."""
        cycles = self.clip_time / self.reference.period
        return np.minimum(cycles - np.floor(cycles), np.nextafter(1, 0))

    def begin_episode(self, row: int, seed: np.random.SeedSequence) -> None:
        terrain_seed, start_seed = seed.spawn(2)
        phase = self._start_phase
        if phase is None:
            phase = np.random.default_rng(start_seed).uniform()
        time = np.array([phase * self.reference.period])
        pose, rate = self.clip.pose(time)[0], self.clip.velocity(time)[0]
        upstream = {'centre': pose[0] - 0.5} if self._spawn == 'upstream' else {}
        strip = Strip(
            self.arena.terrain, terrain_seed, blend=self._blend, spawn=self._spawn, **upstream
        )
        self.arena.begin_episode(row, strip)

        world = self.world
        world.reset(row)
        self._start_time[row], self._steps[row] = time[0], 0
        pose[0] = 0.0
        rows = slice(row, row + 1)
        pose[1] += self.arena.height(np.zeros((1, 1)), rows)[0, 0]
        world.qpos[row, self._root_qpos], world.qpos[row, self._joint_qpos] = pose[:3], pose[3:]
        world.qvel[row, self._root_dof], world.qvel[row, self._joint_dof] = rate[:3], rate[3:]
        world.forward(row)
        lift = self._penetration(row) + CLEARANCE
        if lift > 0:
            world.qpos[row, self._root_qpos[1]] += lift
            world.forward(row)
        self.failed[row] = self.diverged[row] = False
        self.reward[row] = 0.0
        self._observe(rows)

    def _penetration(self, row: int) -> float:
        """How deep the lowest of the links' bounding boxes reaches below the ground, m."""
        centre = self.world.geom_xpos[row, self._geoms]
        matrix = self.world.geom_xmat[row, self._geoms].reshape(-1, 3, 3)
        extent = (np.abs(matrix) * self.world.models[row].geom_size[self._geoms, None]).sum(2)
        x = centre[:, 0] + extent[:, 0] * np.array([[-1], [0], [1]])
        ground = self.arena.height(x.reshape(1, -1), slice(row, row + 1))
        return float(np.max(ground.reshape(3, -1) - (centre[:, 2] - extent[:, 2])))

    def act(self, action: np.ndarray) -> None:
        self.world.ctrl[:, self._controls] = self.action_map.control(action)
        # Ground ahead is laid before the physics, so that its pictures are current after it.
        self.arena.follow(self.world.qpos[:, self._root_qpos[0]])

    def finish_step(self) -> None:
        world = self.world
        self._steps += 1
        self.diverged[:] = world.diverged() | (
            np.abs(world.qvel[:, self._joint_dof]).max(1) > MAX_JOINT_SPEED
        )
        fallen = (world.sensordata[:, self._fall] > 0).any(1)
        np.logical_or(fallen, self.diverged, out=self.failed)
        kept = self.observation[self.diverged]
        self._observe(slice(None))
        if len(kept):  # the last finite observation stands for what broke down
            self.observation[self.diverged] = kept
        self.reward_terms[self.failed] = 0.0
        np.sum(self.reward_terms, axis=1, out=self.reward)

    def _observe(self, rows: slice) -> None:
        """Writes observation and reward terms of some rows from the world's state."""
        world, column = self.world, self.reference.columns
        qpos, qvel = world.qpos[rows], world.qvel[rows]
        x, z, pitch = (qpos[:, address] for address in self._root_qpos)
        facing = np.where(np.cos(pitch) >= 0, 1.0, -1.0)
        xipos = world.xipos[rows][:, self._links]
        centre = world.subtree_com[rows, self._links[0]]
        effector = world.xpos[rows][:, self._effectors]
        velocity = link_velocities(xipos, world.cvel[rows][:, self._links], centre)

        samples = len(self._samples)
        ground_x = self._ground_x[rows]
        ground_x[:, :samples] = x[:, None] + facing[:, None] * self._samples
        ground_x[:, samples] = x
        ground_x[:, samples + 1 :] = effector[:, :, 0]
        ground = self.arena.height(ground_x, rows)
        under_root = ground[:, samples]
        height = z - under_root

        phase = self.phase[rows]
        reference = self.reference.features(phase)
        # Joints and pitch side by side, as the reference has them.
        moving = np.concatenate([qpos[:, self._joint_qpos], qvel[:, self._joint_dof]], axis=1)
        moving -= reference[:, : moving.shape[1]]
        joints = moving.shape[1] // 2
        moving *= moving
        moving *= self._joint_weights_twice
        pitch_error = rewards.wrap(pitch - reference[:, column['pitch'].start])
        pitch_rate_error = qvel[:, self._root_dof[2]] - reference[:, column['pitch_rate'].start]
        effector[:, :, 0] -= centre[:, :1] + reference[:, column['effector_x']]
        effector[:, :, 2] -= ground[:, samples + 1 :] + reference[:, column['effector_z']]
        com_error = (velocity * self._share[:, None]).sum(1) - reference[:, column['com_velocity']]
        errors_ = np.empty((len(x), len(rewards.IMITATION_TERMS)))
        errors_[:, 0] = self._root_weight * pitch_error**2 + moving[:, :joints].sum(1)
        errors_[:, 1] = self._root_weight * pitch_rate_error**2 + moving[:, joints:].sum(1)
        errors_[:, 2] = (effector[:, :, ::2] ** 2).sum((1, 2)) / len(self._effectors)
        errors_[:, 3] = (height - reference[:, column['height'].start]) ** 2
        errors_[:, 4] = rewards.COM_ERROR_FACTOR * (com_error**2).sum(1)
        self.reward_terms[rows] = rewards.imitation(errors_)

        out, blocks = self.observation[rows], self.blocks
        if samples:
            out[:, blocks['terrain']] = ground[:, :samples] - under_root[:, None]
        pose = out[:, blocks['pose']]
        pose[:, 0] = height
        pose[:, 1::2] = (xipos[:, :, 0] - x[:, None]) * facing[:, None]
        pose[:, 2::2] = xipos[:, :, 2] - z[:, None]
        speed = out[:, blocks['velocity']]
        speed[:, 0::2] = velocity[:, :, 0] * facing[:, None]
        speed[:, 1::2] = velocity[:, :, 1]
        if 'strain' in blocks:
            out[:, blocks['strain']] = (world.ten_length[rows] - self._rest) / self._scale
        if 'target' in blocks:
            out[:, blocks['target']] = reference[:, self._target_columns]
        else:
            bins = out[:, blocks['phase']]
            bins[:, 0] = phase
            bins[:, 1:] = (phase * PHASE_BINS).astype(np.int64)[:, None] == _BINS

    def info(self, row: int) -> dict[str, Any]:
        """Reward terms, fall and divergence flags, and the distance travelled in m."""
        terms = zip(rewards.IMITATION_TERMS, self.reward_terms[row], strict=True)
        return {
            'reward_terms': {name: float(value) for name, value in terms},
            'fell': bool(self.failed[row] and not self.diverged[row]),
            'diverged': bool(self.diverged[row]),
            'distance': float(self.world.qpos[row, self._root_qpos[0]]),
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
        name = 'angles' if self.actuation_model == 'position' else 'rates'
        features = self.reference.features(self.phase)[row]
        return self.action_map.action(features[self.reference.columns[name]])

    def reference_pose(self, row: int) -> np.ndarray:
        """Pose of the reference beside the simulated character: x, z, pitch, joints."""
        pose = self.clip.pose(self.clip_time[row : row + 1])[0]
        start = self.clip.pose(self._start_time[row : row + 1])[0]
        pose[0] -= start[0]
        pose[1] += self.arena.height(np.full((1, 1), pose[0]), slice(row, row + 1))[0, 0]
        return pose

    def get_state(self, row: int) -> dict[str, Any]:
        return {
            'arena': self.arena.state(row),
            'start_time': float(self._start_time[row]),
            'steps': int(self._steps[row]),
            'observation': self.observation[row].copy(),
            'reward': float(self.reward[row]),
            'reward_terms': self.reward_terms[row].copy(),
            'failed': bool(self.failed[row]),
            'diverged': bool(self.diverged[row]),
        }

    def set_state(self, row: int, state: dict[str, Any]) -> None:
        self.arena.restore(row, state['arena'])
        self._start_time[row], self._steps[row] = state['start_time'], state['steps']
        self.observation[row] = state['observation']
        self.reward[row] = state['reward']
        self.reward_terms[row] = state['reward_terms']
        self.failed[row], self.diverged[row] = state['failed'], state['diverged']


def position_range(
    character: Character, clip: Clip, centre: str, half_range: float | None
) -> dict[str, Any]:
    """Centre and half range of position control, rad (see `Imitation`)."""
    if centre == 'original':
        ranges = character.joint_ranges
        free = ~np.isfinite(ranges).all(1)
        ranges = np.where(free[:, None], (-np.pi, np.pi), ranges)
        scale = 2 * (ranges[:, 1] - ranges[:, 0]) if half_range is None else half_range
        return {'centre': ranges.mean(1), 'half_range': scale}
    options: dict[str, Any] = {} if half_range is None else {'half_range': half_range}
    if centre == 'clip':
        times = np.linspace(0, clip.duration, 256, endpoint=False)
        options['centre'] = clip.pose(times)[:, 3:].mean(0)
    return options
