"""Searches for gaits: the default gait of a character, and gaits that its policies select from.

    python training/tune_gaits.py goat default --start climb0_050
    python training/tune_gaits.py biped2d_simbicon complement --terrain gaps walls steps
    python training/tune_gaits.py goat alone --terrain cliffs_rugged
    python training/tune_gaits.py hopper steady --length 1.4 --generations 60
    python training/tune_gaits.py goat enter --gaits tuned cliffs_rugged_1 climb0_075

CMA-ES (Hansen 2016, arXiv:1604.00772) searches over the parameters that an action sets, in units of the
gait's search scale.

`default`: a gait to repeat on flat ground. Its score (`Runs.score`) is the mean over noisy starts, the
same for all candidates of a generation, with the coefficients of friction in `FRICTIONS` in turn. The
first 25 generations have a short horizon, the others a long one. The best of the last candidates on new
starts is written into `trl_suite/controllers/CHARACTER.json` as set 'tuned', and becomes action 0.

`complement`: for each terrain, in the order given, the gaits found so far run over it until they fall, and
the states one to three cycles before these falls are stored. The score of a gait in a state is the
distance travelled with that gait for one cycle (two if the legs change roles each cycle) and the default
gait in the next cycles, divided by `USUAL` times the distance of as many cycles of the default gait on
flat ground, and at most 1. The score of a set of gaits is the mean over states of the score of its best
gait; a gait is searched for that increases it most. Stored scores are those in other states.

`alone`: a gait is repeated from the start of an episode instead, and its score is the distance travelled,
divided by the distance at the target speed.

`steady`: a gait with cycles of at least `--length`, whose landing place depends as little as possible on
the state, so that a policy can foresee it: after `SETTLED` cycles on flat ground the joint angles (and
slides) of copies of a simulation are changed at random, and the score is high where the copies are still
close together one to `AHEAD` cycles later. Falls, shorter cycles, and other speeds reduce it.

With `--within` only gaits that an action can set are searched for. A policy can select them without a
change of the base actions, and so of the action range: `learn_gaits.py` reads them with its setting
`gaits`. Gaits that were found are in OUTPUT/CHARACTER.json with records of the searches. `enter` makes
gaits of this file, or existing sets, the base actions in `trl_suite/controllers/CHARACTER.json`; `add`
stores gaits that were found with `--within`. Needs `pip install 'trl_suite[tune]'`.
"""

from __future__ import annotations

import argparse
import pathlib
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from gait_bench import FRICTION, HORIZON, Bench, nudged, position, stored, vector_of, write

from trl_suite import controllers
from trl_suite.controllers import Parameters
from trl_suite.util import errors, files
from trl_suite.util.libraries import library
from trl_suite.util.program import begin_script

# Of `default`: horizon of the first generations, s, and their number; frictions of the starts, in turn;
# number of starts of a candidate, and for the result.
SHORT, FIRST, FRICTIONS, EACH, EPISODES = 6.0, 25, (FRICTION, 0.6, 1.0), 3, 20
FINAL_SEED = 2**31  # combined with the seed of the search for the finalists' starts
BACK = 3  # largest number of cycles from a state to the fall
AFTER = 3  # cycles with the default gait after those with the candidate
USUAL = 0.8  # share of the distance on flat ground that gives the full score
OTHERS = 0.3  # share of the cycles before a fall with a gait drawn from all, instead of the first
ALONE = 8.0  # s, horizon
STATES, VALIDATION = 32, 64  # numbers of states for the search, and for the stored scores
STARTS = 6  # number of noisy starts; twice as many of `steady`
# Of `steady`: cycles before and after the change; copies of each start; standard deviation of the
# change, rad (slides: m); spread that counts as none, m; tolerance of the speed, m/s.
SETTLED, AHEAD, COPIES, CHANGE, CLOSE, SPEED_TOLERANCE = 4, 3, 4, 0.02, 3e-3, 0.6
# Weights of falls, of missing length (1/m) and of the speed (s/m) in the score.
FALLS, LENGTH, SPEED = 3.0, 2.0, 0.3
# By the search: initial standard deviation, in search scales; candidates of a generation; generations;
# decimals of the parameters; finalists, the best of this number of last generations.
DEFAULT, OTHER = (0.35, 16, 35, 6, 7), (0.5, 12, 30, 4, 5)


