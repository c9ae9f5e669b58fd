"""Trains shipped policies further in worlds and with sensors that vary, for `trained/randomized`.

    python examples/train_randomized.py                       # all that are missing
    python examples/train_randomized.py Torque_Dog2D_LLC_Imitate_Flat-v0 --overwrite

Each run is `examples/ppo.py` on one thread, with the settings `RANDOMIZED` of `ppo_settings.py`,
starting from the shipped policy. Interrupted runs continue from their checkpoints in RUNS. The policy
with the best score of the learning curve, whose evaluations have the same disturbances, becomes
`trained/randomized/ID.npz`. It and the shipped policy are then evaluated without disturbances
and with the presets `robot`, in the same episodes, and the results are written with settings and curve to
`trained/randomized/ID.json`. The environment variable TRL_SUITE_TRAINED selects another folder
than `trained`.
"""

from __future__ import annotations

import argparse
import json
import os
import pathlib
import platform
import shutil
from typing import Any

import ppo
import ppo_settings
from train_all import SEED, trimmed

from trl_suite import evaluation, policies
from trl_suite.util import errors, files, resources
from trl_suite.util.program import begin_script

EPISODES = 128  # of each of the four evaluations
LONG = 32  # the same for planners, whose steps are whole footsteps
CONDITIONS = {'none': {}, 'robot': {'randomize': 'robot', 'sensors': 'robot'}}


def evaluated(id_: str, policy: policies.Policy) -> dict[str, dict[str, Any]]:
    """Returns the results of a policy under each of the `CONDITIONS`."""
    episodes = LONG if '_HLC_' in id_ else EPISODES
    return {
        name: evaluation.evaluate(id_, policy, episodes, SEED, 1, options)
        for name, options in CONDITIONS.items()
    }


def train(id_: str, seed: int, runs: pathlib.Path) -> dict[str, Any]:
    """Trains, evaluates, and writes policy and results; returns the results."""
    folder = runs / id_ / f'seed_{seed}'
    settings = ppo_settings.randomized_settings_for(id_)
    ppo.train(id_, seed, settings, folder, threads=1)
    policy = trimmed(policies.load(folder / 'policy.npz'))
    entry = {
        **json.loads((folder / 'curve.json').read_text()),
        'machine': f'{os.cpu_count()} cores, {platform.machine()}, {platform.system()}',
        'shipped_at': policy.info['samples'],
        'evaluations': evaluated(id_, policy),
        'before': evaluated(id_, policies.reference(id_)),
    }
    to = resources.directory('trained') / 'randomized'
    to.mkdir(parents=True, exist_ok=True)
    policies.save(policy, to / f'{id_}.npz')
    with files.replacing(to / f'{id_}.json') as part:
        part.write_text(json.dumps(entry) + '\n')
    return entry


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('ids', nargs='*', metavar='ID', default=list(ppo_settings.RANDOMIZED))
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--runs', type=pathlib.Path, default=pathlib.Path('runs/randomized'))
    parser.add_argument('--overwrite', action='store_true', help='repeat runs that are entered')
    arguments = parser.parse_args()
    for id_ in arguments.ids:
        if id_ not in ppo_settings.RANDOMIZED:
            raise ValueError(errors.unknown('environment', id_, ppo_settings.RANDOMIZED))
    for id_ in arguments.ids:
        if arguments.overwrite:
            shutil.rmtree(arguments.runs / id_ / f'seed_{arguments.seed}', ignore_errors=True)
        elif (resources.directory('trained') / 'randomized' / f'{id_}.npz').exists():
            continue
        entry = train(id_, arguments.seed, arguments.runs)
        for name in ('before', 'evaluations'):
            none, robot = (entry[name][each]['return'] for each in CONDITIONS)
            print(f'{id_:40} {name:12} none {none:6.1f}, robot {robot:6.1f}, {robot / none:.2f}')


if __name__ == '__main__':
    begin_script()
    main()
