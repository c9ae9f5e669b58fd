"""Tracking a motion clip over planar terrain: the Imitation and PLAiD families.

Source: the imitation scenario of the original; 'Does the choice of action space matter?' (Peng &
van de Panne 2017) and 'Progressive reinforcement learning with distillation for multi-skilled
motion control' (Berseth et al. 2018).
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from trl_suite import actuation, errors, hill
from trl_suite.arenas import PlanarTerrain
from trl_suite.characters import Character
from trl_suite.motion import Clip
from trl_suite.tasks import rewards
from trl_suite.tasks.reference import Reference
from trl_suite.tasks.task import MAX_JOINT_SPEED, Task, consecutive
from trl_suite.terrain import Strip
from trl_suite.world import World

CONTROL_TIMESTEP = 1 / 30  # s
SUBSTEPS = 10  # physics at 300 Hz; trained policies score the same from 240 to 1200 Hz
VIEW_BEHIND = 0.5  # m; where the line of terrain samples begins
VIEW_AHEAD = 3.0  # m; where it ends
CLEARANCE = 0.001  # m; left under every link at the start
PHASE_BINS = 4
_UPRIGHT = np.pi / 2  # rad
_ONE = np.ones(())
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
        # The last sample is the ground under the root, from which all heights are measured.
        self._samples = np.append(np.linspace(-VIEW_BEHIND, VIEW_AHEAD, terrain_samples), 0.0)
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
        row = self.character.row
        scope = f'{self.character.mjcf_model.model}/'
        root = world.joint_addresses([f'{scope}root_{axis}/' for axis in ('x', 'z', 'pitch')])
        joints = world.joint_addresses([j.full_identifier for j in self.character.joints])
        self._pose_qpos, self._pose_dof = (
            np.concatenate(addresses) for addresses in zip(root, joints, strict=True)
        )
        links = world.body_ids([body.full_identifier for body in self.character.bodies])
        effectors = world.body_ids([b.full_identifier for b in self.character.end_effectors])
        self._geoms = world.geom_ids([g.full_identifier for g in self.character.collision_geoms])
        controls = world.control_addresses([scope + name for name in self.action_map.names])
        self._controls = consecutive_or_array(controls)
        # Added one after the other: a slice of sensordata.
        falls = world.sensor_addresses(self._fall_sensors)
        self._fall = slice(int(falls[0]), int(falls[-1]) + 1)
        self.reference = Reference(
            self.clip, world.models[0], self._pose_qpos, self._pose_dof, links, effectors,
            PHASE_BINS,
        )  # fmt: skip
        columns = self.reference.columns
        self._phase_step = self.control_timestep / self.reference.period
        self._target_columns = slice(columns['height'].start, columns['velocities'].stop)
        self._phase_columns = slice(columns['quarter'].start - 1, columns['quarter'].stop)

        # Within the loop, bodies and joints stand in the engine's order, so that all of a
        # character is one slice of every array; only the observation is put into link order.
        self._bodies = bodies = slice(int(links.min()), int(links.max()) + 1)
        order = links - bodies.start
        self._link_order = None if (order == np.arange(len(links))).all() else order
        # Columns of end effectors in the flat xpos: all x, then all z, m.
        self._effector_xz = np.concatenate([3 * effectors, 3 * effectors + 2])
        mass = world.models[0].body_mass[bodies]
        self._share = (mass / mass.sum())[None]
        # What each squared difference contributes to each error, (features compared, terms).
        count = len(effectors)
        weights = row.weights[np.argsort(self._pose_qpos[2:])]
        parts = {
            'angles': weights, 'rates': weights, 'effectors': np.full(2 * count, 1 / count),
            'com_velocity': np.full(2, rewards.COM_ERROR_FACTOR), 'height': np.ones(1),
        }  # fmt: skip
        self._compared = {name: columns[name] for name in parts}
        self._weights = np.zeros((self._compared['height'].stop, len(parts)))
        for term, (name, weight) in enumerate(parts.items()):
            self._weights[columns[name], term] = weight

        n = world.n
        self.observation = np.zeros((n, max(part.stop for part in self.blocks.values())))
        self.reward = np.zeros(n)
        self.reward_terms = np.zeros((n, len(rewards.IMITATION_TERMS)))
        self.failed, self.diverged = np.zeros(n, bool), np.zeros(n, bool)
        self.phase = np.zeros(n)  # of the clip, in [0, 1)
        self._start_cycles = np.zeros(n)  # phase of the start
        self._cycles = np.zeros(n)  # time on the clip in periods: the phase, not wrapped
        self._speed = np.zeros(n)
        # One ground query serves samples, root and end effectors.
        self._ground_x = np.zeros((n, len(self._samples) + count))
        self._comparison = np.zeros((n, len(self._weights)))
        self._errors = np.zeros((n, 1, len(parts)))
        self._all = self._views(slice(None))

    def _views(self, rows: slice) -> SimpleNamespace:
        """The parts of all arrays that one observation of some rows reads and writes."""
        world, blocks, bodies = self.world, self.blocks, self._bodies
        angles, rates = (
            slice(int(address[2:].min()), int(address[2:].max()) + 1)
            for address in (self._pose_qpos, self._pose_dof)
        )
        x, z, pitch = self._pose_qpos[:3]
        out = self.observation[rows]
        pose = out[:, blocks['pose']]
        shape = (len(out), bodies.stop - bodies.start, 2)
        position, velocity = pose[:, 1:].reshape(shape), out[:, blocks['velocity']].reshape(shape)
        # Computed in the engine's order; out of place where the link order differs.
        position_out, velocity_out = position, velocity
        if self._link_order is not None:
            position, velocity = np.empty(shape), np.empty(shape)
        ground_x, compared = self._ground_x[rows], self._comparison[rows]
        part = {name: compared[:, columns] for name, columns in self._compared.items()}
        count = part['effectors'].shape[1] // 2
        return SimpleNamespace(
            rows=rows,
            root=world.qpos[rows, None, x : z + 1],
            x=world.qpos[rows, x, None],
            z=world.qpos[rows, z, None],
            pitch=world.qpos[rows, pitch],
            angles=world.qpos[rows, angles],
            rates=world.qvel[rows, rates],
            xpos=world.xpos[rows].reshape(len(out), -1),
            xipos=world.xipos[rows, bodies, ::2],
            spin=world.cvel[rows, bodies, 1:2],
            linear_x=world.cvel[rows, bodies, 3],
            linear_z=world.cvel[rows, bodies, 5],
            com=world.subtree_com[rows, bodies.start, None, ::2],
            com_x=world.subtree_com[rows, bodies.start, :1],
            fall=world.sensordata[rows, self._fall],
            phase=self.phase[rows],
            phase_column=self.phase[rows, None],
            position=position,
            velocity=velocity,
            velocity_x=velocity[:, :, 0],
            velocity_z=velocity[:, :, 1],
            position_out=position_out,
            velocity_out=velocity_out,
            ground_x=ground_x,
            sample_x=ground_x[:, : len(self._samples)],
            effector_ground_x=ground_x[:, len(self._samples) :],
            compared=compared,
            angles_out=part['angles'],
            rates_out=part['rates'],
            effectors=part['effectors'],
            effector_x=part['effectors'][:, :count],
            effector_z=part['effectors'][:, count:],
            com_velocity=part['com_velocity'][:, None],
            height_out=part['height'],
            errors=self._errors[rows],
            reward_terms=self.reward_terms[rows],
            height=pose[:, :1],
            terrain=out[:, blocks.get('terrain', slice(0, 0))],
            strain=out[:, blocks['strain']] if 'strain' in blocks else None,
            tendons=world.ten_length[rows],
            target=out[:, blocks['target']] if 'target' in blocks else None,
            phase_out=out[:, blocks['phase']] if 'phase' in blocks else None,
        )

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

        world, rows = self.world, slice(row, row + 1)
        world.reset(row)
        self.phase[row] = self._cycles[row] = self._start_cycles[row] = phase
        pose[0] = 0.0
        pose[1] += self.arena.height(np.zeros((1, 1)), rows)[0, 0]
        world.qpos[row, self._pose_qpos] = pose
        world.qvel[row, self._pose_dof] = rate
        world.forward(row)
        lift = self._penetration(row) + CLEARANCE
        if lift > 0:
            world.qpos[row, self._pose_qpos[1]] += lift
            world.forward(row)
        self.failed[row] = self.diverged[row] = False
        self.reward[row] = 0.0
        self._observe(self._all if world.n == 1 else self._views(rows))

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
        self.arena.follow(self._all.x)

    def finish_step(self) -> None:
        v = self._all
        self._cycles += self._phase_step
        np.remainder(self._cycles, _ONE, out=self.phase)
        # Sums of squares are the cheapest tests for what hardly ever happens.
        fast = np.vdot(v.rates, v.rates) > MAX_JOINT_SPEED**2
        if fast or self.world.any_diverged():
            np.abs(v.rates).max(1, out=self._speed)
            np.logical_or(self.world.diverged(), self._speed > MAX_JOINT_SPEED, out=self.diverged)
            # The last finite observation stands for what broke down.
            kept = self.observation[self.diverged]
            self._observe(v)
            self.observation[self.diverged] = kept
        else:
            self.diverged[:] = False
            self._observe(v)
        np.logical_or.reduce(v.fall, axis=1, out=self.failed)
        self.failed |= self.diverged
        self.reward_terms[self.failed] = 0.0
        np.add.reduce(self.reward_terms, axis=1, out=self.reward)

    def _observe(self, v: SimpleNamespace) -> None:
        """Writes observation and reward terms of some rows from the world's state."""
        # A trunk that points backwards looks backwards.
        facing = None
        if np.vdot(v.pitch, v.pitch) > _UPRIGHT**2:
            facing = np.where(np.cos(v.pitch) < 0, -1.0, 1.0)[:, None]
        np.subtract(v.xipos, v.root, out=v.position)
        # Spatial velocities are about the centre of mass of the whole tree: v + w x r.
        turning = v.xipos - v.com
        turning *= v.spin
        np.add(v.linear_x, turning[:, :, 1], out=v.velocity_x)
        np.subtract(v.linear_z, turning[:, :, 0], out=v.velocity_z)

        samples = len(self._samples) - 1
        v.xpos.take(self._effector_xz, axis=1, out=v.effectors, mode='clip')
        np.add(v.x, self._samples if facing is None else facing * self._samples, out=v.sample_x)
        v.effector_ground_x[...] = v.effector_x
        ground = self.arena.height(v.ground_x, v.rows)
        under_root = ground[:, samples, None]
        np.subtract(v.z, under_root, out=v.height)
        if samples:
            np.subtract(ground[:, :samples], under_root, out=v.terrain)

        # What the reward compares, side by side with the same features of the reference.
        reference = self.reference.features(v.phase)
        v.angles_out[...] = v.angles
        v.rates_out[...] = v.rates
        v.effector_x -= v.com_x
        v.effector_z -= ground[:, samples + 1 :]
        np.matmul(self._share, v.velocity, out=v.com_velocity)
        v.height_out[...] = v.height
        error = v.compared - reference[:, : v.compared.shape[1]]
        if facing is not None:
            error[:, 0] = rewards.wrap(error[:, 0])
        error *= error
        # Row by row, so that a row's sums do not depend on how many rows there are.
        np.matmul(error[:, None], self._weights, out=v.errors)
        rewards.imitation(v.errors[:, 0], out=v.reward_terms)

        if facing is not None:
            v.position[:, :, 0] *= facing
            v.velocity_x *= facing
        if self._link_order is not None:
            v.position_out[...] = v.position[:, self._link_order]
            v.velocity_out[...] = v.velocity[:, self._link_order]
        if v.strain is not None:
            np.subtract(v.tendons, self._rest, out=v.strain)
            v.strain /= self._scale
        if v.target is not None:
            v.target[...] = reference[:, self._target_columns]
        else:
            v.phase_out[...] = reference[:, self._phase_columns]
            v.phase_out[:, :1] = v.phase_column

    def info(self, row: int) -> dict[str, Any]:
        """Reward terms, fall and divergence flags, and the distance travelled in m."""
        terms = zip(rewards.IMITATION_TERMS, self.reward_terms[row], strict=True)
        return {
            'reward_terms': {name: float(value) for name, value in terms},
            'fell': bool(self.failed[row] and not self.diverged[row]),
            'diverged': bool(self.diverged[row]),
            'distance': float(self.world.qpos[row, self._pose_qpos[0]]),
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
        pose[1] += self.arena.height(np.full((1, 1), pose[0]), slice(row, row + 1))[0, 0]
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


def consecutive_or_array(addresses: np.ndarray) -> slice | np.ndarray:
    """Returns addresses as a slice where they follow each other: a view is cheaper than a copy."""
    first, count = int(addresses[0]), len(addresses)
    if (addresses == np.arange(first, first + count)).all():
        return slice(first, first + count)
    return addresses


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
