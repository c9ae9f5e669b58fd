"""Compares footstep planning above a trained controller with control without hierarchy, at equal cost.

    python training/compare_hierarchy.py --seeds 1                  # one seed
    python training/compare_hierarchy.py --json benchmarks/hierarchy.json \
        --page docs/reports/deeploco.md --picture docs/pictures/hierarchy.png

As Figure 9 of Peng et al. (2017), for the trail and for soccer: PPO with the same number of control
steps of 1/30 s. A policy with hierarchy plans two footsteps, about every 15 control steps; its network
is new, and action 0 walks straight on. A policy without hierarchy sets the joint targets of every
control step and starts from the walk of `PD_Biped3D_Imitate-v0`. At every quarter of the training the
policy is saved in RUNS and evaluated in episodes of 200 s. Finished runs are kept in the JSON file and
not repeated.
"""

from __future__ import annotations

import dataclasses
import functools
import pathlib
from typing import Any

import comparisons
import evaluate_plans
import numpy as np
import ppo
import ppo_settings
import torch

from trl_suite import policies, suite
from trl_suite.tasks.task import CONTROL_TIMESTEP
from trl_suite.util import files
from trl_suite.util.program import begin_script

TASKS = {  # with and without hierarchy
    'trail': ('PD_Biped3D_HLC_PathFollowing-v0', 'PD_Biped3D_Terrain_Trail_Hard-v0'),
    'soccer': ('PD_Biped3D_HLC_Soccer-v0', 'PD_Biped3D_Terrain_Soccer_Hard-v0'),
}
MEASURES = {  # key, factor and label of what counts in each task
    'trail': ('trail', 1, 'median distance along the trail in 200 s, m'),
    'soccer': ('at_goal', 100, 'time with the ball at its goal, %'),
}
KINDS = ('with hierarchy', 'without')
# Both learn from scratch or from a walk only: no demonstrations, curricula or averages of weights.
COMMON: dict[str, Any] = {'stages': (), 'averaged': 0.0, 'stages_averaged': 1}
OWN: tuple[dict[str, Any], ...] = (
    {'start': '', 'activation': 'tanh', 'convolutions': ()}, ppo_settings.FROM_A_WALK,
)  # fmt: skip
QUARTERS = 4
EPISODES, SEED = 32, 0
_MARKS = '<!-- hierarchy, written by training/compare_hierarchy.py -->', '<!-- /hierarchy -->'


def train(
    task: str, kind: int, seed: int, control_steps: float, folder: pathlib.Path
) -> list[pathlib.Path]:
    """Trains one policy; returns the files of its state after every quarter of the training.

    Files of an earlier training in the folder are returned without another one.
    """
    torch.set_num_threads(1)
    found = [folder / f'quarter_{i + 1}.npz' for i in range(QUARTERS)]
    if all(path.exists() for path in found):
        return found
    id_ = TASKS[task][kind]
    folder.mkdir(parents=True, exist_ok=True)
    trainer = ppo.Trainer(id_, seed, ppo_settings.settings_for(id_, **COMMON, **OWN[kind]), 1)
    each = trainer.environments.control_timestep / CONTROL_TIMESTEP  # control steps of a sample
    trainer.settings = dataclasses.replace(trainer.settings, samples=control_steps / each)
    for i, path in enumerate(found):
        while trainer.samples * each < control_steps * (i + 1) / QUARTERS:
            trainer.learn(trainer.collect())
        policies.save(trainer.exported(), path)
    trainer.environments.close()
    return found


def evaluate(id_: str, path: pathlib.Path) -> dict[str, Any]:
    """Evaluates a policy, and returns the result with the control steps of its training."""
    policy = policies.load(path)
    each = suite.make(id_).control_timestep() / CONTROL_TIMESTEP
    result = evaluate_plans.run(id_, lambda _: policy, EPISODES, SEED)
    return {'control_steps': round(policy.info['samples'] * each), **result}


def job(
    task: str, kind: int, seed: int, control_steps: float, runs: pathlib.Path
) -> list[dict[str, Any]]:
    """Trains and evaluates one policy; returns its evaluations after every quarter."""
    folder = runs / f'{control_steps:.0f}' / TASKS[task][kind] / f'seed_{seed}'
    paths = train(task, kind, seed, control_steps, folder)
    return [evaluate(TASKS[task][kind], path) for path in paths]


def table(found: dict[str, Any]) -> str:
    """Returns the results after the training as Markdown."""
    results = found['results']
    seeds = sorted({int(key.rsplit('/', 1)[1]) for key in results})
    lines = [
        f'After {found["control_steps"] / 1e6:g} million control steps, {EPISODES} episodes of 200 s; seeds '
        f'{", ".join(map(str, seeds))}:',
        '',
        '| task | '
        + ' | '.join(f'seed {seed}' for seed in seeds)
        + ' | mean | no fall in a minute |',
        '| --- |' + ' --: |' * (len(seeds) + 2),
    ]
    for task, (name, factor, label) in MEASURES.items():
        for kind in KINDS:
            runs = [results.get(f'{task}/{kind}/{seed}') for seed in seeds]
            done = [run[-1] for run in runs if run]
            if not done:
                continue
            cells = [f'{factor * run[-1][name]:.1f}' if run else '–' for run in runs]
            cells.append(f'{factor * np.mean([last[name] for last in done]):.1f}')
            cells.append(f'{np.mean([last["survived_minute"] for last in done]):.0%}')
            lines.append(f'| {task}, {kind}: {label} | ' + ' | '.join(cells) + ' |')
    return '\n'.join(lines)


def plot(found: dict[str, Any], path: pathlib.Path) -> None:
    """Draws the results over the number of control steps."""
    import matplotlib

    matplotlib.use('Agg')
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, len(TASKS), figsize=(9, 3.5))
    for axis, (task, (name, factor, label)) in zip(axes, MEASURES.items(), strict=True):
        for kind, colour in zip(KINDS, pyplot.get_cmap('tab10').colors, strict=False):
            runs = [
                run for key, run in found['results'].items() if key.startswith(f'{task}/{kind}/')
            ]
            for run in runs:
                steps = [point['control_steps'] / 1e6 for point in run]
                values = [factor * point[name] for point in run]
                axis.plot(steps, values, 'o-', color=colour, label=kind if run is runs[0] else None)
        axis.set_title(task)
        axis.set_xlabel('control steps, million')
        axis.set_ylabel(label)
        axis.set_xlim(left=0)
        axis.set_ylim(bottom=0)
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize=8)
    figure.tight_layout()
    with files.replacing(path) as part:
        figure.savefig(part, dpi=80, format='png')
    pyplot.close(figure)


def main() -> None:
    parser = comparisons.parser(__doc__.splitlines()[0], [1, 2, 3], 'runs/hierarchy.json')
    parser.add_argument('--tasks', nargs='+', choices=TASKS, default=list(TASKS))
    parser.add_argument('--control-steps', type=float, default=1.2e6)
    parser.add_argument(
        '--runs', type=pathlib.Path, default=pathlib.Path('runs/hierarchy'),
        help='a folder for the policies',
    )  # fmt: skip
    arguments = parser.parse_args()
    jobs = {
        f'{task}/{name}/{seed}': functools.partial(
            job, task, kind, seed, arguments.control_steps, arguments.runs
        )
        for seed in arguments.seeds
        for task in arguments.tasks
        for kind, name in enumerate(KINDS)
    }
    head = {'control_steps': arguments.control_steps}
    found = comparisons.complete(arguments.json, head, jobs)
    comparisons.show(found, table, plot, _MARKS, arguments)


if __name__ == '__main__':
    begin_script()
    main()
