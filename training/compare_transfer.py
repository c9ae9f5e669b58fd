"""Compares policies trained on terrain with policies trained on flat ground, on the same terrain.

    python training/compare_transfer.py                  # all that are trained and not yet compared
    python training/compare_transfer.py PD_Dog2D_Gaps_Terrain-v0

Prints the distances of both, and writes `trained/transfer.json`: ID -> evaluation of the policy of
flat ground, in the same episodes as the evaluation in `trained/ID.json`.
"""

from __future__ import annotations

import argparse
import json

import train_all

from trl_suite import evaluation, policies
from trl_suite.registry import catalogue
from trl_suite.util import files, resources
from trl_suite.util.program import begin_script


def flat_ground(spec: catalogue.EnvSpec) -> str:
    """Returns the id of the environment with the same observation on flat ground."""
    figure = '_'.join(spec.id.split('_')[:2])
    return f'{figure}_Flat_Terrain-v0' if 'blind' not in spec.tags else f'{figure}_Flat-v0'


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('ids', nargs='*', metavar='ID', help='by default all that are missing')
    parser.add_argument('--threads', type=int, default=0, help='0: all cores')
    arguments = parser.parse_args()
    path = resources.directory('trained') / 'transfer.json'
    stored = json.loads(path.read_text()) if path.exists() else {}
    plaid = [spec for spec in catalogue.SPECS if spec.domain == 'plaid' and spec.terrain != 'flat']
    for spec in plaid:
        named = spec.id in arguments.ids if arguments.ids else spec.id not in stored
        entry, flat = path.with_name(f'{spec.id}.json'), path.with_name(f'{flat_ground(spec)}.npz')
        if not named or not entry.exists() or not flat.exists():
            continue
        found = evaluation.evaluate(
            spec.id, policies.load(flat), train_all.EPISODES, train_all.SEED, arguments.threads
        )
        runs = json.loads(entry.read_text())
        own = train_all.shipped(runs)['evaluation']
        print(
            f'{spec.id}: {own["distance"]:.1f} m, {own["completion_rate"]:.0%} complete; that of flat ground '
            f'{found["distance"]:.1f} m, {found["completion_rate"]:.0%}',
            flush=True,
        )
        stored[spec.id] = found
        with files.replacing(path) as part:
            part.write_text(json.dumps(stored) + '\n')


if __name__ == '__main__':
    begin_script()
    main()
