"""Compares what PPO can improve of a policy of a gait: its selection, changes of the base actions, or both.

    python examples/compare_changes.py                                     # one seed
    python examples/compare_changes.py --seeds 1 2 3 --kinds selection all each
    python examples/compare_changes.py --cycles 1e6 --json runs/changes_1e6.json

Every result is a run of `refine_gaits.py` with the same number of cycles, which begins with a shipped
policy. The policy is then evaluated in episodes without a limit of distance. Finished runs are kept in
the JSON file and not repeated; with more cycles, and another file, they continue.
"""

from __future__ import annotations

import functools
import pathlib
from typing import Any

import compare_actions
import comparisons
import numpy as np
import refine_gaits

from trl_suite.util.program import begin_script

ID = 'FSM_Dog2D_Terrain_Narrow_Gaps-v0'
EPISODES, SEED = 200, 63  # another seed than that of the shipped policies' results
NAMES = {
    'selection': 'selection alone', 'fixed': 'one change of all base actions alone',
    'all': 'selection, and one change of all base actions',
    'each': 'selection, and a change of each base action',
    'all_0.02': 'one change, noise of 0.02', 'all_0.1': 'one change, noise of 0.1',
}  # fmt: skip
# The rates are constant, so that runs can continue.
COMMON: dict[str, Any] = {
    'start': 'FSM_Dog2D_Terrain_Slopes_Mixed-v0', 'num_envs': 64, 'horizon': 32, 'minibatch': 512,
    'learning_rate': 2e-5, 'last_learning_rate': 2e-5, 'kl': 0.0225, 'retry': 0.7,
    'averaged': 16384.0, 'value_first': 2, 'write_every': 8192, 'evaluate_every': 8192,
    'changes': 'all', 'changes_first': 16384,
}  # fmt: skip
OWN: dict[str, dict[str, Any]] = {
    'selection': {'changes': '', 'changes_first': 0}, 'fixed': {'changes_first': np.inf}, 'all': {},
    'each': {'changes': 'each'}, 'all_0.02': {'noise': 0.02}, 'all_0.1': {'noise': 0.1},
}  # fmt: skip
_MARKS = '<!-- changes, written by examples/compare_changes.py -->', '<!-- /changes -->'


def train(kind: str, seed: int, cycles: float, runs: pathlib.Path) -> dict[str, Any]:
    """Trains and evaluates one policy."""
    folder = runs / kind / f'seed_{seed}'
    settings = refine_gaits.Settings(**{**COMMON, **OWN[kind], 'samples': cycles})
    curve = refine_gaits.train(ID, seed, settings, folder, 1)
    return compare_actions.evaluated(ID, folder, curve, EPISODES, SEED)


def main() -> None:
    parser = comparisons.parser(__doc__.splitlines()[0], [1], 'runs/changes.json')
    parser.add_argument('--cycles', type=float, default=32768)
    parser.add_argument('--kinds', nargs='+', choices=NAMES, default=list(NAMES))
    parser.add_argument('--runs', type=pathlib.Path, default=pathlib.Path('runs/changes'))
    arguments = parser.parse_args()
    jobs = {
        f'{kind}/{seed}': functools.partial(train, kind, seed, arguments.cycles, arguments.runs)
        for seed in arguments.seeds for kind in arguments.kinds
    }  # fmt: skip
    found = comparisons.complete(arguments.json, {'id': ID, 'cycles': arguments.cycles}, jobs)
    table = functools.partial(compare_actions.table, names=NAMES, episodes=EPISODES)
    plot = functools.partial(compare_actions.plot, names=NAMES)
    comparisons.show(found, table, plot, _MARKS, arguments)


if __name__ == '__main__':
    begin_script()
    main()
