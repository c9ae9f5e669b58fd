"""Compares policies trained on terrain with those of flat ground, on the same terrain.

    python examples/compare_transfer.py                  # all that are trained and not yet compared
    python examples/compare_transfer.py PD_Dog2D_Gaps_Terrain-v0

Prints how far either gets, and writes into `trained/transfer.json`: ID -> evaluation of the policy of
flat ground, whose episodes are those of the evaluation in `trained/ID.json`.
"""

from __future__ import annotations

import argparse
import json

import train_all

from trl_suite import catalogue, evaluation, files, policies, resources
from trl_suite.util.program import begin_script


def flat_ground(row: catalogue.Row) -> str:
    """Id of the environment with the same observations on flat ground."""
    figure = '_'.join(row.id.split('_')[:2])
    return f'{figure}_Flat_Terrain-v0' if 'blind' not in row.tags else f'{figure}_Flat-v0'


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('ids', nargs='*', metavar='ID', help='by default all that are missing')
    parser.add_argument('--threads', type=int, default=0, help='0: all cores')
    arguments = parser.parse_args()
    path = resources.directory('trained') / 'transfer.json'
    stored = json.loads(path.read_text()) if path.exists() else {}
    plaid = [row for row in catalogue.ROWS if row.domain == 'plaid' and row.terrain != 'flat']
    for row in plaid:
        named = row.id in arguments.ids if arguments.ids else row.id not in stored
        entry, flat = path.with_name(f'{row.id}.json'), path.with_name(f'{flat_ground(row)}.npz')
        if not named or not entry.exists() or not flat.exists():
            continue
        found = evaluation.evaluate(
            row.id, policies.load(flat), train_all.EPISODES, train_all.SEED, arguments.threads
        )
        runs = json.loads(entry.read_text())
        own = train_all.shipped(runs)['evaluation']
        print(
            f'{row.id}: {own["distance"]:.1f} m, {own["full"]:.0%} complete; that of flat ground '
            f'{found["distance"]:.1f} m, {found["full"]:.0%}',
            flush=True,
        )
        stored[row.id] = found
        with files.replacing(path) as part:
            part.write_text(json.dumps(stored) + '\n')


if __name__ == '__main__':
    begin_script()
    main()
