"""Writes the tables and figures of docs/benchmark.md from files in this tree.

    python docs/benchmark_page.py [--check]

The scale of scores is in trl_suite/benchmark/scales.json; results are those of the entries in
benchmarks/entries, which CI verifies: an entry is a folder, whose name is that of its learner on the page.
Curves and statistics go into docs/benchmark/report.json. With --check nothing is written, and the
exit status is 1 if a file is out of date; a figure names the data that it shows. Needs
`pip install 'trl_suite[video]'`.
"""

from __future__ import annotations

import argparse
import json
import pathlib
import sys
from typing import Any

import numpy as np

from trl_suite import benchmark
from trl_suite.benchmark.report import THRESHOLDS, report, table
from trl_suite.util import files, tables
from trl_suite.util.digest import digest
from trl_suite.util.program import begin_script

DOCS = pathlib.Path(__file__).resolve().parent
PAGE, FOLDER = DOCS / 'benchmark.md', DOCS / 'benchmark'
ENTRIES = DOCS.parent / 'benchmarks' / 'entries'
BUDGET = benchmark.BUDGETS['1M']
BASELINES = ('PPO', 'SAC', 'SuitePPO', 'TD3', 'TQC')  # the entries that are made here
COMPARED = ('PPO', 'SuitePPO')  # learners are ranked in the environments that these have
FIGURES = {'curves': 'report', 'environments': 'report', 'levels': 'levels'}  # and their data


def core(found: dict[str, Any]) -> str:
    """Returns the table of the core set; how hard each is follows from the best learner's score."""
    rows = []
    for id, course in benchmark.CORE.items():
        low, high = benchmark.ends(id)
        scores = [np.mean(runs, 0)[-1] for of in every(found).values() if (runs := of.get(id))]
        best = f'{max(scores):.2f}' if scores else '–'
        ends = f'{low:.3f}', f'{high:.3f}'
        rows.append((f'`{id}`', course.description, *ends, best))
    header = 'environment', 'tests', '0 is', '1 is', 'best learner'
    return tables.markdown_table(header, rows)


def count_of(levels: str) -> str:
    """Returns the number of levels in words."""
    return f'{int(levels):,}' if int(levels) < 2**31 else 'no limit'


def levels() -> str:
    """Returns the table of scores on levels of training and on others, and their picture."""
    rows = []
    for id, counts in files.read_json(FOLDER / 'levels.json').items():
        for count, scores in counts.items():
            own, others = np.mean(scores, 0)
            gaps = np.subtract(*np.transpose(scores))
            span = f' ({min(gaps):.3f} to {max(gaps):.3f})' if len(scores) > 1 else ''
            rows.append((
                f'`{id}`', count_of(count), len(scores), f'{own:.3f}', f'{others:.3f}',
                f'{own - others:.3f}{span}',
            ))  # fmt: skip
    picture = '![Mean return on the levels of training and on others](benchmark/levels.svg)'
    header = (
        'environment',
        'levels',
        'runs',
        'on these levels',
        'on others',
        'gap, and its range over runs',
    )
    return f'{tables.markdown_table(header, rows)}\n\n{picture}'


def entries() -> dict[str, Any]:
    """Returns the report of the learners that have all environments of those in `COMPARED`.

    Learners that lack some, and other environments, are in 'further': the scores of their runs after
    each part, (runs, 20), by learner and environment.

    Raises:
      ValueError: an invalid result, or one with other settings than those of the benchmark; results of
        several learners in a folder, or not one of each seed, of which baselines may lack some.
    """
    results: dict[str, list[dict[str, Any]]] = {}
    for folder in sorted(ENTRIES.iterdir()):
        name = f'{folder.name} (baseline)' if folder.name in BASELINES else folder.name
        for path in sorted(folder.glob('*.json')):
            result = benchmark.read(path)
            notes = benchmark.departures(result)
            if result['budget'] != BUDGET:
                notes.append(f'budget is {result["budget"]}, not {BUDGET}')
            if notes:
                raise ValueError(f'{path}: {"; ".join(notes)}')
            results.setdefault(name, []).append(result)
        _check_entry(folder, results.get(name, []))
        for result in results.get(name, []):
            result['learner'] = name
    ids = {name: {each['environment'] for each in of} for name, of in results.items()}
    asked = set.intersection(*(ids[f'{name} (baseline)'] for name in COMPARED))
    ranked: list[dict[str, Any]] = []
    further: dict[str, dict[str, list[list[float]]]] = {}
    for name, of in results.items():
        for each in of:
            id = each['environment']
            if id in asked and asked <= ids[name]:
                ranked.append(each)
            else:
                curve = [benchmark.normalised(id, score) for (score,) in each['scores']]
                further.setdefault(name, {}).setdefault(id, []).append(curve)
    return {**report(ranked), 'further': further}


def _check_entry(folder: pathlib.Path, results: list[dict[str, Any]]) -> None:
    """Raises ValueError unless all results have one learner, and each environment has every seed once."""
    if len(learners := {each['learner'] for each in results}) > 1:
        raise ValueError(f'{folder}: several learners, {sorted(learners)}; expected one')
    seeds: dict[str, list[int]] = {}
    for each in results:
        seeds.setdefault(each['environment'], []).append(each['seed'])
    for id, found in seeds.items():
        complete = folder.name in BASELINES or set(found) == set(benchmark.SEEDS)
        if len(set(found)) < len(found) or not complete:
            raise ValueError(
                f'{folder}: {id} has the seeds {sorted(found)}; expected each of {benchmark.SEEDS} once'
            )


