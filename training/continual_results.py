"""Writes the results of docs/continual_learning.md from the files in docs/continual/.

    python training/continual_results.py [--check]

docs/continual/SEQUENCE/ contains one file per run, written by `trl-suite sequences run`. With --check
nothing is written, and the exit status is 1 if the page is out of date. Needs
`pip install 'trl_suite[train,video]'`.
"""

from __future__ import annotations

import argparse
import pathlib
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
from pages import DOCS, interval, picture

from trl_suite import sequences
from trl_suite.util import files
from trl_suite.util.program import begin_script
from trl_suite.util.tables import markdown_table as table

FOLDER = DOCS / 'continual'
LEARNERS = ('Scratch', 'FineTuning', 'EWC', 'Plaid', 'MultiTask')  # the order of tables and colours
REFERENCE = 'Scratch'
COLUMNS = (
    'average_performance', 'learning_accuracy', 'forgetting', 'backward_transfer',
    'forward_transfer', 'learning_transfer',
)  # fmt: skip
Result = dict[str, Any]
Runs = dict[str, dict[int, Result]]  # learner -> seed -> result


def load(folder: pathlib.Path) -> Runs:
    """Returns the checked runs of two stages or more.

    Raises:
      ValueError: a file is not a result, or two runs have the same learner and seed, or different
        settings.
    """
    found: Runs = {}
    settings: set[Any] = set()
    for path in sorted(folder.glob('*.json')):
        result = sequences.read(path, complete=False)
        if len(result['scores']) < 2:  # no metrics
            continue
        name = result['learner'].rpartition(':')[2]
        others = {each['learner'] for each in found.get(name, {}).values()}
        if others - {result['learner']}:
            raise ValueError(
                f'{path}: learner {result["learner"]!r}; other files have {others.pop()!r}, of the same name'
            )
        if result['seed'] in found.setdefault(name, {}):
            raise ValueError(f'{path}: a second run of {name} with seed {result["seed"]}')
        found[name][result['seed']] = result
        settings.add((result['sequence'], result['budget'], result['episodes']))
        if len(settings) > 1:
            raise ValueError(f'{path}: settings differ from those of the other files: {settings}')
    order = [*LEARNERS, *sorted(found)]
    return dict(sorted(found.items(), key=lambda item: order.index(item[0])))


def row(runs: Runs, name: str, stages: int) -> list[str]:
    """Returns the cells of a learner: number of runs, and metrics of the first stages."""
    values: dict[str, list[float]] = {column: [] for column in COLUMNS}
    for seed, result in runs[name].items():
        scores = np.array(result['scores'])[:stages, :stages]
        found = sequences.metrics(scores, result['initial'][:stages])
        if seed in runs.get(REFERENCE, {}) and name != REFERENCE:
            found['learning_transfer'] = np.mean(
                transfers(result, runs[REFERENCE][seed], stages), dtype=float
            )
        for column, value in found.items():
            values[column].append(value)
    return [f'`{name}`', str(len(runs[name])), *(interval(values[column]) for column in COLUMNS)]


def transfers(result: Result, reference: Result, stages: int) -> list[float]:
    """Returns the learning transfer of every environment but the first."""
    curves = zip(result['curves'][1:stages], reference['curves'][1:stages], strict=True)
    return [sequences.learning_transfer(curve, other) for curve, other in curves]


def terrain(id_: str) -> str:
    return id_.split('_', 2)[2].removesuffix('_Terrain-v0').replace('_', ' ').lower()


