"""Compares trained gait policies with the default gait, on the same terrain.

    python training/compare_gaits.py                          # all of them, from trained/
    python training/compare_gaits.py FSM_Dog2D_Terrain_Mixed-v0 --policy policy.npz

Prints the distance before a fall of both. The results of a shipped policy are read from
`trained/ID.json`; the default gait runs in the same episodes, and its evaluation is written to
`trained/default_gaits.json`: ID -> evaluation.
"""

from __future__ import annotations

import argparse
import json
import pathlib
from typing import Any

import numpy as np
import train_all

from trl_suite import evaluation, policies
from trl_suite.util import files, resources
from trl_suite.util.program import begin_script


def line(name: str, found: dict[str, Any]) -> str:
    low, median, high = np.percentile(found['distances'], (25, 50, 75))
    return f'  {name:12} {median:6.1f} m ({low:.1f} to {high:.1f}), mean {found["distance"]:.1f} m'


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('ids', nargs='*', metavar='ID', help='all of those that are trained')
    parser.add_argument('--policy', type=pathlib.Path, help='an .npz; nothing is written')
    parser.add_argument('--threads', type=int, default=0, help='0: all cores')
    arguments = parser.parse_args()
    path = resources.directory('trained') / 'default_gaits.json'
    stored = json.loads(path.read_text()) if path.exists() else {}
    episodes = train_all.GAIT_EPISODES, train_all.SEED, arguments.threads
    for id_ in arguments.ids or train_all.GAITS:
        if arguments.policy is None and not path.with_name(f'{id_}.json').exists():
            print(f'{id_}: no policy')
            continue
        print(
            f'{id_}: median distance (quartiles) of {train_all.GAIT_EPISODES} episodes', flush=True
        )
        default = evaluation.evaluate(id_, evaluation.zero, *episodes, factory=True)
        print(line('default gait', default), flush=True)
        if arguments.policy is None:
            entry = json.loads(path.with_name(f'{id_}.json').read_text())
            own = train_all.shipped(entry)['evaluation']
        else:
            own = evaluation.evaluate(id_, policies.load(arguments.policy), *episodes)
        ratio = np.median(own['distances']) / np.median(default['distances'])
        print(f'{line("policy", own)}; {ratio:.1f} times', flush=True)
        stored[id_] = default
        if arguments.policy is None:
            with files.replacing(path) as part:
                part.write_text(json.dumps(stored) + '\n')


if __name__ == '__main__':
    begin_script()
    main()
