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
_BINS = np.arange(PHASE_BINS)
_CROSS = np.array([1.0, -1.0])  # v = w x r in the x-z plane: (w z, -w x) for w about +y
# Features of the reference that the reward compares, in the order of its terms.
_COMPARED = ('angles', 'rates', 'effectors', 'com_velocity', 'height')
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
            self.clip, world.models[0], self._pose_qpos, self._pose_dof, links, effectors
        )
        columns = self.reference.columns
        self._phase_step = self.control_timestep / self.reference.period
        self._target_columns = slice(columns['height'].start, columns['velocities'].stop)

        # Within the loop, bodies and joints stand in the engine's order, so that all of a
        # character is one slice of every array; only the observation is put into link order.
        self._bodies = bodies = slice(int(links.min()), int(links.max()) + 1)
        order = links - bodies.start
        self._link_order = None if (order == np.arange(len(links))).all() else order
        self._effector_bodies = effectors - bodies.start
        mass = world.models[0].body_mass[bodies, None]
        self._share = mass / mass.sum()
        # Weights of the squared differences of what the reward compares.
        weights = row.weights[np.argsort(self._pose_qpos[2:])]
        count = len(effectors)
        self._weights = np.concatenate([
            weights, weights, np.full(2 * count, 1 / count), [rewards.COM_ERROR_FACTOR] * 2, [1.0],
        ])  # fmt: skip
        self._compared = {name: columns[name] for name in _COMPARED}
        self._term_starts = np.array([part.start for part in self._compared.values()])

        n = world.n
        self.observation = np.zeros((n, max(part.stop for part in self.blocks.values())))
        self.reward = np.zeros(n)
        self.reward_terms = np.zeros((n, len(rewards.IMITATION_TERMS)))
        self.failed, self.diverged = np.zeros(n, bool), np.zeros(n, bool)
        self.phase = np.zeros(n)  # of the clip, in [0, 1)
        self._start_phases = np.zeros(n)
        self._steps = np.zeros(n)
        # One ground query serves samples, root and end effectors.
        self._ground_x = np.zeros((n, len(self._samples) + count))
        self._comparison = np.zeros((n, len(self._weights)))
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
        permuted = self._link_order is not None
        ground_x, compared = self._ground_x[rows], self._comparison[rows]
        view = SimpleNamespace(
            rows=rows,
            root=world.qpos[rows, None, x : z + 1],
            x=world.qpos[rows, x, None],
            z=world.qpos[rows, z, None],
            pitch=world.qpos[rows, pitch],
            angles=world.qpos[rows, angles],
            rates=world.qvel[rows, rates],
            xpos=world.xpos[rows, bodies, ::2],
            xipos=world.xipos[rows, bodies, ::2],
            spin=world.cvel[rows, bodies, 1:2],
            linear=world.cvel[rows, bodies, 3:6:2],
            com=world.subtree_com[rows, bodies.start, None, ::2],
            phase=self.phase[rows],
            com_x=world.subtree_com[rows, bodies.start, :1],
            ground_x=ground_x,
            sample_x=ground_x[:, : len(self._samples)],
            effector_x=ground_x[:, len(self._samples) :],
            compared=compared,
            **{f'compared_{name}': compared[:, part] for name, part in self._compared.items()},
            height=pose[:, :1],
            # Computed in the engine's order; out of place where the link order differs.
            position=np.empty(shape) if permuted else position,
            velocity=np.empty(shape) if permuted else velocity,
            position_out=position,
            velocity_out=velocity,
            terrain=out[:, blocks.get('terrain', slice(0, 0))],
            strain=out[:, blocks['strain']] if 'strain' in blocks else None,
            tendons=world.ten_length[rows],
            target=out[:, blocks['target']] if 'target' in blocks else None,
            phase_out=out[:, blocks['phase']] if 'phase' in blocks else None,
            fall=world.sensordata[rows, self._fall],
        )
        view.compared_effectors = view.compared_effectors.reshape(len(out), -1, 2)
        return view

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
        self.phase[row] = self._start_phases[row] = phase
        self._steps[row] = 0
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
        self.arena.follow(self._all.x[:, 0])

    def finish_step(self) -> None:
        v = self._all
        self._steps += 1
        np.multiply(self._steps, self._phase_step, out=self.phase)
        self.phase += self._start_phases
        self.phase %= 1.0
        fast = np.maximum.reduce(np.abs(v.rates), axis=1) > MAX_JOINT_SPEED
        np.logical_or(self.world.diverged(), fast, out=self.diverged)
        np.logical_or.reduce(v.fall, axis=1, out=self.failed)
        self.failed |= self.diverged
        # The last finite observation stands for what broke down.
        kept = self.observation[self.diverged] if self.diverged.any() else None
        self._observe(v)
        if kept is not None:
            self.observation[self.diverged] = kept
        self.reward_terms[self.failed] = 0.0
        np.add.reduce(self.reward_terms, axis=1, out=self.reward)

    def _observe(self, v: SimpleNamespace) -> None:
        """Writes observation and reward terms of some rows from the world's state."""
        # A trunk that points backwards looks backwards.
        backwards = np.cos(v.pitch) < 0
        facing = np.where(backwards, -1.0, 1.0) if backwards.any() else None
        np.subtract(v.xipos, v.root, out=v.position)
        # Spatial velocities are about the centre of mass of the whole tree.
        np.multiply((v.xipos - v.com)[:, :, ::-1], v.spin, out=v.velocity)
        v.velocity *= _CROSS
        v.velocity += v.linear

        samples = len(self._samples) - 1
        effector = v.xpos[:, self._effector_bodies]
        offsets = self._samples if facing is None else facing * self._samples
        np.add(v.x, offsets, out=v.sample_x)
        v.effector_x[...] = effector[:, :, 0]
        ground = self.arena.height(v.ground_x, v.rows)
        under_root = ground[:, samples, None]
        np.subtract(v.z, under_root, out=v.height)
        if samples:
            np.subtract(ground[:, :samples], under_root, out=v.terrain)

        # What the reward compares, side by side with the same features of the reference.
        reference = self.reference.features(v.phase)
        v.compared_angles[...] = v.angles
        v.compared_rates[...] = v.rates
        np.subtract(effector[:, :, 0], v.com_x, out=v.compared_effectors[:, :, 0])
        np.subtract(effector[:, :, 1], ground[:, samples + 1 :], out=v.compared_effectors[:, :, 1])
        np.add.reduce(v.velocity * self._share, axis=1, out=v.compared_com_velocity)
        v.compared_height[...] = v.height
        error = v.compared
        error -= reference[:, : error.shape[1]]
        error[:, 0] = rewards.wrap(error[:, 0])
        error *= error
        error *= self._weights
        self.reward_terms[v.rows] = rewards.imitation(
            np.add.reduceat(error, self._term_starts, axis=1)
        )

        if facing is not None:
            v.position[:, :, 0] *= facing
            v.velocity[:, :, 0] *= facing
        if self._link_order is not None:
            v.position_out[...] = v.position[:, self._link_order]
            v.velocity_out[...] = v.velocity[:, self._link_order]
        if v.strain is not None:
            np.subtract(v.tendons, self._rest, out=v.strain)
            v.strain /= self._scale
        if v.target is not None:
            v.target[...] = reference[:, self._target_columns]
        else:
            v.phase_out[:, 0] = v.phase
            np.equal(np.floor(v.phase * PHASE_BINS)[:, None], _BINS, out=v.phase_out[:, 1:])

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
        columns = {'position': 'joints', 'velocity': 'joint_rates'}
        if self.actuation_model not in columns:
            raise ValueError(
                f'{self.actuation_model} control cannot follow a clip open loop; position and '
                'velocity control can'
            )
        features = self.reference.features(self.phase[row : row + 1])[0]
        control = features[self.reference.columns[columns[self.actuation_model]]]
        return self.action_map.action(control)

    def reference_pose(self, row: int) -> np.ndarray:
        """Pose of the reference beside the simulated character: x, z, pitch, joints."""
        start = self._start_phases[row] * self.reference.period
        now = start + self._steps[row] * self.control_timestep
        first, pose = self.clip.pose(np.array([start, now]))
        pose[0] -= first[0]
        pose[1] += self.arena.height(np.full((1, 1), pose[0]), slice(row, row + 1))[0, 0]
        return pose

    def get_state(self, row: int) -> dict[str, Any]:
        return {
            'arena': self.arena.state(row),
            'phase': float(self.phase[row]),
            'start_phase': float(self._start_phases[row]),
            'steps': float(self._steps[row]),
            'observation': self.observation[row].copy(),
            'reward': float(self.reward[row]),
            'reward_terms': self.reward_terms[row].copy(),
            'failed': bool(self.failed[row]),
            'diverged': bool(self.diverged[row]),
        }

    def set_state(self, row: int, state: dict[str, Any]) -> None:
        self.arena.restore(row, state['arena'])
        self.phase[row], self._start_phases[row] = state['phase'], state['start_phase']
        self._steps[row] = state['steps']
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
