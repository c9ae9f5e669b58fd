"""Compares learners by their results, as Agarwal et al. (2021) recommend.

Agarwal, Schwarzer, Castro, Courville & Bellemare: Deep Reinforcement Learning at the Edge of the
Statistical Precipice. NeurIPS 2021. The definitions are those of its library rliable; intervals are
from bootstrap samples of the runs of each environment.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from scipy import stats

from trl_suite.benchmark.core import CORE, normalised
from trl_suite.util import tables

REPEATS = 2000  # bootstrap samples
THRESHOLDS = np.linspace(0, 1.2, 25)  # of performance profiles

# Of normalised scores (..., runs, environments).
AGGREGATES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    'iqm': lambda scores: stats.trim_mean(scores.reshape(*scores.shape[:-2], -1), 0.25, axis=-1),
    'median': lambda scores: np.median(scores.mean(-2), -1),  # of the means of environments
    'mean': lambda scores: scores.mean((-2, -1)),
    'optimality_gap': lambda scores: 1 - np.minimum(scores, 1).mean((-2, -1)),
}


def report(results: Iterable[dict[str, Any]]) -> dict[str, Any]:
    """Returns statistics of learners, a dict that can be written as JSON.

    Only environments count that all learners have results of, and of each learner those seeds that
    it has for all these environments. Every estimate is [value, low, high], with the bounds of its
    95 % confidence interval, which is a point if there is one run.

    Args:
      results: complete results of one budget.

    Returns:
      * 'format', 'budget', 'environments', and 'samples' of the points of curves, (20,).
      * 'left_out': environments that only some learners have; 'left_out_runs': number of results of the
        others, with seeds that their learner lacks in one of them.
      * 'learners': by name 'seeds'; 'scores', by environment those after each part of each run, (runs,
        20); the estimates `AGGREGATES` after the run; 'curve', the interquartile mean after each
        part, (20, 3); 'profile', the share of runs with a score above each of `THRESHOLDS`, (25, 3).
      * 'improvement': for pairs of learners 'A, B' the probability that a run of A has a higher score
        than one of B in the same environment.

    Raises:
      ValueError: no results, one of a run that has not ended, results of several budgets or
        lengths of tests, a run that is there twice, or learners without a common environment or seed.
    """
    found: dict[str, dict[tuple[str, int], dict[str, Any]]] = {}
    for result in results:
        if 'metrics' not in result:
            raise ValueError(
                f'the run of {result["learner"]} in {result["environment"]} with seed {result["seed"]} has '
                'not ended'
            )
        runs = found.setdefault(result['learner'], {})
        key = result['environment'], result['seed']
        if key in runs:
            raise ValueError(f'two results of {result["learner"]} in {key[0]} with seed {key[1]}')
        runs[key] = result
    everything = [result for runs in found.values() for result in runs.values()]
    if not everything:
        raise ValueError('no results of runs that have ended')
    for name in ('budget', 'episodes'):
        values = {result[name]: result for result in everything}
        if len(values) != 1:
            each = ', '.join(
                f'{value} ({of["learner"]} in {of["environment"]} with seed {of["seed"]})'
                for value, of in sorted(values.items())
            )
            raise ValueError(f'{name}: {each}; expected the same in all results')
    count = {id: sum(any(key[0] == id for key in runs) for runs in found.values()) for id in CORE}
    ids = [id for id in CORE if count[id] == len(found)]
    if not ids:
        raise ValueError(f'no environment is common to the learners {", ".join(found)}')
    curves, learners, left_out_runs = {}, {}, 0
    for learner, runs in sorted(found.items()):
        seeds = sorted(set.intersection(*({s for i, s in runs if i == id} for id in ids)))
        if not seeds:
            raise ValueError(f'{learner}: no seed is common to {", ".join(ids)}')
        left_out_runs += sum(id in ids and seed not in seeds for id, seed in runs)
        own = np.array([
            [[normalised(id, score) for (score,) in runs[id, seed]['scores']] for id in ids]
            for seed in seeds
        ])  # fmt: skip
        curves[learner] = own  # (runs, environments, parts)
        learners[learner] = {
            'seeds': seeds,
            'scores': {id: own[:, i].tolist() for i, id in enumerate(ids)},
            **_estimates(own),
        }
    budget = everything[0]['budget']
    parts = len(everything[0]['scores'])
    return {
        'format': 'trl_suite report 1',  # other files of a folder are results
        'budget': budget,
        'environments': ids,
        'left_out': [id for id in CORE if 0 < count[id] < len(found)],
        'left_out_runs': left_out_runs,
        'samples': [budget * (part + 1) // parts for part in range(parts)],
        'learners': learners,
        'improvement': {
            f'{a}, {b}': _improvement(curves[a][..., -1], curves[b][..., -1])
            for a, b in itertools.combinations(curves, 2)
        },
    }


def _samples(scores: np.ndarray, seed: int = 0) -> np.ndarray:
    """Returns the scores, and bootstrap samples of the runs of each environment.

    Args:
      scores: (runs, environments, ...).
      seed: seed of the samples.

    Returns:
      (1 + `REPEATS`, runs, environments, ...).
    """
    runs, ids = scores.shape[:2]
    drawn = np.random.default_rng(seed).integers(runs, size=(REPEATS, runs, ids))
    return np.concatenate([scores[None], scores[drawn, np.arange(ids)]])


def _interval(values: np.ndarray) -> list[Any]:
    """Returns the first value and a 95 % confidence interval from the others, (..., 3)."""
    bounds = np.percentile(values[1:], (2.5, 97.5), axis=0)
    return np.stack([values[0], *bounds], -1).tolist()


def _estimates(scores: np.ndarray) -> dict[str, Any]:
    samples = np.moveaxis(_samples(scores), -1, 1)  # (1 + REPEATS, parts, runs, environments)
    last = samples[:, -1]
    profile = np.stack([(last > level).mean((-2, -1)) for level in THRESHOLDS], -1)
    return {
        **{name: _interval(function(last)) for name, function in AGGREGATES.items()},
        'curve': _interval(AGGREGATES['iqm'](samples)),
        'profile': _interval(profile),
    }


def _improvement(a: np.ndarray, b: np.ndarray) -> list[float]:
    """Returns the mean over environments of P(a run of A > one of B); ties count half."""
    first, second = _samples(a)[:, :, None], _samples(b, 1)[:, None]
    return _interval(((first > second) + 0.5 * (first == second)).mean((1, 2, 3)))


def table(found: dict[str, Any]) -> str:
    """Returns the statistics of `report` as tables in Markdown."""
    ids, learners = found['environments'], found['learners']
    several = {learner: len(of['seeds']) > 1 for learner, of in learners.items()}

    def words(values: list[float], digits: int, interval: bool) -> str:
        value, *bounds = (f'{each:.{digits}f}' for each in values)
        return f'{value} ({" to ".join(bounds)})' if interval else value

    title = f'{len(ids)} of {len(CORE)} environments, {found["budget"]:,} samples, 95 % confidence intervals'
    if found['left_out']:
        title += f'; left out, since some learners lack them: {", ".join(found["left_out"])}'
    if found['left_out_runs']:
        title += f'; left out, since their learner lacks the seed in others: {found["left_out_runs"]} runs'
    ranking = [
        (learner, len(of['seeds']), *(words(of[name], 3, several[learner]) for name in AGGREGATES))
        for learner, of in sorted(learners.items(), key=lambda item: -item[1]['iqm'][0])
    ]
    means = [
        (
            f'`{id}`',
            *(f'{np.mean([run[-1] for run in of["scores"][id]]):.3f}' for of in learners.values()),
        )
        for id in ids
    ]
    better = [
        (pair, words(found['improvement'][pair], 2, several[a] or several[b]))
        for a, b in itertools.combinations(learners, 2)
        if (pair := f'{a}, {b}') in found['improvement']
    ]
    return '\n\n'.join((
        title,
        tables.markdown_table(('learner', 'seeds', *AGGREGATES), ranking),
        tables.markdown_table(('environment', *learners), means),
        *([tables.markdown_table(('A, B', 'probability that A is better'), better)] if better else []),
    ))  # fmt: skip