class Obstacles:
    """Simulations of one character on one terrain.

    Attributes:
      default: gait after the candidate, (P,).
      usual: distance of the default gait on flat ground in as many cycles, times `USUAL`, m.
    """

    def __init__(self, gait: Parameters, terrain: str, default: np.ndarray, num_envs: int) -> None:
        self.gait, self.default = gait, default
        self.lead = 2 if gait.kind == 'stride' else 1
        self.bench = Bench(gait.character, num_envs, gait.action_offset, terrain)
        self.bench.environments.reset()
        flat = Bench(gait.character, STARTS, gait.action_offset)
        runs = flat.measure(default, [FRICTION])
        flat.environments.close()
        self.usual = USUAL * (self.lead + AFTER) * runs.distance.sum() / runs.cycles.sum()

    def collect(
        self, vectors: np.ndarray, count: int, rng: np.random.Generator
    ) -> list[dict[str, Any]]:
        """Returns states shortly before falls of gaits (k, P), of which mostly the first one runs."""
        environments = self.bench.environments
        environments.seed(int(rng.integers(2**32)))
        environments.reset(list(range(count)))
        past: list[list[dict[str, Any]]] = [[] for _ in range(count)]
        going, back = np.ones(count, bool), rng.integers(1, BACK + 1, count)
        action = np.zeros((environments.num_envs, len(self.gait.actions)))
        while going.any():
            ids = np.flatnonzero(going)
            for i in ids.tolist():
                past[i] = [*past[i], environments.get_state([i])][-BACK:]
            chosen = rng.integers(len(vectors), size=len(ids)) * (rng.random(len(ids)) < OTHERS)
            action[ids] = self.bench.actions(vectors[chosen])
            step = environments.step(action, ids)
            ended = step.terminated | step.truncated
            for i in ids[ended[ids]].tolist():
                if len(past[i]) >= back[i]:
                    going[i] = False
                else:  # the episode is too short
                    environments.reset([i])
                    past[i] = []
        return [states[-number] for states, number in zip(past, back, strict=True)]

    def scores(self, vectors: np.ndarray, states: Sequence[dict[str, Any]]) -> np.ndarray:
        """Returns the scores of gaits (m, P) in each state, (m, states)."""
        environments, count = self.bench.environments, len(states)
        most = environments.num_envs // count
        found = []
        for first in range(0, len(vectors), most):
            part = vectors[first : first + most]
            going = np.arange(len(part) * count)
            for i in going.tolist():
                environments.set_state(states[i % count], [i])
            begin = position(environments)[going]
            reached = begin.copy()
            candidate, default = np.zeros((2, environments.num_envs, len(self.gait.actions)))
            candidate[going] = np.repeat(self.bench.actions(part), count, axis=0)
            default[:] = self.bench.actions(self.default)
            for cycle in range(self.lead + AFTER):
                step = environments.step(candidate if cycle < self.lead else default, going)
                going = going[~(step.terminated | step.truncated)[going]]
                reached[going] = position(environments)[going]
                if not len(going):
                    break
            share = np.clip((reached - begin) / self.usual, 0, 1)
            found.append(share.reshape(len(part), count))
        return np.concatenate(found)

    def alone(self, vectors: np.ndarray, seeds: np.ndarray) -> np.ndarray:
        """Returns the scores of repeated gaits (m, P) for each start, (m, starts)."""
        shape = len(vectors), len(seeds)
        rows, n = self.bench.environments.num_envs, len(vectors) * len(seeds)
        vectors, seeds = np.repeat(vectors, len(seeds), axis=0), np.tile(seeds, len(vectors))
        found = []
        for first in range(0, n, rows):  # the last part is filled up
            part = np.arange(first, first + rows) % n
            runs = self.bench.run(vectors[part], seeds[part], ALONE, np.full(rows, FRICTION))
            found.append(runs.distance / (ALONE * self.gait.target_speed))
        return np.clip(np.concatenate(found)[:n], 0, 1).reshape(shape)


