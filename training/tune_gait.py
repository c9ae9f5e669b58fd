"""Searches for a character's default gait (action 0), or evaluates gaits.

    python training/tune_gait.py --evaluate                 # of all characters, on flat ground
    python training/tune_gait.py goat --evaluate --start climb0_020 --terrain steps --friction 0.6
    python training/tune_gait.py goat --start climb0_050 --seed 1

A search writes its best gait into `trl_suite/controllers/CHARACTER.json` as set 'tuned', with a
record of the search, and makes it action 0. It uses CMA-ES (Hansen 2016, arXiv:1604.00772) over the
parameters that an action sets, in units of the gait's search scale. The score of an episode is the
share of the horizon without a fall * (0.5 + 0.5 exp(-0.5 (v - target)^2)) + 0.02 for each of up to
15 complete cycles. A candidate's score is the mean over noisy starts, which are the same for all
candidates of a generation, with the coefficients of friction in `FRICTIONS` in turn. The first part
of a search has a short horizon, the second a long one. Finally, the mean of the distribution and
the best candidates of the last generations are compared on new starts. Needs
`pip install 'trl_suite[tune]'`; evaluation does not.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import pathlib
import time
from collections.abc import Callable, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from trl_suite.controllers import CONTROL_TIMESTEP, Parameters, available, load, parameters
from trl_suite.environments import states
from trl_suite.registry.catalogue import EnvSpec
from trl_suite.tasks.gait.rules import FRAME, LONGEST_CYCLE, SUBSTEPS
from trl_suite.tasks.gait.task import GaitTask
from trl_suite.util import errors, files
from trl_suite.util.program import begin_script
from trl_suite.vector import VectorEnvironment

START_NOISE = 0.01  # rad, of the joints; see `GaitTask`
HORIZONS = (6.0, 20.0)  # s, of the two parts of a search
FRICTIONS = (0.81, 0.6, 1.0)  # of the starts of a candidate, in turn; the suite's friction first
EPISODES, EVALUATION_SEED = 20, 0  # of published figures
FINAL_SEED = 2**31  # combined with the seed of the search for the finalists' starts
FINALISTS = 7  # the best of this number of last generations, and the mean of the distribution
CYCLE, MOST_CYCLES, BONUS = 0.1, 15, 0.02  # shortest duration, s; largest number; bonus for each
REACH = 1000.0  # action scale in search scales, so large that no action is clipped
DIGITS = 6


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
        share = np.where(self.upright, 1.0, np.minimum(self.time / self.horizon, 1.0))
        quick = 0.5 + 0.5 * np.exp(-0.5 * (self.speed - target) ** 2)
        return share * quick + BONUS * np.minimum(self.cycles, MOST_CYCLES)


class Bench:
    """Episodes of one character, each with its own gait, noisy start and friction."""

    def __init__(
        self,
        character: str,
        num_envs: int,
        action_offset: np.ndarray,
        terrain: str = 'flat',
        substeps: int = SUBSTEPS,
        threads: int = 1,
    ) -> None:
        """Compiles the model and makes the simulations.

        Args:
          character: one with a gait.
          num_envs: number of simulations.
          action_offset: parameters at action 0, (P,), which are used without rounding.
          terrain: terrain of all simulations.
          substeps: physics steps per control step.
          threads: number of threads that step the physics.
        """
        spec = EnvSpec(
            id=f'{character}/gait/{terrain}/tuning', domain='custom', task='tuning',
            character=character, actuation='gait', terrain=terrain, task_type='gait',
            options=MappingProxyType({'start_noise': START_NOISE, 'substeps': substeps}),
            description='Gaits are measured.',
        )  # fmt: skip
        self.environments = VectorEnvironment(spec, num_envs, threads, seed=0)
        task = self.environments.task
        assert isinstance(task, GaitTask)
        self.task, self.gait = task, task.gait.parameters
        self.action_offset, self.action_scale = action_offset, REACH * self.gait.search_scale
        # So that actions in [-1, 1] reach every candidate.
        task.rules.options.action_offset[:] = action_offset
        task.rules.options.action_scale[:] = self.action_scale[self.gait.actions]
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
        actions = self.actions(vectors)
        root = task.figure.links[0]
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
            whole = (duration > CYCLE) & (duration < LONGEST_CYCLE * FRAME - CONTROL_TIMESTEP)
            cycles[env_ids] += whole & ~failed & (now > distance[env_ids])
            distance[env_ids] = now
            in_time = elapsed[env_ids] < horizon
            upright[env_ids] = ~(failed & in_time)
            going[env_ids] = ~failed & in_time
        return Runs(horizon, upright, elapsed, distance, cycles)


def position(environments: VectorEnvironment) -> np.ndarray:
    """Returns the positions of the roots along the ground, (n,) m."""
    task = environments.task
    return task.world.qpos[:, int(task.figure.pose_qpos[0])].copy()


def nudged(copies: VectorEnvironment, state: dict[str, Any], change: np.ndarray) -> dict[str, Any]:
    """Returns the state of a simulation with changed joint angles.

    Args:
      copies: environments of this kind.
      state: the state.
      change: changes of the angles of the joints, without the root, (j,) rad.
    """
    world = state['world'][0].copy()
    qpos = world[1 : 1 + copies.task.world.qpos.shape[1]]  # time precedes the positions
    joints = np.delete(np.arange(len(qpos)), copies.task.figure.pose_qpos[:3])
    qpos[joints] += change
    return states.seal({**state, 'world': [world]})


def vector_of(gait: Parameters, start: str | None) -> np.ndarray:
    """Returns the parameters of a set by name, of a base action by number, or of action 0."""
    if start is None:
        return gait.action_offset
    if start.isdecimal() and int(start) < len(gait.base_actions):
        return gait.base_actions[int(start)]
    if start not in gait.sets:
        known = [*gait.sets, *map(str, range(len(gait.base_actions)))]
        raise ValueError(errors.unknown('set or base action', start, known))
    return gait.sets[start]


def measure(
    bench: Bench, vector: np.ndarray, frictions: Sequence[float], seed: int = EVALUATION_SEED
) -> Runs:
    """Runs a gait in all simulations for the long horizon, with the same starts per friction."""
    rows = bench.environments.num_envs
    starts = rows // len(frictions)
    seeds = np.random.SeedSequence(seed).generate_state(starts)
    return bench.run(
        np.tile(vector, (rows, 1)),
        np.tile(seeds, len(frictions)),
        HORIZONS[1],
        np.repeat(frictions, starts),
    )


def record(runs: Runs, target: float) -> dict[str, Any]:
    """Returns the published figures of a gait."""
    speed = runs.speed
    return {
        'upright': f'{int(runs.upright.sum())}/{len(speed)}',
        'speed': round(float(speed.mean()), 2),
        'speed_range': [round(float(speed.min()), 2), round(float(speed.max()), 2)],
        'time': round(float(np.minimum(runs.time, runs.horizon).mean()), 1),
        'distance': round(float(runs.distance.mean()), 1),
        'score': round(float(runs.score(target).mean()), 3),
    }


def evaluate(arguments: argparse.Namespace) -> None:
    choices = itertools.product(arguments.characters or available(), arguments.terrain)
    for character, terrain in choices:
        gait, options = load(character), (terrain, arguments.substeps, arguments.threads)
        vector = vector_of(gait, arguments.start)
        bench = Bench(character, arguments.episodes, vector, *options)
        for friction in arguments.friction:
            runs = measure(bench, vector, [friction])
            found = record(runs, gait.target_speed)
            slowest, quickest = found['speed_range']
            print(
                f'{character:17} {terrain}, friction {friction:4}  '
                f'upright {found["upright"]:>5}  '
                f'{found["speed"]:5.2f} m/s ({slowest:5.2f} to {quickest:5.2f})  '
                f'{found["time"]:4.1f} s  {found["distance"]:5.1f} m  score {found["score"]:.3f}',
                flush=True,
            )
        bench.environments.close()


def search(arguments: argparse.Namespace) -> tuple[np.ndarray, dict[str, Any]]:
    """Returns the best gait, and a record of the search."""
    import cma

    (character,) = arguments.characters
    gait, starts = load(character), arguments.starts
    start, places, target = vector_of(gait, arguments.start), gait.actions, gait.target_speed
    rng = np.random.default_rng(arguments.seed)
    population = arguments.population
    options = 'flat', arguments.substeps, arguments.threads
    bench = Bench(character, population * starts, start, *options)
    frictions = list(dict.fromkeys(arguments.friction))

    def vectors(candidates: Sequence[np.ndarray]) -> np.ndarray:
        result = np.tile(start, (len(candidates), 1))
        result[:, places] += np.asarray(candidates) * gait.search_scale[places]
        result[:, gait.absolute] = np.abs(result[:, gait.absolute])
        return result

    strategy = cma.CMAEvolutionStrategy(
        np.zeros(len(places)),
        arguments.sd,
        {
            'popsize': population,
            'CMA_diagonal': arguments.separable,
            'seed': int(rng.integers(1, 2**31)),
            'verbose': -9,
        },
    )
    began, evaluations, simulated = time.monotonic(), 0, 0.0
    finalists: list[np.ndarray] = []
    horizons = np.repeat(HORIZONS, arguments.generations).tolist()
    for number, horizon in enumerate(horizons, 1):
        candidates = strategy.ask()
        seeds = rng.integers(2**32, size=starts)
        runs = bench.run(
            np.repeat(vectors(candidates), starts, axis=0),
            np.tile(seeds, population),
            horizon,
            np.tile(np.resize(frictions, starts), population),
        )
        scores = runs.score(target).reshape(population, starts).mean(1)
        strategy.tell(candidates, -scores)
        evaluations += len(runs.time)
        simulated += float(runs.time.sum())
        best = scores.argmax()
        mine = slice(best * starts, (best + 1) * starts)
        finalists = [*finalists, candidates[best]][-FINALISTS:]
        print(
            f'{number:3}/{len(horizons)} {horizon:2.0f} s  best {scores[best]:.3f} '
            f'({runs.upright[mine].sum()}/{starts} upright, {runs.speed[mine].mean():.2f} m/s)  '
            f'mean {scores.mean():.3f} ({runs.upright.mean():.0%} upright)  '
            f'sd {strategy.sigma:.2f}  {time.monotonic() - began:.0f} s',
            flush=True,
        )
    bench.environments.close()
    bench = Bench(character, EPISODES * len(frictions), start, *options)
    found, most = start, -np.inf
    for vector in vectors([strategy.result.xfavorite, *finalists]):
        vector = vector.round(DIGITS)
        runs = measure(bench, vector, frictions, FINAL_SEED + arguments.seed)
        score = float(runs.score(target).mean())
        print(
            f'finalist: {score:.3f} ({runs.upright.sum()}/{len(runs.upright)} upright)', flush=True
        )
        if score > most:
            found, most = vector, score
    bench.environments.close()
    bench = Bench(character, EPISODES, found)
    runs = measure(bench, found, FRICTIONS[:1])
    bench.environments.close()
    return found, {
        'start': arguments.start or 'action_offset',
        'seed': arguments.seed,
        'sd': arguments.sd,
        'population': population,
        'starts': starts,
        'generations': arguments.generations,
        'evaluations': evaluations,
        'simulated_seconds': round(simulated),
        **record(runs, target),
    }


def write(character: str, data: dict[str, Any]) -> pathlib.Path:
    """Writes the parameters of a character's gait: one line per state in a set."""
    path = pathlib.Path(parameters.__file__).parent / f'{character}.json'
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
    with files.replacing(path) as part:
        part.write_text(text)
    return path


