"""Writes the tables and figures of docs/benchmark.md from JSON files in this tree.

    trl-suite benchmark report RESULTS --json docs/benchmark/report.json
    python docs/benchmark_page.py [--check]

The scale of scores is in trl_suite/benchmark/scales.json; the curves and statistics of all learners
are in docs/benchmark/report.json; the leaderboard is made of the entries in
benchmarks/entries, which CI verifies. With --check nothing is written, and the exit status is 1
if the page is out of date. Needs `pip install 'trl_suite[video]'`.
"""

from __future__ import annotations

import argparse
import pathlib
import sys
from typing import Any

import numpy as np

from trl_suite import benchmark
from trl_suite.benchmark.report import LEVELS, report, table
from trl_suite.util import files
from trl_suite.util.program import begin_script

DOCS = pathlib.Path(__file__).resolve().parent
PAGE, FOLDER = DOCS / 'benchmark.md', DOCS / 'benchmark'
ENTRIES = DOCS.parent / 'benchmarks' / 'entries'
BASELINES = ('ppo_learner:', 'stable_baselines_learners:', 'td3_learner:', 'tqc_learner:')
NONE = 'No result has been stored yet.'


def core(found: dict[str, Any] | None) -> str:
    """Returns the table of the core set; how hard each is follows from the best learner's score."""
    lines = ['| environment | tests | 0 is | 1 is | best learner |', '|--|--|--:|--:|--:|']
    for id, course in benchmark.CORE.items():
        low, high = benchmark.ends(id)
        best = '–'
        if found and id in found['environments']:
            scores = [
                np.mean([run[-1] for run in of['scores'][id]]) for of in found['learners'].values()
            ]
            best = f'{max(scores):.2f}'
        lines.append(f'| `{id}` | {course.description} | {low:.3f} | {high:.3f} | {best} |')
    return '\n'.join(lines)


def levels() -> str:
    """Returns the table of scores on levels of training and on others."""
    stored = FOLDER / 'levels.json'
    if not stored.exists():
        return NONE
    lines = [
        '| environment | levels | runs | on these levels | on others | gap |',
        '|--|--:|--:|--:|--:|--:|',
    ]
    for id, counts in files.read_json(stored).items():
        for count, scores in counts.items():
            if scores:
                own, others = np.mean(scores, 0)
                number = f'{int(count):,}' if int(count) < 2**31 else 'no limit'
                lines.append(
                    f'| `{id}` | {number} | {len(scores)} | {own:.3f} | {others:.3f} | {own - others:.3f} |'
                )
    return '\n'.join(lines)


def leaderboard() -> str:
    """Returns the ranking of all entries."""
    results = [benchmark.read(path) for path in sorted(ENTRIES.rglob('*.json'))]
    if not results:
        return NONE
    text = '\n\n'.join(table(report(results)).split('\n\n')[:2])  # without environments and pairs
    for name in BASELINES:
        text = text.replace(f'| {name}', f'| baseline: {name}')
    return text


def pictures(found: dict[str, Any]) -> None:
    """Draws the curves, all together and of each environment, and the profiles."""
    import matplotlib
    from matplotlib import pyplot

    settings = {'svg.hashsalt': 'benchmark', 'svg.fonttype': 'none', 'font.size': 8}
    samples = np.array(found['samples']) / 1e6
    with matplotlib.rc_context(settings):  # the same file for the same data
        figure, (left, right) = pyplot.subplots(1, 2, figsize=(7, 2.8), layout='constrained')
        for axes, name, x in ((left, 'curve', samples), (right, 'profile', LEVELS)):
            for learner, of in found['learners'].items():
                value, low, high = np.array(of[name]).T
                axes.plot(x, value, label=learner.rpartition(':')[2])
                axes.fill_between(x, low, high, alpha=0.2)
        left.set(xlabel='million samples', ylabel='interquartile mean of scores')
        right.set(xlabel='score', ylabel='share of runs above')
        left.legend()
        _save(figure, FOLDER / 'curves.svg')
        rows = -(-len(found['environments']) // 4)
        figure, grid = pyplot.subplots(
            rows, 4, figsize=(8, 2 * rows), sharex=True, sharey=True, layout='constrained'
        )
        for axes in grid.flat[len(found['environments']) :]:
            axes.remove()
        for axes, id in zip(grid.flat, found['environments'], strict=False):
            for i, of in enumerate(found['learners'].values()):
                for run in of['scores'][id]:
                    axes.plot(samples, run, color=f'C{i}', alpha=0.3, linewidth=0.7)
                axes.plot(samples, np.mean(of['scores'][id], 0), color=f'C{i}')
            axes.set_title(id.removesuffix('-v0').replace('_Terrain', ''), fontsize=7)
        _save(figure, FOLDER / 'environments.svg')


def _save(figure: Any, path: pathlib.Path) -> None:
    with files.replacing(path) as part:
        figure.savefig(part, metadata={'Date': None})


def page(found: dict[str, Any] | None, text: str) -> str:
    """Returns the page with tables and figures."""
    results = NONE
    if found:
        results = '\n\n'.join((
            'All curves are in [report.json](benchmark/report.json).',
            table(found),
            '![Interquartile mean over samples, and the share of runs above each score](benchmark/curves.svg)',
            '![Scores in each environment over samples](benchmark/environments.svg)',
        ))  # fmt: skip
    for name, content in (
        ('core', core(found)),
        ('results', results),
        ('leaderboard', leaderboard()),
        ('levels', levels()),
    ):
        begin, end = f'<!-- {name}, written by docs/benchmark_page.py -->', f'<!-- /{name} -->'
        before, rest = text.split(begin)
        text = f'{before}{begin}\n\n{content}\n\n{end}{rest.split(end)[1]}'
    return text


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--check', action='store_true', help='write nothing')
    arguments = parser.parse_args()
    stored = FOLDER / 'report.json'
    found = files.read_json(stored) if stored.exists() else None
    old = PAGE.read_text(encoding='utf-8')
    new = page(found, old)
    if arguments.check:
        sys.exit(old != new)
    if found:
        pictures(found)
    with files.replacing(PAGE) as part:
        part.write_text(new, encoding='utf-8')


if __name__ == '__main__':
    begin_script()
    main()