def search(
    objective: Callable[[np.ndarray], np.ndarray],
    start: np.ndarray,
    gait: Parameters,
    arguments: argparse.Namespace,
    rng: np.random.Generator,
) -> np.ndarray:
    """Returns the mean of the last generation, and the best gaits of the last ones, (m, P)."""
    cma = library('cma', 'trl_suite[tune]')
    _, _, _, digits, finalists_ = DEFAULT if arguments.action == 'default' else OTHER

    def vectors(candidates: Sequence[np.ndarray], rounded: bool) -> np.ndarray:
        result = np.tile(start, (len(candidates), 1))
        result[:, gait.actions] += np.asarray(candidates) * gait.search_scale[gait.actions]
        result[:, gait.absolute] = np.abs(result[:, gait.absolute])
        if rounded:
            result[:, gait.actions] = result[:, gait.actions].round(digits)
        if arguments.within:
            # Rounding to `digits` would leave the range.
            result = gait.vector(gait.action(result).clip(-1, 1)).round(9)
        return result

    options = {
        'popsize': arguments.population, 'CMA_diagonal': True, 'verbose': -9,
        'seed': int(rng.integers(1, 2**31)),
    }  # fmt: skip
    strategy = cma.CMAEvolutionStrategy(np.zeros(len(gait.actions)), arguments.sd, options)
    finalists: list[np.ndarray] = []
    for number in range(arguments.generations):
        candidates = strategy.ask()
        scores = objective(vectors(candidates, arguments.action != 'default'))
        strategy.tell(candidates, -scores)
        finalists = [*finalists, candidates[scores.argmax()]][-finalists_:]
        if number % 10 == 9:
            print(f'  {number + 1:3} best {scores.max():.3f} mean {scores.mean():.3f}', flush=True)
    return vectors([strategy.result.xfavorite, *finalists], True)


def default(
    gait: Parameters, start: np.ndarray, arguments: argparse.Namespace, rng: np.random.Generator
) -> tuple[np.ndarray, dict[str, Any]]:
    """Searches for a default gait; returns it (P,), and its figures."""
    bench = Bench(gait.character, arguments.population * EACH, start)
    generation = 0

    def objective(vectors: np.ndarray) -> np.ndarray:
        nonlocal generation
        horizon, generation = SHORT if generation < FIRST else HORIZON, generation + 1
        seeds = rng.integers(2**32, size=EACH)
        runs = bench.run(
            np.repeat(vectors, EACH, axis=0), np.tile(seeds, len(vectors)), horizon,
            np.tile(np.resize(FRICTIONS, EACH), len(vectors)),
        )  # fmt: skip
        return runs.score(gait.target_speed).reshape(len(vectors), EACH).mean(1)

    found = search(objective, start, gait, arguments, rng)
    bench.environments.close()
    bench = Bench(gait.character, EPISODES * len(FRICTIONS), start)
    seed = FINAL_SEED + arguments.seed
    scores = [
        bench.measure(each, FRICTIONS, seed).score(gait.target_speed).mean() for each in found
    ]
    bench.environments.close()
    chosen = found[int(np.argmax(scores))]
    bench = Bench(gait.character, EPISODES, chosen)
    record = bench.measure(chosen, [FRICTION]).record(gait.target_speed)
    bench.environments.close()
    return chosen, record


