"""Simulations in which gaits are measured, and the files of their parameters."""

from __future__ import annotations

import dataclasses
import json
import pathlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from trl_suite.bodies.reference import CONTROL_TIMESTEP
from trl_suite.controllers import GAIT_TIMESTEP, Parameters, parameters
from trl_suite.environments import states
from trl_suite.registry.catalogue import EnvSpec
from trl_suite.tasks.gait.rules import LONGEST_CYCLE
from trl_suite.tasks.gait.task import GaitTask
from trl_suite.util import errors, files
from trl_suite.vector import VectorEnvironment

START_NOISE = 0.01  # rad, of the joints; see `GaitTask`
HORIZON = 20.0  # s
FRICTION = 0.81  # that of the suite
CYCLE, MOST_CYCLES, BONUS = 0.1, 15, 0.02  # shortest duration, s; largest number; bonus for each
REACH = 1000.0  # action scale in search scales, so large that no action is clipped


@dataclasses.dataclass(frozen=True)
class Runs:
    """The results of n episodes; arrays (n,).

    Attributes:
      horizon: intended duration, s.
      upright: whether the episode ended without a fall.
      time: duration, s.
      distance: distance travelled by the centre of mass, m.
      cycles: number of complete cycles: forward, ended by the state machine, and longer than
        `CYCLE`.
    """

    horizon: float
    upright: np.ndarray
    time: np.ndarray
    distance: np.ndarray
    cycles: np.ndarray

    @property
    def speed(self) -> np.ndarray:
        """Mean over the episode, m/s."""
        return self.distance / self.time

    def score(self, target: float) -> np.ndarray:
        """Share of the horizon without a fall, reduced by the error of the speed, and a bonus for cycles."""
        share = np.where(self.upright, 1.0, np.minimum(self.time / self.horizon, 1.0))
        quick = 0.5 + 0.5 * np.exp(-0.5 * (self.speed - target) ** 2)
        return share * quick + BONUS * np.minimum(self.cycles, MOST_CYCLES)

    def record(self, target: float) -> dict[str, Any]:
        """Returns the published figures of a gait."""
        return {
            'upright': f'{int(self.upright.sum())}/{len(self.upright)}',
            'speed': round(float(self.speed.mean()), 2),
            'speed_range': [round(float(end(self.speed)), 2) for end in (np.min, np.max)],
            'time': round(float(np.minimum(self.time, self.horizon).mean()), 1),
            'distance': round(float(self.distance.mean()), 1),
            'score': round(float(self.score(target).mean()), 3),
        }


class Bench:
    """Episodes of one character, each with its own gait, noisy start and friction."""

    def __init__(
        self, character: str, num_envs: int, action_offset: np.ndarray, terrain: str = 'flat'
    ) -> None:
        """Makes the simulations; actions of 0 set the parameters `action_offset`, (P,)."""
        spec = EnvSpec(
            id=f'{character}/gait/{terrain}/tuning', domain='custom', task='tuning',
            character=character, actuation='gait', terrain=terrain, task_type='gait',
            options={'start_noise': START_NOISE}, description='Gaits are measured.',
        )  # fmt: skip
        self.environments = VectorEnvironment(spec, num_envs, 1, seed=0)
        task = self.environments.task
        assert isinstance(task, GaitTask)
        self.task, self.gait = task, task.gait.parameters
        self.action_offset, self.action_scale = action_offset, REACH * self.gait.search_scale
        # So that actions in [-1, 1] reach every candidate.
        task.data.action_offset[:] = action_offset
        task.data.action_scale[:] = self.action_scale[self.gait.actions]
        self.frictions = np.array([model.geom_friction[:, 0].max() for model in task.world.models])

    def actions(self, vectors: np.ndarray) -> np.ndarray:
        """Returns the actions that set parameters (..., P)."""
        places = self.gait.actions
        return (vectors - self.action_offset)[..., places] / self.action_scale[places]

    def run(
        self, vectors: np.ndarray, seeds: np.ndarray, horizon: float, friction: np.ndarray
    ) -> Runs:
        """Runs every simulation until a fall or the end of the horizon.

        Args:
          vectors: gait parameters of each simulation, (n, P).
          seeds: seeds of the starts, (n,).
          horizon: s.
          friction: coefficient of sliding friction of ground and character, (n,).
        """
        task, world, count = self.task, self.task.world, len(vectors)
        for env_id in np.flatnonzero(friction != self.frictions).tolist():
            world.models[env_id].geom_friction[:, 0] = friction[env_id]
            world.set_const(env_id)
        self.frictions = np.array(friction, float)
        self.environments.reset(seed=[int(seed) for seed in seeds])
        actions, root = self.actions(vectors), task.body.links[0]
        start = world.subtree_com[:, root, 0].copy()
        elapsed, distance = np.zeros((2, count))
        cycles, going = np.zeros(count, int), np.ones(count, bool)
        upright = np.ones(count, bool)
        while going.any():
            env_ids = np.flatnonzero(going)
            task.step(actions, env_ids)
            duration, failed = task.state.duration[env_ids], task.failed[env_ids]
            elapsed[env_ids] += duration
            now = np.nan_to_num(world.subtree_com[env_ids, root, 0] - start[env_ids])
            whole = (duration > CYCLE) & (
                duration < LONGEST_CYCLE * CONTROL_TIMESTEP - GAIT_TIMESTEP
            )
            cycles[env_ids] += whole & ~failed & (now > distance[env_ids])
            distance[env_ids] = now
            in_time = elapsed[env_ids] < horizon
            upright[env_ids] = ~(failed & in_time)
            going[env_ids] = ~failed & in_time
        return Runs(horizon, upright, elapsed, distance, cycles)

    def measure(self, vector: np.ndarray, frictions: Sequence[float], seed: int = 0) -> Runs:
        """Runs a gait in all simulations for the long horizon, with the same starts per friction."""
        rows = self.environments.num_envs
        starts = rows // len(frictions)
        seeds = np.tile(np.random.SeedSequence(seed).generate_state(starts), len(frictions))
        return self.run(np.tile(vector, (rows, 1)), seeds, HORIZON, np.repeat(frictions, starts))


