"""Compares actuation models of the biped under realistic torque limits, each trained with these limits.

    python training/compare_limits.py                             # one seed, few samples
    python training/compare_limits.py --seeds 1 2 3 --samples 1e6  # 36 runs
    python training/compare_limits.py --page docs/reports/robustness.md

Every cell is a run of `ppo.py` with the settings of the environment, except for the number of samples, which
is the same for all, and the limits, which hold in training and evaluation. Finished cells are kept in
the JSON file and not repeated.
"""

from __future__ import annotations

import argparse
import json
import pathlib
from typing import Any

import numpy as np
import ppo
import ppo_settings
import tqdm

from trl_suite import evaluation, policies
from trl_suite.util import files
from trl_suite.util.program import begin_script

MODELS = {'position': 'PD', 'torque': 'Torque', 'velocity': 'Vel', 'muscle': 'MTU'}
ID = '{}_Biped2D_LLC_Imitate_Flat-v0'
REAL = {'torque_speed': True, 'torque_pose': True}
# Muscles have curves of their own; only their strength differs.
LIMITS: dict[str, dict[str, Any]] = {
    'ideal': {}, 'realistic': REAL, 'realistic, half strength': {**REAL, 'strength': 0.5},
}  # fmt: skip
EPISODES, SEED = 50, 0
_MARK, _END = '<!-- limits, written by training/compare_limits.py -->', '<!-- /limits -->'


def options(model: str, limits: str) -> dict[str, Any]:
    """Returns the options of the task for an actuation model and limits."""
    own = LIMITS[limits]
    if model == 'muscle':
        own = {name: value for name, value in own.items() if name not in REAL}
    return {'actuators': own} if own else {}


def train(model: str, limits: str, seed: int, samples: float, runs: pathlib.Path) -> dict[str, Any]:
    """Trains and evaluates one cell."""
    id_, given = ID.format(MODELS[model]), options(model, limits)
    settings = ppo_settings.settings_for(
        id_, samples=samples, stages=((0.0, given),), evaluated_with=given,
        evaluate_every=samples / 5,
    )  # fmt: skip
    name = '_'.join(limits.replace(',', '').split())
    folder = runs / f'{model}_{name}_{samples:g}' / f'seed_{seed}'
    curve = ppo.train(id_, seed, settings, folder, threads=1, progress=False)
    policy = policies.load(folder / 'policy.npz')
    found = evaluation.evaluate(id_, policy, EPISODES, SEED, 1, given)
    keys = 'return', 'return_interval', 'normalized_return', 'completion_rate', 'distance'
    return {
        **{key: found[key] for key in keys},
        'curve': [[point['samples'], point['normalized_return']] for point in curve],
    }


def table(found: dict[str, Any]) -> str:
    """Returns the results as Markdown."""
    seeds = sorted({int(key.rsplit('/', 1)[1]) for key in found['results']})
    lines = [
        f'Return divided by its maximum, after {found["samples"] / 1e6:g} M samples, mean over {EPISODES} episodes; '
        f'seeds {", ".join(map(str, seeds))}:',
        '',
        '| torque limits | ' + ' | '.join(MODELS) + ' |',
        '| --- ' * (1 + len(MODELS)) + '|',
    ]
    for limits in LIMITS:
        cells = []
        for model in MODELS:
            values = [
                found['results'][key]['normalized_return']
                for seed in seeds
                if (key := f'{model}/{limits}/{seed}') in found['results']
            ]
            text = f'{np.mean(values):.2f}' if values else '–'
            cells.append(text + (f' ± {np.std(values):.2f}' if len(values) > 1 else ''))
        lines.append(f'| {limits} | ' + ' | '.join(cells) + ' |')
    return '\n'.join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--seeds', type=int, nargs='+', default=[1])
    parser.add_argument('--samples', type=float, default=2.5e5)
    parser.add_argument('--runs', type=pathlib.Path, default=pathlib.Path('runs/limits'))
    parser.add_argument('--json', type=pathlib.Path, default=pathlib.Path('runs/limits.json'))
    parser.add_argument('--page', type=pathlib.Path, help='a page whose table is replaced')
    arguments = parser.parse_args()
    found: dict[str, Any] = {'samples': arguments.samples, 'results': {}}
    if arguments.json.exists():
        found = json.loads(arguments.json.read_text())
        if found['samples'] != arguments.samples:
            raise ValueError(
                f'{arguments.json} has {found["samples"]:g} samples; give another --json'
            )
    jobs = [
        (model, limits, seed) for seed in arguments.seeds for limits in LIMITS for model in MODELS
    ]
    for model, limits, seed in tqdm.tqdm(jobs, unit='run'):
        key = f'{model}/{limits}/{seed}'
        if key in found['results']:
            continue
        same = [
            f'{model}/{other}/{seed}'
            for other in LIMITS
            if options(model, other) == options(model, limits)
        ]
        done = next((found['results'][each] for each in same if each in found['results']), None)
        found['results'][key] = done or train(
            model, limits, seed, arguments.samples, arguments.runs
        )
        files.write_json(found, arguments.json)
    text = table(found)
    print(text)
    if arguments.page is not None:
        files.replace_between(arguments.page, _MARK, _END, text)


if __name__ == '__main__':
    begin_script()
    main()