def alone(
    obstacles: Obstacles, known: np.ndarray, arguments: argparse.Namespace, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Searches for a gait to repeat; returns it (P,), and all scores from new starts (m, starts)."""
    seeds = rng.integers(2**32, size=(2, 4 * STARTS))
    start = known[obstacles.alone(known, seeds[0]).mean(1).argmax()]

    def objective(vectors: np.ndarray) -> np.ndarray:
        return obstacles.alone(vectors, rng.integers(2**32, size=STARTS)).mean(1)

    found = search(objective, start, obstacles.gait, arguments, rng)
    chosen = found[obstacles.alone(found, seeds[0]).mean(1).argmax()]
    return chosen, obstacles.alone(np.array([*known, chosen]), seeds[1])


def complement(
    obstacles: Obstacles, known: np.ndarray, arguments: argparse.Namespace, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Searches for a gait to add; returns it (P,), and all scores in new states (m, states)."""
    states = obstacles.collect(known, STATES, rng)
    before = obstacles.scores(known, states)
    best = before.max(0)

    def objective(vectors: np.ndarray) -> np.ndarray:
        return np.maximum(obstacles.scores(vectors, states), best).mean(1)

    found = search(objective, known[before.mean(1).argmax()], obstacles.gait, arguments, rng)
    fresh = [obstacles.collect(known, VALIDATION, rng) for _ in range(2)]
    best = obstacles.scores(known, fresh[0]).max(0)
    chosen = found[np.maximum(obstacles.scores(found, fresh[0]), best).mean(1).argmax()]
    return chosen, obstacles.scores(np.array([*known, chosen]), fresh[1])


def steadiness(
    bench: Bench, vectors: np.ndarray, length: float, seeds: np.ndarray
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Measures how much the places depend on the state that gaits (m, P) reach on flat ground.

    Args:
      bench: at least m * starts * COPIES simulations.
      vectors: the gaits, (m, P).
      length: smallest desired length of a cycle, m.
      seeds: seeds of the starts, (starts,).

    Returns:
      The scores, (m,); and figures of each gait: `upright`, the share of simulations that have not
      fallen, (m,); `spread`, the mean standard deviation of the copies' places after each cycle since
      the change, (m, AHEAD) m; `length` of the cycles, (m,) m; and `speed`, (m,) m/s.
    """
    environments, shape = bench.environments, (len(vectors), len(seeds), COPIES)
    going = np.arange(np.prod(shape))
    action = np.zeros((environments.num_envs, len(bench.gait.actions)))
    action[going] = np.repeat(bench.actions(vectors), len(seeds) * COPIES, 0)
    environments.reset(seed=np.resize(np.repeat(seeds, COPIES), environments.num_envs).tolist())
    places, duration = np.full((AHEAD + 1, len(going)), np.nan), np.zeros(len(going))
    for cycle in range(SETTLED + AHEAD + 1):
        if cycle >= SETTLED:
            places[cycle - SETTLED, going] = position(environments)[going]
        if cycle == SETTLED:
            rng = np.random.default_rng(seeds)
            joints = environments.task.world.qpos.shape[1] - 3
            for i in going.tolist():
                state = environments.get_state([i])
                new = nudged(environments, state, rng.normal(0, CHANGE, joints))
                environments.set_state(new, [i])
        if cycle == SETTLED + AHEAD or not len(going):
            break
        step = environments.step(action, going)
        if cycle >= SETTLED:
            duration[going] += bench.task.state.duration[going]
        going = going[~(step.terminated | step.truncated)[going]]
    whole = np.isfinite(places[-1])
    # If a copy has fallen, the spread of its start counts as 1 m.
    spread = np.where(whole, places - places[0], 0.0)[1:].reshape(AHEAD, *shape).std(3)
    spread[:, ~whole.reshape(shape).all(2)] = 1.0
    distance = np.where(whole, places[-1] - places[0], 0.0).reshape(len(vectors), -1).sum(1)
    count = np.maximum(whole.reshape(len(vectors), -1).sum(1), 1)
    duration = np.where(whole, duration, 0.0).reshape(len(vectors), -1).sum(1)
    figures = {
        'upright': whole.reshape(len(vectors), -1).mean(1), 'spread': spread.mean(2).T,
        'length': distance / count / AHEAD, 'speed': distance / np.maximum(duration, 1e-9),
    }  # fmt: skip
    away = np.abs(figures['speed'] - bench.gait.target_speed)
    score = -np.log10(figures['spread'] + CLOSE).mean(1) - FALLS * (1 - figures['upright'])
    score -= LENGTH * np.maximum(0, length - figures['length'])
    return score - SPEED * np.maximum(0, away - SPEED_TOLERANCE), figures


def steady(
    gait: Parameters, start: np.ndarray, arguments: argparse.Namespace, rng: np.random.Generator
) -> tuple[np.ndarray, dict[str, Any]]:
    """Searches for a steady gait; returns it (P,), and figures of it and of the start."""
    rows = max(arguments.population, OTHER[-1] + 1) * 2 * STARTS * COPIES
    bench = Bench(gait.character, rows, gait.action_offset)

    def measured(vectors: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        return steadiness(bench, vectors, arguments.length, rng.integers(2**32, size=2 * STARTS))

    found = search(lambda vectors: measured(vectors)[0], start, gait, arguments, rng)
    chosen = found[measured(found)[0].argmax()]
    score, figures = measured(np.array([start, chosen]))
    bench.environments.close()
    return chosen, {'terrain': 'flat', 'cycle': arguments.length} | {
        name: {key: np.round(value[row], 3).tolist() for key, value in figures.items()}
        | {'score': round(float(score[row]), 3)}
        for row, name in enumerate(('start', 'found'))
    }


def enter_default(character: str, vector: np.ndarray, record: dict[str, Any]) -> pathlib.Path:
    """Enters a gait as set 'tuned' and as action 0."""
    data = stored(character)
    data['sets']['tuned'], data['action_offset'] = vector.tolist(), 'tuned'
    data.setdefault('tuning', {})['tuned'] = record
    return write(character, data)


def enter(character: str, found: dict[str, Any], names: Sequence[str]) -> pathlib.Path:
    """Makes gaits the base actions of a character, in this order.

    Numbers are indices of base actions of the original. The default gait, if it is the base action of
    an index, is that index of the new ones.

    Raises:
      ValueError: a name is unknown, or there are too few.
    """
    data = stored(character)
    offset = data['action_offset']
    if isinstance(offset, int) and offset >= len(names):
        raise ValueError(f'{len(names)} gaits; the default gait is base action {offset}')
    original = data.setdefault('original_base_actions', data['base_actions'])
    numbers = list(map(str, range(len(original))))
    errors.check_known('gait', [*found, *data['sets'], *numbers], *names)
    for name in names:
        if name in found:
            _store(data, found, name)
    data['base_actions'] = [
        original[int(name)] if name in numbers else [name, name, 0] for name in names
    ]
    used = {name for a, b, _ in (*original, *data['base_actions']) for name in (a, b)}
    used.add(offset)
    used |= {name for name, record in data.get('tuning', {}).items() if record.get('within')}
    for part in ('sets', 'tuning'):
        data[part] = {name: value for name, value in data.get(part, {}).items() if name in used}
    return write(character, data)


def add(character: str, found: dict[str, Any], names: Sequence[str]) -> pathlib.Path:
    """Stores gaits that a search within the action range has found.

    Raises:
      ValueError: there is no such gait.
    """
    data = stored(character)
    within = [name for name, record in found.items() if record['tuning'].get('within')]
    errors.check_known('gait within the action range', within, *names)
    for name in names:
        _store(data, found, name)
    return write(character, data)


def _store(data: dict[str, Any], found: dict[str, Any], name: str) -> None:
    data['sets'][name] = found[name]['vector']
    data.setdefault('tuning', {})[name] = found[name]['tuning']


def parsed() -> argparse.Namespace:
    """Parses the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('character', choices=controllers.available())
    actions = ('default', 'complement', 'alone', 'steady', 'enter', 'add')
    parser.add_argument('action', choices=actions)
    parser.add_argument('--terrain', nargs='+', help='of complement and alone: one gait for each')
    parser.add_argument('--length', type=float, help='of steady: shortest cycle, m')
    parser.add_argument(
        '--gaits', nargs='+', help='of enter and add: sets, or numbers of base actions'
    )
    parser.add_argument('--start', nargs='+', help='sets, or numbers of base actions')
    parser.add_argument('--within', action='store_true', help='search within the action range')
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--sd', type=float, help='initial standard deviation, in search scales')
    parser.add_argument('--population', type=int)
    parser.add_argument('--generations', type=int)
    parser.add_argument('--output', type=pathlib.Path, default=pathlib.Path('runs'))
    arguments = parser.parse_args()
    usual = DEFAULT if arguments.action == 'default' else OTHER
    for name, value in zip(('sd', 'population', 'generations'), usual, strict=False):
        if getattr(arguments, name) is None:
            setattr(arguments, name, value)
    needs = {'steady': 'length', 'enter': 'gaits', 'add': 'gaits'}
    needs |= dict.fromkeys(('complement', 'alone'), 'terrain')
    needed = needs.get(arguments.action)
    if needed and getattr(arguments, needed) is None:
        parser.error(f'{arguments.action} needs --{needed}')
    for option, users in (('terrain', ('complement', 'alone')), ('length', ('steady',))):
        if getattr(arguments, option) is not None and arguments.action not in users:
            parser.error(f'{arguments.action} takes no --{option}')
    if arguments.action in ('default', 'steady') and len(arguments.start or ()) > 1:
        parser.error(f'{arguments.action} takes one --start')
    if arguments.length is not None and not 0 < arguments.length < np.inf:
        parser.error(f'argument --length: {arguments.length}; expected a length above 0 m')
    return arguments


def main() -> None:
    arguments = parsed()
    action, gait = arguments.action, controllers.load(arguments.character)
    arguments.output.mkdir(parents=True, exist_ok=True)
    path = arguments.output / f'{gait.character}.json'
    found = files.read_json(path) if path.exists() else {}
    if action in ('enter', 'add'):
        print({'enter': enter, 'add': add}[action](gait.character, found, arguments.gaits))
        return
    known = [
        np.array(found[name]['vector']) if name in found else vector_of(gait, name)
        for name in arguments.start or (None,)
    ]
    rng = np.random.default_rng(arguments.seed)
    settings = {'search': action, 'known': arguments.start or ['default gait']} | {
        name: getattr(arguments, name)
        for name in ('seed', 'generations', 'population', 'sd', 'within')
    }
    for terrain in arguments.terrain or ('flat',):
        began = time.process_time()
        print(gait.character, terrain, flush=True)
        if action in ('default', 'steady'):
            tune = default if action == 'default' else steady
            chosen, record = tune(gait, known[0], arguments, rng)
        else:
            num_envs = arguments.population * (STARTS if action == 'alone' else STATES)
            obstacles = Obstacles(gait, terrain, known[0], num_envs)
            tune_set = alone if action == 'alone' else complement
            chosen, scores = tune_set(obstacles, np.array(known), arguments, rng)
            obstacles.bench.environments.close()
            means = scores[0], scores[:-1].max(0), scores[-1], scores.max(0)
            names = 'default', 'set_before', 'alone', 'set_after'
            record = {'terrain': terrain} | {
                name: round(float(each.mean()), 3) for name, each in zip(names, means, strict=True)
            }
            known.append(chosen)
        record = {**settings, **record, 'cpu_seconds': round(time.process_time() - began)}
        if action == 'default':
            print(enter_default(gait.character, chosen, record))
            return
        kind = 'steady' if action == 'steady' else terrain
        with files.changing(path) as found:
            name = f'{kind}_{1 + sum(each.rsplit("_", 1)[0] == kind for each in found)}'
            found[name] = {'vector': chosen.tolist(), 'tuning': record}
        print(name, record, flush=True)


if __name__ == '__main__':
    begin_script()
    main()
