"""The TerrainRL family: an agent sets the parameters of a gait once per cycle.

One step of the environment is one gait cycle: it ends with the cycle, with a fall inside it, or after
`LONGEST_CYCLE`. A user who discounts by time raises gamma to `info['duration']` / their own unit;
the environment's discount is 0 after a fall and 1 otherwise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np

from trl_suite import actuation, controllers, errors
from trl_suite.action_map import ActionMap
from trl_suite.arenas import PlanarTerrain
from trl_suite.characters import Character
from trl_suite.controllers import CONTROL_TIMESTEP, dynamics
from trl_suite.engine import World
from trl_suite.kinematics.planar_reference import link_extents
from trl_suite.tasks.batch_task import BatchTask
from trl_suite.tasks.figure import PlanarFigure
from trl_suite.tasks.task import check_simulated, consecutive, drawn_seed
from trl_suite.terrain import Strip

SAMPLES, BEHIND, AHEAD = 200, 0.5, 10.0  # ground heights seen, and over which stretch, m
SUBSTEPS = 2  # physics steps per control step: 1/1200 s
FRAME = 1 / 30  # s; nominal control step, and the real one with interface 'base_action'
LONGEST_CYCLE = 50  # frames
UPSTREAM_CENTRE = 3.0  # m; where the original's first two stretches of ground meet
INTERFACES = ('parameters', 'base_action')

# Falls, all looked at every SAMPLE.
SAMPLE = 0.1  # s
FADING, SHARE, FALLEN = 0.9, 1 / 11, 0.25  # of the running share of samples with a fall link down
TURNED = 0.8 * np.pi  # rad
PATIENCE, PROGRESS = 5.0, 0.5  # s, m; who moves less than that in that time is stuck
NO_REWARD_BACKWARDS = ('raptor',)
FORWARD_ONLY = ('biped2d_simbicon',)  # characters whose root may not move backwards
MAX_JOINT_SPEED = 1000.0  # rad/s; feet whip: there is no damping in these joints

# Reward of a cycle: weight * exp(-0.5 (v - target)^2) + weight / (1 + 10 share of time stumbling).
SPEED_SHARPNESS, STUMBLE_SHARPNESS = 0.5, 10.0
WEIGHTS = {'speed': 0.8, 'stumble': 0.2}
ONLY_SPEED = {'speed': 1.0, 'stumble': 0.0}

_FRAME_STEPS = round(FRAME / CONTROL_TIMESTEP)
_SAMPLE_STEPS = round(SAMPLE / CONTROL_TIMESTEP)
_PATIENCE_STEPS = round(PATIENCE / CONTROL_TIMESTEP)


class GaitTask(BatchTask):
    """Travel at the target speed by setting a gait's parameters.

    Observation blocks: 'terrain', 200 ground heights from 0.5 m behind to 10 m ahead of the root,
    relative to the ground under it; 'pose', height of the root and (x, z) of every other link
    relative to it; 'velocity', (x, z) of every link. Bipeds show the leg that is to swing last; of
    the hopper's last link z becomes the root's pitch in pose and its rate in velocity.

    Attributes:
      watch: called at every multiple of 1/30 s of the first simulation's episode, within steps too;
        for pictures.
    """

    fields = dynamics.FIELDS
    watch: Callable[[], None] | None = None

    def __init__(
        self,
        character: Character,
        arena: PlanarTerrain,
        *,
        interface: str = 'parameters',
        substeps: int = SUBSTEPS,
        spawn: str = 'intended',
        blend: float = 0.0,
        start_noise: float = 0.0,
    ) -> None:
        """Attaches character and gait to an arena.

        Args:
          character: one with a gait, see `trl_suite.controllers.GAITS`.
          arena: planar terrain.
          interface: 'parameters': a step is a cycle, and an action sets the gait's parameters, 0 the
            default and +-1 the largest deviation of any base action. 'base_action': a step is 1/30
            s, and an action is one preference per base action, of which the largest counts when
            the next cycle begins.
          substeps: physics steps per control step of 1/600 s.
          spawn: where the ground begins, see `trl_suite.terrain.Strip`.
          blend: which of the terrain's parameter sets.
          start_noise: standard deviation that is added to the joints' angles (rad) at the start,
            and ten times that to their rates and to the speed (m/s).

        Raises:
          ValueError: no gait drives the character, or an option makes no sense.
        """
        if interface not in INTERFACES:
            raise ValueError(errors.unknown('interface', interface, INTERFACES))
        if int(substeps) != substeps or substeps < 1:
            raise ValueError(f'substeps is {substeps}; expected a positive integer')
        if not 0 <= start_noise < np.inf:
            raise ValueError(f'start_noise is {start_noise}; expected 0 or a positive number')
        self.character, self.arena, self.interface = character, arena, interface
        self.figure = PlanarFigure(character, arena, BEHIND, AHEAD, SAMPLES)
        self.gait = controllers.make(character, arena.ground_body, arena.mjcf_model)
        self._spawn, self._blend, self._noise = spawn, blend, float(start_noise)
        self._control_steps = int(substeps)
        timestep = CONTROL_TIMESTEP / substeps
        self.set_timesteps(FRAME, timestep)
        actuation.add(character, 'torque', timestep)
        for joint in character.joints:  # the gaits were tuned without
            joint.damping = joint.armature = 0
        parameters = self.gait.parameters
        if interface == 'parameters':
            names = tuple(parameters.names[i] for i in parameters.actions)
            self.action_map = ActionMap(
                names, 'gait parameter', 'rad, m, N or 1', parameters.centre[parameters.actions],
                parameters.half_range[parameters.actions],
            )  # fmt: skip
        else:
            count = len(parameters.base_actions)
            self.action_map = ActionMap(
                tuple(f'base_action_{i}' for i in range(count)), 'preference', '1',
                np.zeros(count), np.ones(count),
            )  # fmt: skip
        links = len(character.row.links)
        self.blocks = consecutive({
            'terrain': SAMPLES, 'pose': 2 * links - 1, 'velocity': 2 * links,
        })  # fmt: skip
        self.reward_weights = ONLY_SPEED if character.row.name == 'hopper' else WEIGHTS

    @property
    def root_entity(self) -> PlanarTerrain:
        return self.arena

    @property
    def signature(self) -> str:
        parts = self.character.row.name, self.arena.terrain.name, self.interface
        return f'{super().signature} of {" / ".join(parts)}'

    def bind(self, world: World) -> None:
        self.world = world
        self.figure.bind(world)
        self.gait.bind(world)
        row, n = self.character.row, world.n
        scope = f'{self.character.mjcf_model.model}/'
        self._controls = world.control_addresses([scope + name for name in row.joints])
        self._fall = np.array([self.gait.link[name] for name in row.fall_links])
        self._stumble = np.array([
            i for i, name in enumerate(row.links) if name not in row.stumble_exempt
        ])  # fmt: skip
        self._measured = np.zeros((n, sum(self.figure.blocks.values()) + 2))
        self._columns = self._arrangements()
        self._view = self._views()
        self.observation = np.zeros((n, max(part.stop for part in self.blocks.values())))
        self.reward = np.zeros(n)
        self.reward_terms = np.zeros((n, len(self.reward_weights)))
        self.failed, self.diverged = np.zeros(n, bool), np.zeros(n, bool)
        self._fallen, self._stuck = np.zeros(n, bool), np.zeros(n, bool)
        self._lasted, self._stumbled = np.zeros((2, n), int)  # control steps, of the last step
        self._from = np.zeros(n)  # m; of the centre of mass, at the beginning of the step
        self._age = np.zeros(n, int)  # control steps in the episode
        self._down = np.zeros(n)  # running share of samples with a fall link on the ground
        self._milestone = np.zeros((n, 2))  # m; root at the last test of progress
        self._waiting = np.ones(n, bool)  # whether a gait's cycle is over and wants parameters
        self._action = np.zeros((n, len(self.action_map)))
        self._start = self._start_pose()

    def _views(self) -> SimpleNamespace:
        blocks = consecutive(self.figure.blocks)
        n, effectors = self.world.n, len(self.figure.effectors)
        return self.figure.views(
            self._measured, blocks, np.zeros((n, 2 * effectors)), np.zeros((n, 2))
        )

    def _arrangements(self) -> np.ndarray:
        """Columns of the measurement that make an observation, by stance leg, (2, size)."""
        links = self.character.row.links
        count, name = len(links), self.character.row.name
        pose = SAMPLES + 1 + 2 * np.arange(count)[:, None] + np.arange(2)
        velocity = pose + 2 * count
        last = SAMPLES + 1 + 4 * count  # pitch and its rate
        order = np.arange(count)
        mirrored = order.copy()
        for right, left in self.character.row.mirror:
            i, j = links.index(right), links.index(left)
            mirrored[i], mirrored[j] = j, i
        arranged = []
        for links_in_order in (order, mirrored):
            columns = [np.arange(SAMPLES + 1), pose[links_in_order[1:]].ravel()]
            columns.append(velocity[links_in_order].ravel())
            arranged.append(np.concatenate(columns))
        result = np.array(arranged)
        if name == 'hopper':
            pose_end = self.blocks['pose'].stop - 1
            result[:, pose_end], result[:, -1] = last, last + 1
        return result

    def _start_pose(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pose and rates of the first instant, (1, D), and extents of the geoms, (1, 3, G)."""
        start, figure = self.gait.parameters.start, self.figure
        pose, rates = np.zeros((2, 1, self.gait.dynamics.size))
        pose[0, 1:3], rates[0, :3] = (start['height'], start['pitch']), start['velocity']
        for name, (angle, rate) in start['joints'].items():
            pose[0, 3 + self.gait.number[name]] = angle
            rates[0, 3 + self.gait.number[name]] = rate
        model = self.world.models[0]
        data = mujoco.MjData(model)
        data.qpos[figure.pose_qpos] = pose[0]
        mujoco.mj_kinematics(model, data)
        root = data.xpos[figure.links[0]][::2]
        return pose, rates, link_extents(model, data, figure.geoms, root)[None]

    def begin_episodes(
        self, rows: np.ndarray, random_states: Sequence[np.random.RandomState]
    ) -> None:
        poses, rates, extents = (np.repeat(part, len(rows), axis=0) for part in self._start)
        for i, (row, random_state) in enumerate(zip(rows.tolist(), random_states, strict=True)):
            noise = self._noise * random_state.standard_normal((2, poses.shape[1] - 3))
            push = self._noise * random_state.standard_normal()
            poses[i, 3:] += noise[0]
            rates[i, 3:] += 10 * noise[1]
            rates[i, 0] += 10 * push
            strip = Strip(
                self.arena.terrain,
                drawn_seed(random_state),
                blend=self._blend,
                spawn=self._spawn,
                centre=UPSTREAM_CENTRE,
            )
            self.arena.begin_episode(row, strip)
        self.figure.place(rows, poses, rates, extents)
        self.gait.begin(rows)
        for of_row in (
            self.failed, self.diverged, self._fallen, self._stuck, self.reward, self.reward_terms,
            self._lasted, self._stumbled, self._age, self._down,
        ):  # fmt: skip
            of_row[rows] = 0
        self._waiting[rows] = True
        self._milestone[rows] = self.world.qpos[rows][:, self.figure.pose_qpos[:2]]

    def act(self, action: np.ndarray) -> None:
        self._action[...] = np.clip(action, -1, 1)

    def simulate(self, rows: np.ndarray | None = None) -> None:
        """Runs each row to the end of its cycle, or for a frame."""
        rows = np.arange(self.world.n) if rows is None else rows
        if not len(rows):  # all have just begun an episode
            return
        self._lasted[rows] = self._stumbled[rows] = 0
        self._from[rows] = self.gait.dynamics.com(rows)[:, 0]
        self._parametrise(rows)
        by_cycle = self.interface == 'parameters'
        going = rows
        for step in range(LONGEST_CYCLE * _FRAME_STEPS if by_cycle else _FRAME_STEPS):
            if step % _FRAME_STEPS == 0:
                self.arena.follow(self.world.qpos[going][:, self.figure.pose_qpos[:1]], going)
            self.world.ctrl[going[:, None], self._controls] = self.gait.torques(going)
            self.world.step(self._control_steps, None if len(going) == self.world.n else going)
            ended = self.gait.advance(going)
            self._account(going)
            if self.watch is not None and self._age[0] % _FRAME_STEPS == 0:
                self.watch()
            over = self.failed[going]
            if by_cycle:
                over |= ended
            elif ended.any():
                self._waiting[going[ended]] = True
                self._parametrise(going[ended])
            if over.any():
                going = going[~over]
                if not len(going):
                    break

    def _parametrise(self, rows: np.ndarray) -> None:
        """Gives the gait of rows the parameters that their actions mean."""
        if self.interface == 'base_action':
            rows = rows[self._waiting[rows]]
            self._waiting[rows] = False
            choice = self._action[rows].argmax(1)
            self.gait.apply(rows, self.gait.parameters.base_actions[choice])
        else:
            self.gait.apply(rows, self.gait.parameters.vector(self._action[rows]))

    def _account(self, rows: np.ndarray) -> None:
        """Time, stumbling and falls after a control step of some rows."""
        touching = self.gait.touching(rows)
        self._lasted[rows] += 1
        self._stumbled[rows] += touching[:, self._stumble].any(1)
        self._age[rows] += 1
        sampled = self._age[rows] % _SAMPLE_STEPS == 0
        if not sampled.any():
            return
        rows = rows[sampled]
        self._down[rows] *= FADING
        self._down[rows] += SHARE * touching[sampled][:, self._fall].any(1)
        x, z, pitch = self.figure.pose_qpos[:3]
        turn = np.abs((self.world.qpos[rows, pitch] + np.pi) % (2 * np.pi) - np.pi)
        self._fallen[rows] = (self._down[rows] > FALLEN) | (turn > TURNED)
        if self.character.row.name in FORWARD_ONLY:
            self._fallen[rows] |= self.world.qvel[rows, self.figure.pose_dof[0]] < 0
        due = rows[self._age[rows] % _PATIENCE_STEPS == 0]
        if len(due):
            root = self.world.qpos[due][:, [x, z]]
            self._stuck[due] = np.hypot(*(root - self._milestone[due]).T) < PROGRESS
            self._milestone[due] = root
        rates = self.world.qvel[rows][:, self.figure.pose_dof[3:]]
        wild = ~(np.abs(rates) < MAX_JOINT_SPEED).all(1)
        self.diverged[rows] = wild | self.world.diverged()[rows]
        self.failed[rows] = self._fallen[rows] | self._stuck[rows] | self.diverged[rows]

    def finish_step(self, stepped: np.ndarray | None = None) -> None:
        rows = np.arange(self.world.n) if stepped is None else np.flatnonzero(stepped)
        check_simulated(self._lasted[rows])
        self.diverged[rows] |= self.world.diverged()[rows]
        self.failed |= self.diverged
        kept = self.observation[self.diverged]
        self.observe()
        self.observation[self.diverged] = kept  # the last finite one stands for what broke down
        lasted = self._lasted[rows]
        travelled = self.gait.dynamics.com(rows)[:, 0] - self._from[rows]
        speed = travelled / (CONTROL_TIMESTEP * lasted)
        target = self.gait.parameters.target_speed
        terms = self.reward_terms
        terms[rows, 0] = self.reward_weights['speed'] * np.exp(
            -SPEED_SHARPNESS * (speed - target) ** 2
        )
        share = self._stumbled[rows] / lasted
        terms[rows, 1] = self.reward_weights['stumble'] / (1 + STUMBLE_SHARPNESS * share)
        if self.character.row.name in NO_REWARD_BACKWARDS:
            terms[rows[speed < 0]] = 0.0
        terms[self.failed] = 0.0
        self.reward[...] = terms.sum(1)

    def observe(self, env_ids: np.ndarray | None = None) -> None:
        self.figure.measure(self._view)
        measured = self._measured
        measured[:, -2] = self.world.qpos[:, self.figure.pose_qpos[2]]
        measured[:, -1] = self.world.qvel[:, self.figure.pose_dof[2]]
        stance = getattr(self.gait, 'stance', None)
        if stance is None:
            measured.take(self._columns[0], 1, self.observation, 'clip')
        else:
            self.observation[...] = np.take_along_axis(measured, self._columns[stance], 1)

    def infos(self) -> dict[str, Any]:
        """Reward terms, how it ended, distance in m, duration of the cycle in s, its stumbling."""
        return {
            'reward_terms': dict(zip(self.reward_weights, self.reward_terms.T.copy(), strict=True)),
            'fell': self._fallen & ~self.diverged,
            'stuck': self._stuck & ~self.diverged,
            'diverged': self.diverged.copy(),
            'distance': self.world.qpos[:, self.figure.pose_qpos[0]].copy(),
            'duration': CONTROL_TIMESTEP * self._lasted,
            'stumbled': CONTROL_TIMESTEP * self._stumbled,
        }

    def get_state(self, row: int) -> dict[str, Any]:
        return {
            'arena': self.arena.state(row),
            'gait': self.gait.get_state(row),
            **{name: getattr(self, name)[row].copy() for name in _OF_ROWS},
        }

    def set_state(self, row: int, state: dict[str, Any]) -> None:
        self.arena.restore(row, state['arena'])
        self.gait.set_state(row, state['gait'])
        for name in _OF_ROWS:
            getattr(self, name)[row] = state[name]


_OF_ROWS = (
    'observation', 'reward', 'reward_terms', 'failed', 'diverged', '_lasted', '_stumbled', '_fallen',
    '_stuck', '_from', '_age', '_down', '_milestone', '_waiting', '_action',
)  # fmt: skip
