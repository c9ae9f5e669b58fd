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
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from scipy import special

from trl_suite import sequences
from trl_suite.util import files
from trl_suite.util.program import begin_script

DOCS = pathlib.Path(__file__).resolve().parents[1] / 'docs'
FOLDER = DOCS / 'continual'
BEGIN, END = '<!-- results, written by training/continual_results.py -->', '<!-- /results -->'
NONE = 'No run with a budget of the benchmark has been stored yet.'
LEARNERS = ('Scratch', 'FineTuning', 'EWC', 'Plaid', 'MultiTask')  # the order of tables and colours
REFERENCE = 'Scratch'
COLUMNS = (
    'average_performance', 'learning_accuracy', 'forgetting', 'backward_transfer',
    'forward_transfer', 'learning_transfer',
)  # fmt: skip


def interval(values: Iterable[float]) -> str:
    """Returns mean and half width of the 95 % confidence interval of the mean (Student's t)."""
    found = np.fromiter(values, float)
    if len(found) < 2:
        return ' '.join(f'{value:.3f}' for value in found) or '–'
    half = special.stdtrit(len(found) - 1, 0.975) * found.std(ddof=1) / np.sqrt(len(found))
    return f'{found.mean():.3f} ± {half:.3f}'


def load(folder: pathlib.Path) -> dict[str, dict[int, dict[str, Any]]]:
    """Returns the checked runs of two stages or more: learner -> seed -> result.

    Raises:
      ValueError: a file is not a result, or two runs have the same learner and seed, or different
        settings.
    """
    found: dict[str, dict[int, dict[str, Any]]] = {}
    settings: set[Any] = set()
    for path in sorted(folder.glob('*.json')):
        result = sequences.read(path, complete=False)
        if len(result['scores']) < 2:  # no metrics
            continue
        name = result['learner'].rpartition(':')[2]
        if result['seed'] in found.setdefault(name, {}):
            raise ValueError(f'{path}: a second run of {name} with seed {result["seed"]}')
        found[name][result['seed']] = result
        settings.add((result['sequence'], result['budget'], result['episodes']))
        if len(settings) > 1:
            raise ValueError(f'{path}: settings differ from those of the other files: {settings}')
    order = [*LEARNERS, *sorted(found)]
    return dict(sorted(found.items(), key=lambda item: order.index(item[0])))


def row(runs: dict[str, dict[int, dict[str, Any]]], name: str, stages: int) -> list[str]:
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


def transfers(result: dict[str, Any], reference: dict[str, Any], stages: int) -> list[float]:
    """Returns the learning transfer of every environment but the first."""
    curves = zip(result['curves'][1:stages], reference['curves'][1:stages], strict=True)
    return [sequences.learning_transfer(curve, other) for curve, other in curves]


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    head = list(head)
    lines = [head, ['---', *['--:'] * (len(head) - 1)], *map(list, rows)]
    return '\n'.join(f'| {" | ".join(line)} |' for line in lines)


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
        f'all {stages} stages' if stages == len(names)
        else f'the first {stages} of {len(names)} stages ({", ".join(names[:stages])})'
    )  # fmt: skip
    after = [
        [f'`{name}`', *(
            interval(result['scores'][stages - 1][task] for result in seeds.values())
            for task in range(stages)
        )]
        for name, seeds in runs.items()
    ]  # fmt: skip
    learnt = [
        [f'`{name}`', *(
            interval(result['scores'][task][task] for result in seeds.values())
            for task in range(stages)
        )]
        for name, seeds in runs.items()
    ]  # fmt: skip
    faster = [
        [f'`{name}`', *(
            interval(
                transfers(result, runs[REFERENCE][seed], stages)[task]
                for seed, result in seeds.items() if seed in runs[REFERENCE]
            )
            for task in range(stages - 1)
        )]
        for name, seeds in runs.items() if name != REFERENCE and REFERENCE in runs
    ]  # fmt: skip
    parts = [
        f'### `{first["sequence"]}`, {first["budget"]} samples per stage',
        f'Metrics of {part}, {first["episodes"]} episodes per test; mean over the runs and half '
        "width of its 95 % confidence interval (Student's t), without interval for a single run.",
        table(['learner', 'runs', *(column.replace('_', ' ') for column in COLUMNS)],
              (row(runs, name, stages) for name in runs)),
        f'Scores after stage {stages}, by test environment:',
        table(['learner', *names[:stages]], after),
        'Scores on each environment directly after its own stage:',
        table(['learner', *names[:stages]], learnt),
    ]  # fmt: skip
    if faster:
        parts += [
            f'Learning transfer by environment, relative to `{REFERENCE}` with the same seed:',
            table(['learner', *names[1:stages]], faster),
        ]
    name = folder.name
    parts += [
        f'![Learning curves: return in training, by stage](continual/{name}_curves.svg)',
        f'![Scores on each environment after every stage](continual/{name}_scores.svg)',
    ]
    return '\n\n'.join(parts)


def curves_picture(runs: dict[str, dict[int, dict[str, Any]]], path: pathlib.Path) -> None:
    """Draws one panel per stage: return of training episodes over its samples."""

    def panel(axes: Any, number: int, first: dict[str, Any]) -> None:
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


def scores_picture(runs: dict[str, dict[int, dict[str, Any]]], path: pathlib.Path) -> None:
    """Draws one panel per environment: score after every stage; its own stage is marked."""

    def panel(axes: Any, number: int, first: dict[str, Any]) -> None:
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
    runs: dict[str, dict[int, dict[str, Any]]],
    path: pathlib.Path,
    panel: Callable[[Any, int, dict[str, Any]], None],
    label: str,
) -> None:
    import matplotlib
    from matplotlib import pyplot

    first = next(iter(next(iter(runs.values())).values()))
    # The same file for the same data.
    with matplotlib.rc_context(
        {'svg.hashsalt': 'continual', 'svg.fonttype': 'none', 'font.size': 8}
    ):
        figure, axes = pyplot.subplots(
            1, len(first['ids']), figsize=(2.1 * len(first['ids']), 2.3), sharey=True,
            layout='constrained',
        )  # fmt: skip
        for number, each in enumerate(axes):
            panel(each, number, first)
        axes[0].set_ylabel(label)
        handles, names = axes[0].get_legend_handles_labels()
        figure.legend(handles, names, fontsize=8, loc='outside lower center', ncols=len(names))
        with files.replacing(path) as part:
            figure.savefig(part, metadata={'Date': None})
        pyplot.close(figure)


def page(text: str) -> str:
    """Returns the page with the current results."""
    begin, end = text.index(BEGIN) + len(BEGIN), text.index(END)
    sections = [section(folder) for folder in sorted(FOLDER.glob('*/'))]
    found = list(filter(None, sections)) or [NONE]
    return '\n\n'.join([text[:begin], *found, text[end:]])


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
    with files.replacing(path) as part:
        part.write_text(new, encoding='utf-8')


if __name__ == '__main__':
    begin_script()
    main()
