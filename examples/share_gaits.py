"""Enters a trained gait policy for other terrains of its character, where it does better than what is there.

    python examples/share_gaits.py FSM_Dog2D_Terrain_Mixed-v0 FSM_Dog2D_Terrain_Gaps-v0

Observation and action are the same on all terrains. An environment that has no policy of its own, or a
worse one, gets the policy of the first id if its mean distance lies above the 95 % interval of what
there was: the policy that is shipped, or else the default gait. Writes `trained/shared.json`, from
which `trl_suite.policies.reference` learns whose policy to load: ID -> `policy`, the id that it was
trained for; `evaluation` of it, and `before`, that of what there was.
"""

from __future__ import annotations

import argparse
import json

import train_all

from trl_suite import evaluation, policies
from trl_suite.util import files, resources


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('policy', metavar='ID', help='environment whose policy is tried')
    parser.add_argument('ids', nargs='+', metavar='ID', help='environments in which it is')
    parser.add_argument('--episodes', type=int, default=train_all.GAIT_EPISODES)
    parser.add_argument('--threads', type=int, default=1, help='0: all cores')
    arguments = parser.parse_args()
    path = resources.directory('trained') / policies.SHARED
    for id_ in arguments.ids:
        options = arguments.episodes, train_all.SEED, arguments.threads
        if id_ in policies.available():
            before = evaluation.evaluate(id_, policies.reference(id_), *options)
        else:
            before = evaluation.evaluate(id_, evaluation.zero, *options, factory=True)
        found = evaluation.evaluate(id_, policies.reference(arguments.policy), *options)
        print(
            f'{id_}: {found["distance"]:.1f} m, median {found["median_distance"]:.1f} m; '
            f'before: {before["distance"]:.1f} m, median {before["median_distance"]:.1f} m',
            flush=True,
        )
        if found['distance'] <= before['distance_interval'][1]:
            continue
        shared = json.loads(path.read_text()) if path.exists() else {}
        shared[id_] = {'policy': arguments.policy, 'evaluation': found, 'before': before}
        with files.replacing(path) as part:
            part.write_text(json.dumps(dict(sorted(shared.items()))) + '\n')
        for suffix in ('npz', 'json'):
            path.with_name(f'{id_}.{suffix}').unlink(missing_ok=True)


if __name__ == '__main__':
    main()
