"""`trl-suite benchmark`: lists the core set, runs a learner on it, checks, reports and verifies."""

from __future__ import annotations

import argparse
import pathlib
from typing import Any

from trl_suite.cli import engine, learners
from trl_suite.cli.arguments import add_command, add_file, add_threads
from trl_suite.util import files, program


def declare(commands: Any) -> None:
    """Declares the command, its actions, and their arguments."""
    command = add_command(commands, 'benchmark', 'benchmark of learning algorithms')
    actions = command.add_subparsers(required=True, metavar='action')
    add_command(actions, 'list', 'list the environments, with the scores that are 0 and 1', _list)
    text = 'train a learner on environments of the core set, and test it after every 5 %%'
    command = add_command(actions, 'run', text, _run)
    text = 'environment of the core set; by default all, one after the other'
    command.add_argument('ids', nargs='*', metavar='ID', help=text)
    learners.add_learner(command, '1M', '10M')
    text = 'folder of the results, by default the name of the learner; unfinished runs are resumed'
    command.add_argument('--output', type=pathlib.Path, metavar='FOLDER', help=text)
    learners.add_check(actions, _check)
    command = add_command(actions, 'report', 'compare learners by their results', _report)
    _add_results(command)
    add_file(command, '--json', 'write the numbers, .json', '.json')
    text = 'check results, and repeat their last tests with the policies beside them'
    command = add_command(actions, 'verify', text, _verify)
    _add_results(command)
    add_threads(command)


def _add_results(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        'entries', nargs='+', type=pathlib.Path, metavar='ENTRY',
        help='a result, .json, or a folder of results',
    )  # fmt: skip


def _results(entries: list[pathlib.Path]) -> list[pathlib.Path]:
    """Returns the files of results in entries, which are files or folders."""
    paths = []
    for entry in entries:
        found = sorted(entry.rglob('*.json')) if entry.is_dir() else [entry]
        if not found:
            raise ValueError(f'{entry}: has no results; expected files ENVIRONMENT_sSEED.json')
        paths += found
    return paths


def _list(arguments: argparse.Namespace) -> None:
    benchmark = engine.load('trl_suite.benchmark')
    print(f'{"environment":<35} {"0":>7} {"1":>7} {"limit":>6}  what it tests')
    for id, course in benchmark.CORE.items():
        low, high = benchmark.ends(id)
        limit = course.spec(id).step_limit
        print(f'{id:<35} {low:>7.3f} {high:>7.3f} {limit:>6}  {course.description}')


def _run(arguments: argparse.Namespace) -> None:
    benchmark = engine.load('trl_suite.benchmark')
    courses = [benchmark.get(id) for id in arguments.ids or benchmark.CORE]
    kind = learners.learner(arguments.learner)
    budget = learners.budget(arguments.budget, benchmark.BUDGETS)
    folder = arguments.output or pathlib.Path(arguments.learner.rpartition(':')[2])
    folder.mkdir(exist_ok=True)
    for course in courses:
        path = folder / f'{course.name}_s{arguments.seed}.json'
        result = benchmark.run(
            course, kind(course, arguments.seed), budget, path, arguments.episodes,
            arguments.seed, arguments.threads, progress=True,
        )  # fmt: skip
        print(f'{path}: score {result["metrics"]["score"]:.3f}', flush=True)


def _check(arguments: argparse.Namespace) -> None:
    learners.check(engine.load('trl_suite.benchmark').BENCHMARK, arguments.files)


def _report(arguments: argparse.Namespace) -> None:
    report = engine.load('trl_suite.benchmark.report')
    benchmark = engine.load('trl_suite.benchmark')
    results = [benchmark.read(path) for path in _results(arguments.entries)]
    found = report.report(results)
    print('\n'.join(map(program.printable, report.table(found).split('\n'))))
    if arguments.json is not None:
        files.write_json(found, arguments.json)


def _verify(arguments: argparse.Namespace) -> None:
    benchmark = engine.load('trl_suite.benchmark')
    for path in _results(arguments.entries):
        result = benchmark.verify(path, arguments.threads)
        print(program.printable(f'{path}: verified, score {result["metrics"]["score"]:.3f}'))