def section(folder: pathlib.Path) -> str:
    """Returns the text about the runs of one sequence."""
    runs = load(folder)
    if not runs:
        return ''
    every = [result for seeds in runs.values() for result in seeds.values()]
    stages, first = min(len(result['scores']) for result in every), every[0]
    names = [terrain(id_) for id_ in first['ids']]
    part = (
        f'all {stages} stages'
        if stages == len(names)
        else f'the first {stages} of {len(names)} stages ({", ".join(names[:stages])})'
    )

    def by_environment(values: Callable[[str, Result], list[float]], begin: int = 0) -> str:
        """Returns a table of values (learner, result) -> of each environment from `begin` on."""
        rows = []
        for name, seeds in runs.items():
            of_runs = [values(name, result) for result in seeds.values()]
            if of_runs := [each for each in of_runs if each]:
                rows.append([f'`{name}`', *map(interval, zip(*of_runs, strict=True))])
        return table(['learner', *names[begin:stages]], rows)

    def transfer(name: str, result: Result) -> list[float]:
        reference = runs.get(REFERENCE, {}).get(result['seed'])
        if name == REFERENCE or reference is None:
            return []
        return transfers(result, reference, stages)

    parts = [
        f'### `{first["sequence"]}`, {first["budget"]} samples per stage',
        f'Metrics of {part}, {first["episodes"]} episodes per test; mean over the runs and half '
        "width of its 95 % confidence interval (Student's t), without interval for a single run.",
        table(['learner', 'runs', *(column.replace('_', ' ') for column in COLUMNS)],
              (row(runs, name, stages) for name in runs)),
        f'Scores after stage {stages}, by test environment:',
        by_environment(lambda _, result: result['scores'][stages - 1][:stages]),
        'Scores on each environment directly after its own stage:',
        by_environment(lambda _, result: [result['scores'][i][i] for i in range(stages)]),
    ]  # fmt: skip
    if REFERENCE in runs and len(runs) > 1:
        parts += [
            f'Learning transfer by environment, relative to `{REFERENCE}` with the same seed:',
            by_environment(transfer, 1),
        ]
    return '\n\n'.join([
        *parts,
        f'![Learning curves: return in training, by stage](continual/{folder.name}_curves.svg)',
        f'![Scores on each environment after every stage](continual/{folder.name}_scores.svg)',
    ])  # fmt: skip


def curves_picture(runs: Runs, path: pathlib.Path) -> None:
    """Draws one panel per stage: return of training episodes over its samples."""

    def panel(axes: Any, number: int, first: Result) -> None:
        for i, (name, seeds) in enumerate(runs.items()):
            found = [r['curves'][number] for r in seeds.values() if len(r['curves']) > number]
            if not found:
                continue
            curve = np.array(found, float)
            samples = (np.arange(curve.shape[1]) + 0.5) / curve.shape[1] * first['budget'] / 1e3
            for each in curve:
                axes.plot(samples, each, color=f'C{i}', alpha=0.3, linewidth=0.7)
            axes.plot(samples, curve.mean(0), color=f'C{i}', label=name)
        axes.set(title=terrain(first['ids'][number]), xlabel='thousand samples', ylim=(0, 1))

    _picture(runs, path, panel, 'return in training')


def scores_picture(runs: Runs, path: pathlib.Path) -> None:
    """Draws one panel per environment: score after every stage; its own stage is marked."""

    def panel(axes: Any, number: int, first: Result) -> None:
        for i, (name, seeds) in enumerate(runs.items()):
            most = max(len(result['scores']) for result in seeds.values())
            rows = np.full((len(seeds), most + 1), np.nan)
            for k, result in enumerate(seeds.values()):
                column = [result['initial'][number], *(r[number] for r in result['scores'])]
                rows[k, : len(column)] = column
            axes.plot(np.nanmean(rows, 0), color=f'C{i}', label=name, marker='.')
        axes.axvline(number + 1, color='0.8', zorder=0)
        axes.set(title=terrain(first['ids'][number]), xlabel='stages', ylim=(0, 1))

    _picture(runs, path, panel, 'score')


def _picture(
    runs: Runs, path: pathlib.Path, panel: Callable[[Any, int, Result], None], label: str
) -> None:
    first = next(iter(next(iter(runs.values())).values()))
    count = len(first['ids'])
    with picture(path, 1, count, figsize=(2.1 * count, 2.3), sharey=True) as (figure, axes):
        for number, each in enumerate(axes[0]):
            panel(each, number, first)
        axes[0, 0].set_ylabel(label)
        handles, names = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, names, fontsize=8, loc='outside lower center', ncols=len(names))


def page(text: str) -> str:
    """Returns the page with the current results."""
    sections = filter(None, map(section, sorted(FOLDER.glob('*/'))))
    written = '\n' + '\n\n'.join(sections) + '\n'
    return files.between(text, 'results', 'training/continual_results.py', written)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--check', action='store_true', help='write nothing')
    arguments = parser.parse_args()
    path = DOCS / 'continual_learning.md'
    old = path.read_text(encoding='utf-8')
    new = page(old)
    if arguments.check:
        sys.exit(old != new)
    for folder in sorted(FOLDER.glob('*/')):
        if runs := load(folder):
            curves_picture(runs, FOLDER / f'{folder.name}_curves.svg')
            scores_picture(runs, FOLDER / f'{folder.name}_scores.svg')
    files.write_text(new, path)


if __name__ == '__main__':
    begin_script()
    main()