def position(environments: VectorEnvironment) -> np.ndarray:
    """Returns the positions of the roots along the ground, (n,) m."""
    task = environments.task
    return task.world.qpos[:, int(task.body.pose_qpos[0])].copy()


def nudged(copies: VectorEnvironment, state: dict[str, Any], change: np.ndarray) -> dict[str, Any]:
    """Returns the state of a simulation with changed joint angles.

    Args:
      copies: environments of this kind.
      state: the state.
      change: changes of the angles of the joints, without the root, (j,) rad.
    """
    world = state['world'][0].copy()
    qpos = world[1 : 1 + copies.task.world.qpos.shape[1]]  # time precedes the positions
    joints = np.delete(np.arange(len(qpos)), copies.task.body.pose_qpos[:3])
    qpos[joints] += change
    return states.seal({**state, 'world': [world]})


def vector_of(gait: Parameters, start: str | None) -> np.ndarray:
    """Returns the parameters of a set by name, of a base action by number, or of action 0."""
    if start is None:
        return gait.action_offset
    if start.isdecimal() and int(start) < len(gait.base_actions):
        return gait.base_actions[int(start)]
    known = [*gait.sets, *map(str, range(len(gait.base_actions)))]
    errors.check_known('set or base action', known, start)
    return gait.sets[start]


def path_of(character: str) -> pathlib.Path:
    """Returns the path of the parameters of a character's gait."""
    return pathlib.Path(parameters.__file__).parent / f'{character}.json'


def stored(character: str) -> dict[str, Any]:
    """Returns the parameters of a character's gait."""
    return files.read_json(path_of(character))


def write(character: str, data: dict[str, Any]) -> pathlib.Path:
    """Writes the parameters of a character's gait: one line per state in a set."""
    misc, width = len(data['misc']), len(data['state_parameters'])

    def numbers(values: Sequence[float]) -> str:
        rows = [values[:misc], *(values[i : i + width] for i in range(misc, len(values), width))]
        lines = ['      ' + json.dumps(list(map(float, row)))[1:-1] for row in rows]
        return '[\n' + ',\n'.join(lines) + '\n    ]'

    def items(entries: dict[str, Any], shown: Callable[[Any], str] = json.dumps) -> str:
        lines = [f'    {json.dumps(name)}: {shown(value)}' for name, value in entries.items()]
        return '{\n' + ',\n'.join(lines) + '\n  }'

    parts = []
    for name, value in data.items():
        if name == 'sets':
            text = items(value, numbers)
        elif name in ('targets', 'tuning'):
            text = items(value)
        elif name == 'start':
            joints = items(value['joints']).replace('\n', '\n  ')
            text = items({k: v for k, v in value.items() if k != 'joints'})
            text = f'{text[:-4]},\n    "joints": {joints}\n  }}'
        elif name.endswith('base_actions'):
            lines = ',\n'.join(f'    {json.dumps(each)}' for each in value)
            text = f'[\n{lines}\n  ]'
        else:
            text = json.dumps(value)
        parts.append(f'  {json.dumps(name)}: {text}')
    text = '{\n' + ',\n'.join(parts) + '\n}\n'
    assert json.loads(text) == data
    files.write_text(text, path_of(character))
    return path_of(character)
