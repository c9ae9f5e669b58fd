"""Comparisons of trainings for the pages of the documentation.

    python training/compare.py actions --seeds 1 2 3 --json docs/data/gait_actions.json
    python training/compare.py changes --seeds 1 2 3 --json docs/data/gait_changes.json
    python training/compare.py hierarchy --seeds 1 2 3 --json docs/data/hierarchy.json \
        --page docs/reports/deeploco.md --picture docs/pictures/hierarchy.png
    python training/compare.py limits --seeds 1 2 3 --samples 5e5 \
        --json docs/data/limits.json --page docs/reports/robustness.md

`actions`: base actions of a gait, changes of the default gait, and both (MACE), with Q-learning and PPO.
`changes`: the selection of base actions by a shipped policy, trained on with PPO, alone and with changes.
`hierarchy`: as Figure 9 of Peng et al. (2017), footstep planning above a trained controller, and control
without hierarchy that starts from a walk, with the same number of control steps; no demonstrations,
curricula or averages of weights. `limits`: actuation models of the biped, trained and evaluated with
realistic torque limits.

Every result is a training with the same number of samples and an evaluation. Finished ones are kept in
the JSON file, and not repeated.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import pathlib
from collections.abc import Callable
from typing import Any, NamedTuple

import evaluate_plans
import learn_gaits
import numpy as np
import pages
import ppo
import refine_gaits
import runs
import settings
import torch
import tqdm

from trl_suite import evaluation, policies, suite
from trl_suite.bodies.reference import CONTROL_TIMESTEP
from trl_suite.util import files, tables
from trl_suite.util.options import checked
from trl_suite.util.program import begin_script

SEED = runs.TEST_SEED  # of evaluations
Results = dict[str, Any]  # 'CELL/SEED' -> result


class Comparison(NamedTuple):
    """What is compared.

    Attributes:
      samples: of each training, by default.
      cells: what is trained with each seed.
      job: (cell, seed, samples, folder) -> result.
      table: (results, seeds) -> Markdown.
      panels: results -> learning curves, see `pages.curves`.
      axis: their x axis.
    """

    samples: float
    cells: tuple[str, ...]
    job: Callable[[str, int, float, pathlib.Path], Any]
    table: Callable[[Results, list[int]], str]
    panels: Callable[[Results], dict[str, dict[str, list[Any]]]]
    axis: str


def of(results: Results, cell: str) -> dict[int, Any]:
    """Returns the results of a cell by seed."""
    pairs = (key.rsplit('/', 1) for key in results)
    return {int(seed): results[f'{cell}/{seed}'] for name, seed in pairs if name == cell}


# Actions of gaits.

MEASURED = 'distance', 'distance_interval', 'median_distance', 'speed'
DOG, ACTION_EPISODES = 'FSM_Dog2D_Terrain_Mixed-v0', 100
ACTIONS = {
    'discrete': 'one of the base actions', 'continuous': 'default gait with changes',
    'both': 'base action with changes (MACE)', 'ppo': 'default gait with changes, PPO',
}  # fmt: skip

# A step is a gait cycle of 0.3 to 0.6 s: few samples, each with much simulation.
CYCLES: dict[str, Any] = {
    'horizon': 16, 'minibatch': 128, 'learning_rate': 1e-4, 'gamma': 0.9, 'initial_std': 0.1,
    'evaluation_episodes': 32,
}  # fmt: skip


def train_actions(action: str, seed: int, cycles: float, folder: pathlib.Path) -> dict[str, Any]:
    """Trains from a new network, without first actions of a shipped policy."""
    common: dict[str, Any] = {'samples': cycles, 'evaluate_every': cycles / 4}
    if action == 'ppo':
        curve = ppo.train(DOG, seed, settings.settings_for(DOG, **CYCLES, **common), folder, 1)
    else:
        own = learn_gaits.Settings(action=action, expert_cycles=0, evaluation_episodes=0, **common)
        curve = learn_gaits.train(DOG, seed, own, folder, 1)
    return measured(DOG, curve, folder)


CHANGED = 'FSM_Dog2D_Terrain_Narrow_Gaps-v0'
CHANGES: dict[str, tuple[str, dict[str, Any]]] = {
    'initial': ('before, in other episodes for each seed', {}),
    'selection': ('selection alone', {}),
    'all': ('the same change for all base actions', {'changes': 'all'}),
    'each': ('a change for each base action', {'changes': 'each'}),
    'less': ('the same for all, noise 0.02', {'changes': 'all', 'noise': 0.02}),
    'more': ('the same for all, noise 0.1', {'changes': 'all', 'noise': 0.1}),
}


def train_changes(cell: str, seed: int, cycles: float, folder: pathlib.Path) -> dict[str, Any]:
    """Trains from one network of the shipped policy; in the first quarter changes alone, if any."""
    shipped, first, own = policies.reference(CHANGED), folder / 'first.npz', CHANGES[cell][1]
    convolution, weights, biases = shipped.networks[0]
    folder.mkdir(parents=True, exist_ok=True)
    initial = dataclasses.replace(shipped, convolution=convolution, weights=weights, biases=biases)
    policies.save(initial, first)
    if cell == 'initial':  # other episodes for each seed: the table shows how much these matter
        found = evaluation.evaluate(CHANGED, initial, ACTION_EPISODES, SEED + seed, 1)
        return {**{key: found[key] for key in MEASURED}, 'curve': [[0, found['distance']]]}
    asked = refine_gaits.settings_for(
        CHANGED, start=str(first), samples=cycles, substeps=1, horizon=32, averaged=2e4,
        changes_first=cycles / 4 if own else 0, evaluate_every=cycles / 8, **own,
    )  # fmt: skip
    return measured(CHANGED, refine_gaits.train(CHANGED, seed, asked, folder, 1), folder)


def measured(id_: str, curve: list[dict[str, Any]], folder: pathlib.Path) -> dict[str, Any]:
    """Returns distances and curve of a training of a gait."""
    found = evaluation.evaluate(id_, policies.load(folder / 'policy.npz'), ACTION_EPISODES, SEED, 1)
    points = [[point['samples'], point['distance']] for point in curve if 'distance' in point]
    return {**{key: found[key] for key in MEASURED}, 'curve': points}


def distance_table(names: dict[str, str], id_: str, results: Results, seeds: list[int]) -> str:
    rows = []
    for cell, name in names.items():
        if done := of(results, cell):
            distances = [f'{done[seed]["distance"]:.0f}' if seed in done else '–' for seed in seeds]
            mean = pages.interval((each['distance'] for each in done.values()), 0)
            speed = np.mean([each['speed'] for each in done.values()])
            rows.append([name, *distances, mean, f'{speed:.1f}'])
    title = (
        f'Distance to the first fall in `{id_}`, mean of {ACTION_EPISODES} episodes, m, and mean of the seeds with '
        "its 95 % interval (Student's t):"
    )
    head = ['action', *(f'seed {seed}' for seed in seeds), 'mean', 'speed, m/s']
    return f'{title}\n\n{tables.markdown_table(head, rows)}'


def distance_panels(names: dict[str, str], results: Results) -> dict[str, dict[str, list[Any]]]:
    def curve(result: dict[str, Any]) -> np.ndarray:
        last = [result['curve'][-1][0], result['distance']]  # of the final policy
        return np.array([*result['curve'], last]) * (1e-3, 1)

    found = {name: list(map(curve, of(results, each).values())) for each, name in names.items()}
    return {'distance to the first fall, m': found}


def of_gaits(cycles: float, id_: str, names: dict[str, str], job: Callable[..., Any]) -> Comparison:
    """Returns a comparison by the distance to the first fall in an environment."""
    table, panels = (functools.partial(f, names) for f in (distance_table, distance_panels))
    return Comparison(
        cycles, tuple(names), job, functools.partial(table, id_), panels, 'cycles, thousand'
    )


# Hierarchy.

TASKS = {  # with and without hierarchy; what counts: key, factor and label
    'trail': ('PD_Biped3D_HLC_PathFollowing-v0', 'PD_Biped3D_Terrain_Trail_Hard-v0',
              'trail', 1, 'median distance along the trail in 200 s, m'),
    'soccer': ('PD_Biped3D_HLC_Soccer-v0', 'PD_Biped3D_Terrain_Soccer_Hard-v0',
               'at_goal', 100, 'time with the ball at its goal, %'),
}  # fmt: skip
KINDS = ('with hierarchy', 'without')
SCRATCH: dict[str, Any] = {'stages': (), 'averaged': 0.0, 'stages_averaged': 1}
OWN: tuple[dict[str, Any], ...] = (
    {'start': '', 'activation': 'tanh', 'convolutions': ()},
    settings.FROM_A_WALK,
)
QUARTERS, HIERARCHY_EPISODES = 4, 32


def train_hierarchy(
    cell: str, seed: int, control_steps: float, folder: pathlib.Path
) -> list[dict[str, Any]]:
    """Trains, and evaluates the policy after every quarter of the control steps of 1/30 s."""
    task, kind = cell.split('/')
    id_, own = TASKS[task][KINDS.index(kind)], OWN[KINDS.index(kind)]
    each = suite.make(id_).control_timestep() / CONTROL_TIMESTEP  # control steps of a sample
    torch.set_num_threads(1)
    folder.mkdir(parents=True, exist_ok=True)
    trainer = ppo.Trainer(
        id_, seed, settings.settings_for(id_, **SCRATCH, **own, samples=control_steps / each), 1
    )
    result = []
    for i in range(QUARTERS):
        while trainer.samples * each < control_steps * (i + 1) / QUARTERS:
            trainer.learn(trainer.collect())
        path = folder / f'quarter_{i + 1}.npz'
        policies.save(trainer.exported(), path)
        policy = policies.load(path)  # as its digest names it
        found = evaluate_plans.run(id_, lambda _, p=policy: p, HIERARCHY_EPISODES, SEED)
        result.append({'control_steps': round(trainer.samples * each), **found})
    trainer.environments.close()
    return result


def hierarchy_table(results: Results, seeds: list[int]) -> str:
    counts = sorted({run[-1]['episodes'] for run in results.values()})
    episodes = ' or '.join(map(str, counts))
    rows = []
    for task, (*_, name, factor, label) in TASKS.items():
        for kind in KINDS:
            done = {seed: run[-1] for seed, run in of(results, f'{task}/{kind}').items()}
            if done:
                cells = [f'{factor * done[s][name]:.1f}' if s in done else '–' for s in seeds]
                mean = pages.interval((factor * last[name] for last in done.values()), 1)
                minutes = (f'{done[s]["survived_minute"]:.0%}' if s in done else '–' for s in seeds)
                rows.append([f'{task}, {kind}: {label}', *cells, mean, ' '.join(minutes)])
    head = ['task', *(f'seed {seed}' for seed in seeds), 'mean', 'no fall in a minute, each seed']
    title = f"{episodes} episodes of 200 s; mean of the seeds with its 95 % interval (Student's t):"
    return f'{title}\n\n{tables.markdown_table(head, rows)}'


def hierarchy_panels(results: Results) -> dict[str, dict[str, list[Any]]]:
    return {
        f'{task}: {label}': {
            kind: [
                [[point['control_steps'] / 1e6, factor * point[name]] for point in run]
                for run in of(results, f'{task}/{kind}').values()
            ]
            for kind in KINDS
        }
        for task, (*_, name, factor, label) in TASKS.items()
    }


# Torque limits.

MODELS = {'position': 'PD', 'torque': 'Torque', 'velocity': 'Vel', 'muscle': 'MTU'}
REAL = {'torque_speed': True, 'torque_pose': True}
LIMITS: dict[str, dict[str, Any]] = {
    'ideal': {}, 'realistic': REAL, 'realistic, half strength': {**REAL, 'strength': 0.5},
}  # fmt: skip
LIMIT_EPISODES = 50


def limited(model: str, limits: str) -> dict[str, Any]:
    """Returns the options of the task; muscles have curves of their own, only their strength differs."""
    own = LIMITS[limits]
    if model == 'muscle':
        own = {name: value for name, value in own.items() if name not in REAL}
    return {'actuators': own} if own else {}


def train_limits(cell: str, seed: int, samples: float, folder: pathlib.Path) -> dict[str, Any]:
    model, limits = cell.split('/')
    id_, given = f'{MODELS[model]}_Biped2D_LLC_Imitate_Flat-v0', limited(model, limits)
    own = settings.settings_for(
        id_,
        samples=samples,
        stages=((0.0, given),),
        evaluated_with=given,
        evaluate_every=samples / 5,
    )
    curve = ppo.train(id_, seed, own, folder, threads=1, progress=False)
    policy = policies.load(folder / 'policy.npz')
    found = evaluation.evaluate(id_, policy, LIMIT_EPISODES, SEED, 1, given)
    keys = 'return', 'return_interval', 'normalized_return', 'completion_rate', 'distance'
    points = [[point['samples'], point['normalized_return']] for point in curve]
    return {**{key: found[key] for key in keys}, 'curve': points}


def limit_table(results: Results, seeds: list[int]) -> str:
    def cell(model: str, limits: str) -> str:
        done = of(results, f'{model}/{limits}') or (
            of(results, f'{model}/ideal') if not limited(model, limits) else {}
        )
        return pages.interval((each['normalized_return'] for each in done.values()), 2)

    title = (
        f'Return divided by its maximum, mean of {LIMIT_EPISODES} episodes; mean of the seeds with its '
        "95 % interval (Student's t):"
    )
    rows = ([limits, *(cell(model, limits) for model in MODELS)] for limits in LIMITS)
    return f'{title}\n\n{tables.markdown_table(["torque limits", *MODELS], rows)}'


def limit_panels(results: Results) -> dict[str, dict[str, list[Any]]]:
    return {
        limits: {
            model: [
                np.array(each['curve']) * (1e-6, 1)
                for each in of(results, f'{model}/{limits}').values()
            ]
            for model in MODELS
        }
        for limits in LIMITS
    }


COMPARISONS = {
    'actions': of_gaits(32768, DOG, ACTIONS, train_actions),
    'changes': of_gaits(
        65536, CHANGED, {cell: name for cell, (name, _) in CHANGES.items()}, train_changes
    ),
    'hierarchy': Comparison(
        1.2e6, tuple(f'{task}/{kind}' for task in TASKS for kind in KINDS), train_hierarchy,
        hierarchy_table, hierarchy_panels, 'control steps, million',
    ),
    'limits': Comparison(
        2.5e5,
        tuple(
            f'{model}/{limits}' for limits in LIMITS for model in MODELS
            if limits == 'ideal' or limited(model, limits)
        ),
        train_limits, limit_table, limit_panels, 'samples, million',
    ),
}  # fmt: skip


def described(compared: Comparison, found: dict[str, Any]) -> str:
    """Returns the content of a JSON file as Markdown."""
    seeds = sorted({int(key.rsplit('/', 1)[1]) for key in found['results']})
    unit = compared.axis.partition(',')[0]
    text = f'After {found["samples"]:,.0f} {unit}, seeds {", ".join(map(str, seeds))}. '
    return text + compared.table(found['results'], seeds)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('comparison', choices=COMPARISONS)
    parser.add_argument('--seeds', type=int, nargs='+', default=[1])
    parser.add_argument('--samples', type=float, help='of each training, instead of the default')
    parser.add_argument('--runs', type=pathlib.Path, default=pathlib.Path('runs'))
    parser.add_argument('--json', type=pathlib.Path, help='default: RUNS/COMPARISON.json')
    parser.add_argument('--page', type=pathlib.Path, help='a page whose table is replaced')
    parser.add_argument('--picture', type=pathlib.Path, help='a .png for the learning curves')
    arguments = parser.parse_args()
    name, compared = arguments.comparison, COMPARISONS[arguments.comparison]
    samples = compared.samples if arguments.samples is None else arguments.samples
    checked('--samples', samples, float, above=0)
    runs.check_seeds('--seeds', *arguments.seeds)
    path = arguments.json or arguments.runs / f'{name}.json'
    start: dict[str, Any] = {'samples': samples, 'results': {}}
    with files.changing(path, start) as found:
        pass  # what there is
    jobs = [(cell, seed) for seed in arguments.seeds for cell in compared.cells]
    for cell, seed in tqdm.tqdm(jobs, unit='run'):
        if f'{cell}/{seed}' not in found['results']:
            folder = arguments.runs / f'{name}_{samples:g}' / cell / f'seed_{seed}'
            result = compared.job(cell, seed, samples, folder)
            with files.changing(path, start) as found:
                found['results'][f'{cell}/{seed}'] = result
    print(text := described(compared, found))
    if arguments.picture is not None:
        pages.curves(arguments.picture, compared.panels(found['results']), compared.axis)
    if arguments.page is not None:
        files.replace_between(arguments.page, name, 'training/compare.py', text)


if __name__ == '__main__':
    begin_script()
    main()
