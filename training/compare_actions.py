"""Compares base actions of a gait, changes of the default gait, and both (MACE), with Q-learning and PPO.

    python training/compare_actions.py                     # one seed
    python training/compare_actions.py --seeds 1 2 3 --json benchmarks/gait_actions.json
    python training/compare_actions.py --seeds 1 2 3 --json benchmarks/gait_actions.json \
        --page docs/reports/terrain_adaptive_gaits.md --picture docs/pictures/gait_actions.png

Every result is a run with the same number of cycles: of `learn_gaits.py` with its default settings and
random first actions instead of those of a shipped policy, or of `ppo.py`. The policy is then evaluated
in episodes without a limit of distance. Finished runs are kept in the JSON file and not repeated.
"""

from __future__ import annotations

import functools
import pathlib
from collections.abc import Mapping
from typing import Any

import comparisons
import learn_gaits
import numpy as np
import ppo
import ppo_settings

from trl_suite import evaluation, policies
from trl_suite.util import files
from trl_suite.util.program import begin_script

ID = 'FSM_Dog2D_Terrain_Mixed-v0'
EPISODES, SEED = 100, 0
PPO = 'ppo'
NAMES = {
    'discrete': 'one of the base actions', 'continuous': 'default gait with changes',
    'both': 'base action with changes (MACE)', PPO: 'default gait with changes, PPO',
}  # fmt: skip
_MARKS = '<!-- actions, written by training/compare_actions.py -->', '<!-- /actions -->'


def train(id_: str, action: str, seed: int, cycles: float, runs: pathlib.Path) -> dict[str, Any]:
    """Trains and evaluates one policy."""
    folder = runs / f'{id_}_{action}_{cycles:g}' / f'seed_{seed}'
    common: dict[str, Any] = {'samples': cycles, 'evaluate_every': cycles / 4}
    if action == PPO:
        settings = ppo_settings.settings_for(id_, **common)
        curve = ppo.train(id_, seed, settings, folder, 1)
    else:
        settings = learn_gaits.Settings(
            action=action, expert_cycles=0, evaluation_episodes=0, **common
        )
        curve = learn_gaits.train(id_, seed, settings, folder, 1)
    return evaluated(id_, folder, curve, EPISODES, SEED)


def evaluated(
    id_: str, folder: pathlib.Path, curve: list[dict[str, Any]], episodes: int, seed: int
) -> dict[str, Any]:
    """Returns the results of the policy of a run, and its learning curve."""
    found = evaluation.evaluate(id_, policies.load(folder / 'policy.npz'), episodes, seed, 1)
    keys = 'distance', 'distance_interval', 'median_distance', 'speed'
    return {
        **{key: found[key] for key in keys},
        'curve': [[p['samples'], p['distance']] for p in curve if 'distance' in p],
    }


def table(found: dict[str, Any], names: Mapping[str, str] = NAMES, episodes: int = EPISODES) -> str:
    """Returns the results as Markdown; `names` are those of the kinds of actions."""
    results = found['results']
    seeds = sorted({int(key.rsplit('/', 1)[1]) for key in results})
    lines = [
        f'Distance to the first fall in `{found["id"]}` after {found["cycles"]:g} cycles, mean of {episodes} '
        f'episodes, m; seeds {", ".join(map(str, seeds))}:',
        '',
        '| action | ' + ' | '.join(f'seed {seed}' for seed in seeds) + ' | mean | speed, m/s |',
        '| --- ' * (3 + len(seeds)) + '|',
    ]
    for action, name in names.items():
        of_seeds = [results.get(f'{action}/{seed}') for seed in seeds]
        done = [each for each in of_seeds if each is not None]
        if not done:
            continue
        cells = [f'{each["distance"]:.0f}' if each else '–' for each in of_seeds]
        for key, digits in (('distance', 0), ('speed', 1)):
            cells.append(f'{np.mean([each[key] for each in done]):.{digits}f}')
        lines.append(f'| {name} | ' + ' | '.join(cells) + ' |')
    return '\n'.join(lines)


def plot(found: dict[str, Any], path: pathlib.Path, names: Mapping[str, str] = NAMES) -> None:
    """Draws the learning curves; a last point, joined by a dotted line, is the final policy."""
    import matplotlib

    matplotlib.use('Agg')
    from matplotlib import pyplot

    figure, axis = pyplot.subplots(figsize=(8, 4))
    for colour, (action, name) in zip(pyplot.get_cmap('tab10').colors, names.items(), strict=False):
        runs = [run for key, run in found['results'].items() if key.split('/')[0] == action]
        for run in runs:
            cycles, distance = np.array(run['curve']).T
            label = name if run is runs[0] else None
            axis.plot(cycles / 1e3, distance, color=colour, label=label)
            end = [distance[-1], run['distance']]
            axis.plot([found['cycles'] / 1e3] * 2, end, ':', color=colour)
            axis.plot(found['cycles'] / 1e3, end[1], 'o', color=colour)
    axis.set_xlabel('cycles, thousand')
    axis.set_ylabel('distance to the first fall, m')
    axis.set_xlim(left=0)
    axis.set_ylim(bottom=0)
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8)
    figure.tight_layout()
    with files.replacing(path) as part:
        figure.savefig(part, dpi=80, format='png')
    pyplot.close(figure)


def main() -> None:
    parser = comparisons.parser(__doc__.splitlines()[0], [1], 'runs/actions.json')
    parser.add_argument('--cycles', type=float, default=32768)
    parser.add_argument('--runs', type=pathlib.Path, default=pathlib.Path('runs/actions'))
    arguments = parser.parse_args()
    jobs = {
        f'{action}/{seed}': functools.partial(
            train, ID, action, seed, arguments.cycles, arguments.runs
        )
        for seed in arguments.seeds for action in NAMES
    }  # fmt: skip
    found = comparisons.complete(arguments.json, {'id': ID, 'cycles': arguments.cycles}, jobs)
    comparisons.show(found, table, plot, _MARKS, arguments)


if __name__ == '__main__':
    begin_script()
    main()