def stored(character: str) -> dict[str, Any]:
    """Returns the contents of the parameter file of a character's gait."""
    return json.loads((pathlib.Path(parameters.__file__).parent / f'{character}.json').read_text())


def enter(character: str, vector: np.ndarray, log: dict[str, Any]) -> pathlib.Path:
    """Enters a gait as set 'tuned' and as action 0."""
    data = stored(character)
    data['sets']['tuned'] = vector.tolist()
    data['action_offset'] = 'tuned'
    data.setdefault('tuning', {})['tuned'] = log
    return write(character, data)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('characters', nargs='*', metavar='character', help=', '.join(available()))
    parser.add_argument(
        '--evaluate', action='store_true', help='evaluate without a search; write nothing'
    )
    parser.add_argument(
        '--start', help='name of a set, or number of a base action; default: action 0'
    )
    parser.add_argument('--friction', type=float, nargs='+', help='of ground and character')
    parser.add_argument(
        '--substeps', type=int, default=SUBSTEPS, help='physics steps per control step of 1/600 s'
    )
    parser.add_argument('--threads', type=int, default=1)
    measuring = parser.add_argument_group('measuring')
    measuring.add_argument('--terrain', nargs='+', default=['flat'])
    measuring.add_argument('--episodes', type=int, default=EPISODES)
    searching = parser.add_argument_group('searching')
    searching.add_argument('--seed', type=int, default=1)
    searching.add_argument(
        '--sd', type=float, default=0.35, help='initial standard deviation, in search scales'
    )
    searching.add_argument('--population', type=int, default=16)
    searching.add_argument(
        '--starts', type=int, default=3, help='number of noisy starts for each candidate'
    )
    searching.add_argument(
        '--generations',
        type=int,
        nargs=2,
        default=[25, 10],
        help='numbers of generations for 6 s and for 20 s',
    )
    searching.add_argument(
        '--separable', action=argparse.BooleanOptionalAction, default=True,
        help='adapt variances only, no covariances',
    )  # fmt: skip
    arguments = parser.parse_args()
    try:
        for character in arguments.characters or available():
            vector_of(load(character), arguments.start)
    except ValueError as error:
        parser.error(str(error))
    if arguments.evaluate:
        arguments.friction = arguments.friction or FRICTIONS[:1]
        return evaluate(arguments)
    arguments.friction = arguments.friction or FRICTIONS
    if len(arguments.characters) != 1:
        parser.error('a search requires exactly one character')
    vector, log = search(arguments)
    print(json.dumps(log))
    print(enter(arguments.characters[0], vector, log))
    return None


if __name__ == '__main__':
    begin_script()
    main()
