"""The TerrainRL family: an action sets the parameters of a gait, once per cycle.

A step of the environment is one gait cycle: it ends with the cycle, with a fall within it, or after
`LONGEST_CYCLE`. To discount by time, use gamma ** (`info['duration']` / unit of time) for a step;
the environment's discount is 0 after a fall and 1 otherwise.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from trl_suite import actuation
from trl_suite.actuation.action_map import ActionMap
from trl_suite.arenas import PlanarArena
from trl_suite.bodies.planar import PlanarBody
from trl_suite.bodies.reference import CONTROL_TIMESTEP, link_extents
from trl_suite.bodies.state import allocated
from trl_suite.characters import Character
from trl_suite.controllers import GAIT_TIMESTEP, Gait, dynamics, load
from trl_suite.controllers.parameters import BASE_ACTIONS
from trl_suite.engine import World
from trl_suite.policies.mirror import exchanged
from trl_suite.tasks.common.control import MOST_SUBSTEPS, GroundConfig, faces, flat_ground
from trl_suite.tasks.gait import rules
from trl_suite.tasks.rewards import terms_data
from trl_suite.tasks.task import Task
from trl_suite.terrain import PlanarGround
from trl_suite.util.compiled import packed
from trl_suite.util.options import option


@dataclasses.dataclass(frozen=True, kw_only=True)
class GaitConfig(GroundConfig):
    """Options of `GaitTask`."""

    interface: str = option(
        'parameters',
        "'parameters': a step is a cycle, and an action sets the gait's parameters; 0 is the default value, "
        "and +-1 differs from it by the largest deviation of any base action; 'base_action': a step is "
        '1/30 s, an action has one preference per base action, and the base action with the largest '
        'preference is used when the next cycle begins',
        choices=rules.INTERFACES,
    )
    base_actions: str = option(
        'default',
        "base actions: 'default', or 'original' for those of the papers, of which the first is the default "
        'gait; the two differ for biped, goat and hopper',
        choices=BASE_ACTIONS,
    )
    substeps: int = option(
        rules.SUBSTEPS,
        'physics steps per control step of 1/600 s',
        at_least=1,
        at_most=MOST_SUBSTEPS,
    )
    spawn: str = flat_ground()
    face_length: float | None = faces()
    start_noise: float = option(
        0.0,
        'standard deviation of the noise on joint angles at the start; that on joint rates (rad/s) and '
        'forward speed (m/s) is ten times as large',
        unit='rad', at_least=0, at_most=1,
    )  # fmt: skip


class GaitTask(Task):
    """A planar character travels at a target speed; actions set the parameters of its gait.

    Attributes:
      gait: the state machines.
      state: state of the task, after `bind`.
      watch: callback at every multiple of 1/30 s of the first simulation's episode, also within
        steps; for rendering.
    """

    state: rules.GaitTaskState
    fields = dynamics.FIELDS
    watch: Callable[[], None] | None = None

    CONFIG: Any = GaitConfig

    def __init__(self, character: Character, arena: PlanarArena, config: GaitConfig) -> None:
        """Attaches character and gait to an arena.

        Args:
          character: a character with a gait, see `trl_suite.controllers.available`.
          arena: the arena with its planar terrain.
          config: the options.

        Raises:
          ValueError: the character has no gait.
        """
        self.character, self.arena, self.config = character, arena, config
        self.interface = interface = config.interface
        self.steps_vary = interface == 'parameters'
        self.body = PlanarBody(character, arena, rules.BEHIND, rules.AHEAD, rules.SAMPLES)
        parameters = load(character.spec.name, config.base_actions)
        self.gait = Gait(character, arena.ground_body, arena.mjcf_model, parameters)
        self._control_substeps = int(config.substeps)
        timestep = GAIT_TIMESTEP / config.substeps
        self.set_timesteps(CONTROL_TIMESTEP, timestep)
        self._torques = actuation.add(character, 'torque', timestep)
        for joint in character.joints:  # the gaits were tuned for joints without these
            joint.damping = joint.armature = 0
        if interface == 'parameters':
            names = tuple(parameters.names[i] for i in parameters.actions)
            self.action_map = ActionMap(
                names, 'gait parameter', 'rad, m, N or 1', parameters.action_offset[parameters.actions],
                parameters.action_scale[parameters.actions],
            )  # fmt: skip
        else:
            count = len(parameters.base_actions)
            self.action_map = ActionMap(
                tuple(f'base_action_{i}' for i in range(count)), 'preference', '1',
                np.zeros(count), np.ones(count),
            )  # fmt: skip
        self.observed = rules.observed_blocks(self.body.blocks, character.spec, parameters)
        self.terms = tuple(
            dataclasses.replace(term, weight=parameters.reward[term.name]) for term in rules.TERMS
        )

    @property
    def root_entity(self) -> PlanarArena:
        return self.arena

    @property
    def made_of(self) -> dict[str, tuple[str, Any]]:
        return {**super().made_of, 'gait': (self.interface, self.gait.parameters)}

    @property
    def steps_per_call(self) -> int:
        return self._control_substeps

    def bind(self, world: World) -> None:
        self.world, n = world, world.n
        body, gait = self.body, self.gait
        measured = np.zeros((n, sum(block.size for block in body.blocks)))
        body.bind(world, self._torques, measured, body.blocks)
        gait.bind(world)
        self.state = allocated(rules.GaitTaskState, n, action=np.zeros(len(self.action_map)))
        self._allocate(n, self.state.distance)
        self.saved = (self.state, gait.state, self.outcome)
        self.info_arrays |= {
            'fell': self.state.fell,  # `outcome.fell` includes `stuck`
            'stuck': self.state.stuck,
            'duration': self.state.duration,
            'stumbled': self.state.stumbling,
        }
        parameters, spec = gait.parameters, self.character.spec
        stumble = [i for i, name in enumerate(spec.links) if name not in spec.stumble_exempt]
        pitch = parameters.observe_pitch
        self.data = rules.GaitTaskData(
            body=body.data,
            gait=gait.data,
            terms=terms_data(self.terms),
            interruption=np.zeros(n, int),
            state=self.state,
            outcome=self.outcome,
            by_cycle=self.interface == 'parameters',
            substeps=self._control_substeps,
            action_offset=parameters.action_offset.copy(),
            action_scale=parameters.action_scale[parameters.actions],
            places=parameters.actions,
            base_actions=parameters.base_actions,
            fall=np.array([gait.link[name] for name in spec.fall_links]),
            stumble=np.array(stumble),
            forward_only=parameters.forward_only,
            backward_reward=parameters.backward_reward,
            target_speed=float(parameters.target_speed),
            sources=self._sources(),
            pitch=self.blocks['pose'].stop - 1 if pitch else -1,
            pitch_rate=self.blocks['velocity'].stop - 1 if pitch else -1,
        )
        self._pack = packed(self.data)
        self._start = self._start_pose()

    def _sources(self) -> np.ndarray:
        """Returns the columns of the body's blocks that are observed, by stance leg, (2, size)."""
        links, body = self.character.spec.links, self.body.data.columns
        pairs = [
            (links.index(right), links.index(left)) for right, left in self.character.spec.mirror
        ]
        arranged = []
        for each in (np.arange(len(links)), exchanged(len(links), pairs)):
            columns = 2 * each[:, None] + np.arange(2)
            pose, velocity = columns[1:] + body.pose + 1, columns + body.velocity
            terrain = np.arange(rules.SAMPLES) + body.terrain
            parts = terrain, [body.pose], pose.ravel(), velocity.ravel()
            arranged.append(np.concatenate(parts))
        return np.array(arranged)

    def _start_pose(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns initial pose and rates, (1, D), and extents of the geoms, (1, 3, G)."""
        start, body = self.gait.parameters.start, self.body
        pose, rates = np.zeros((2, 1, len(body.pose_qpos)))
        pose[0, 1:3], rates[0, :3] = (start['height'], start['pitch']), start['velocity']
        for name, (angle, rate) in start['joints'].items():
            pose[0, 3 + self.gait.number[name]] = angle
            rates[0, 3 + self.gait.number[name]] = rate
        return pose, rates, self._extents(pose[0])[None]

    def _extents(self, pose: np.ndarray) -> np.ndarray:
        """Returns the extents of the geoms in a pose (D,), (3, G)."""
        data = self.world.posed(self.body.pose_qpos, pose)
        root = data.xpos[self.body.links[0]][::2]
        return link_extents(self.world.models[0], data, self.body.geoms, root)

    def reset(self, env_ids: np.ndarray, random_states: Sequence[np.random.RandomState]) -> None:
        poses, rates, extents = (np.repeat(part, len(env_ids), axis=0) for part in self._start)
        for k, (i, random_state) in enumerate(zip(env_ids.tolist(), random_states, strict=True)):
            noise = self.config.start_noise * random_state.standard_normal((2, poses.shape[1] - 3))
            push = self.config.start_noise * random_state.standard_normal()
            poses[k, 3:] += noise[0]
            rates[k, 3:] += 10 * noise[1]
            rates[k, 0] += 10 * push
            if self.config.start_noise:
                extents[k] = self._extents(poses[k])
            strip = PlanarGround(
                self.arena.terrain,
                self.terrain_seed(i, random_state),
                terrain_level=self.config.terrain_level,
                spawn=self.config.spawn,
                centre=rules.UPSTREAM_CENTRE,
            )
            self.arena.begin_episode(i, strip)
        self.world.reset(env_ids)
        self.body.place(env_ids, poses, rates, extents)
        for array in (*self.state, *self.outcome[1:]):  # all but the observation
            array[env_ids] = 0
        rules.begin_episodes(env_ids, self._pack)

    def apply_action(self, action: np.ndarray, env_ids: np.ndarray) -> None:
        rules.begin_steps(env_ids, action, self._pack)

    def simulate(self, env_ids: np.ndarray) -> None:
        """Runs each simulation to the end of its cycle, or for 1/30 s."""
        interruption = self.data.interruption
        while rules.run(env_ids, self.watch is not None, self._pack):
            leaving = env_ids[interruption[env_ids] == rules.GROUND]
            if len(leaving):
                self.body.recentre(leaving)
            if self.watch is not None and (interruption[env_ids] == rules.WATCH).any():
                self.watch()

    def finish_step(self, env_ids: np.ndarray) -> None:
        rules.finish_steps(env_ids, self._pack)

    def observe(self, env_ids: np.ndarray | None = None) -> None:
        env_ids = self.world.all_ids if env_ids is None else env_ids
        rules.observe_all(env_ids, self._pack)