def every(found: dict[str, Any]) -> dict[str, dict[str, list[list[float]]]]:
    """Returns the curves of all learners by environment."""
    ranked, further = found['learners'], found['further']
    return {
        name: {**ranked.get(name, {'scores': {}})['scores'], **further.get(name, {})}
        for name in (*ranked, *(name for name in further if name not in ranked))
    }


def leaderboard(found: dict[str, Any]) -> str:
    """Returns tables and figures of all entries."""
    header = 'environment', 'learner', 'seeds', 'score'
    further = [
        (f'`{id}`', learner, len(runs), f'{np.mean(runs, 0)[-1]:.3f}')
        for learner, of in found['further'].items()
        for id, runs in of.items()
    ]
    return '\n\n'.join((
        table(found), *([tables.markdown_table(header, further)] if further else []),
        '![Interquartile mean over samples, and the share of runs above each score](benchmark/curves.svg)',
        '![Scores in each environment over samples](benchmark/environments.svg)',
        'Curves and statistics: [report.json](benchmark/report.json).',
    ))  # fmt: skip


def pictures(found: dict[str, Any]) -> None:
    """Draws the curves, all together and of each environment, and the profiles."""
    import matplotlib
    from matplotlib import pyplot

    settings = {'svg.hashsalt': 'benchmark', 'svg.fonttype': 'none', 'font.size': 8}
    samples = np.array(found['samples']) / 1e6
    with matplotlib.rc_context(settings):  # the same file for the same data
        figure, (left, right) = pyplot.subplots(1, 2, figsize=(7, 2.8), layout='constrained')
        for axes, name, x in ((left, 'curve', samples), (right, 'profile', THRESHOLDS)):
            for learner, of in found['learners'].items():
                value, low, high = np.array(of[name]).T
                axes.plot(x, value, label=learner)
                axes.fill_between(x, low, high, alpha=0.2)
        left.set(xlabel='million samples', ylabel='interquartile mean of scores')
        right.set(xlabel='score', ylabel='share of runs above')
        left.legend()
        _save(figure, 'curves')
        curves = every(found)
        ids = [id for id in benchmark.CORE if any(id in of for of in curves.values())]
        rows = -(-len(ids) // 4)
        figure, grid = pyplot.subplots(
            rows, 4, figsize=(8, 2 * rows), sharex=True, sharey=True, layout='constrained'
        )
        for axes in grid.flat[len(ids) :]:
            axes.remove()
        lines: dict[str, Any] = {}
        for axes, id in zip(grid.flat, ids, strict=False):
            for i, (learner, of) in enumerate(curves.items()):
                for run in of.get(id, ()):
                    axes.plot(samples, run, color=f'C{i}', alpha=0.3, linewidth=0.7)
                if id in of:
                    (lines[learner],) = axes.plot(samples, np.mean(of[id], 0), color=f'C{i}')
            axes.set_title(id.removesuffix('-v0').replace('_Terrain', ''), fontsize=7)
        figure.legend(lines.values(), lines, loc='outside lower center', ncols=5)
        _save(figure, 'environments')
        of = files.read_json(FOLDER / 'levels.json')
        figure, axes = pyplot.subplots(
            1,
            len(of),
            figsize=(2.6 * len(of), 2.2),
            squeeze=False,
            sharey=True,
            layout='constrained',
        )
        for each, (id, counts) in zip(axes[0], of.items(), strict=True):
            for k, name in enumerate(('levels of training', 'other levels')):
                runs = [np.transpose(scores)[k] for scores in counts.values()]
                each.errorbar(
                    range(len(counts)), [run.mean() for run in runs], label=name, marker='.', capsize=2,
                    yerr=[[run.mean() - run.min() for run in runs], [run.max() - run.mean() for run in runs]],
                )  # fmt: skip
            each.set_xticks(range(len(counts)), [count_of(count) for count in counts])
            each.set_title(id.removesuffix('-v0').replace('_Terrain', ''), fontsize=7)
        axes[0, 0].set(xlabel='levels', ylabel='mean return / step limit')
        axes[0, 0].legend(fontsize=7)
        _save(figure, 'levels')


def _save(figure: Any, name: str) -> None:
    with files.replacing(FOLDER / f'{name}.svg') as part:
        figure.savefig(part, metadata={'Date': None, 'Description': shown(name)})


def shown(name: str) -> str:
    """Returns what a figure shows: its data and their digest."""
    data = FOLDER / f'{FIGURES[name]}.json'
    return f'{data.name} {digest(rounded(files.read_json(data)))}'


def page(found: dict[str, Any], text: str) -> str:
    """Returns the page with tables and figures."""
    for name, content in (
        ('core', core(found)),
        ('leaderboard', leaderboard(found)),
        ('levels', levels()),
    ):
        text = files.between(text, name, 'docs/benchmark_page.py', f'\n{content}\n')
    return text


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--check', action='store_true', help='write nothing')
    arguments = parser.parse_args()
    stored = FOLDER / 'report.json'
    found = entries()
    old = PAGE.read_text(encoding='utf-8')
    new = page(found, old)
    if arguments.check:
        drawn = all(shown(name) in (FOLDER / f'{name}.svg').read_text() for name in FIGURES)
        sys.exit(old != new or rounded(files.read_json(stored)) != rounded(found) or not drawn)
    files.write_json(found, stored, indent=None)
    pictures(found)
    files.write_text(new, PAGE)


def rounded(found: Any) -> Any:
    """Returns numbers without their last bits, which depend on the processor."""
    return json.loads(json.dumps(found), parse_float=lambda text: round(float(text), 9))


if __name__ == '__main__':
    begin_script()
    main()
