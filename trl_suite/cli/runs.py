"""`trl-suite benchmark` and `trl-suite sequences`: run learners; check, compare and verify results."""

from __future__ import annotations

import argparse
import collections
import contextlib
import importlib
import inspect
import os
import pathlib
import re
import sys
import traceback
from collections.abc import Iterator
from typing import Any

from trl_suite.cli import engine
from trl_suite.cli.arguments import add_command, add_file, add_threads, positive
from trl_suite.util import errors, files, program
from trl_suite.util.options import checked

COMPARABLE = 'comparable'


def declare(commands: Any) -> None:
    """Declares the commands, their actions, and their arguments."""
    text = 'list the environments, with the scores that are 0 and 1'
    actions = _add(commands, 'benchmark', 'benchmark of learning algorithms', text, _list)
    text = (
        'train a learner on environments of the core set, and test it after each of its 20 stages'
    )
    command = _add_run(actions, text, _run, '1M', '10M')
    text = 'environment of the core set; by default all, one after the other'
    command.add_argument('ids', nargs='*', metavar='ID', help=text)
    text = 'folder of the results, by default the name of the learner; unfinished runs are resumed'
    command.add_argument('--output', type=pathlib.Path, metavar='FOLDER', help=text)
    command = add_command(actions, 'report', 'compare learners by their results', _report)
    _add_results(command)
    add_file(command, '--json', 'write the numbers, .json', '.json')
    text = 'check results, and repeat their last tests with the policies beside them'
    command = add_command(actions, 'verify', text, _verify)
    _add_results(command)
    add_threads(command)

    text = 'benchmark of continual learning'
    actions = _add(commands, 'sequences', text, 'list the sequences', _list_sequences)
    text = 'train a learner on a sequence, and test it after each stage'
    command = _add_run(actions, text, _run_sequence, 'small', 'full')
    command.add_argument('name', metavar='NAME', help='name of a sequence')
    command.add_argument('--stages', type=positive, metavar='N', help='stop after N stages')
    text = 'result, .json; an unfinished run is resumed'
    command.add_argument(
        '--output', type=pathlib.Path, default='result.json', metavar='FILE', help=text
    )


def _add(commands: Any, name: str, text: str, listed: str, list_: Any) -> Any:
    """Adds a benchmark, with the actions `list` and `check`; returns its actions."""
    actions = add_command(commands, name, text).add_subparsers(required=True, metavar='action')
    add_command(actions, 'list', listed, list_)
    command = add_command(actions, 'check', 'check results: fields, budget and metrics', _check)
    command.set_defaults(benchmark=name)
    _add_results(command)
    return actions


def _add_run(actions: Any, text: str, run: Any, *budgets: str) -> argparse.ArgumentParser:
    """Adds the action `run`; the first budget is the default."""
    command = add_command(actions, 'run', text, run)
    text = 'class of the learner: CLASS(course, seed), with the methods train(stage) and policy()'
    command.add_argument('--learner', required=True, metavar='MODULE:CLASS', help=text)
    text = f'samples to learn an environment: {", ".join(budgets)}, or N'
    command.add_argument('--budget', default=budgets[0], help=text)
    text = 'episodes per test and environment'
    command.add_argument('--episodes', type=positive, default=32, help=text)
    command.add_argument('--seed', type=int, default=0, help='seed of the run')
    add_threads(command)
    return command


def _add_results(command: argparse.ArgumentParser) -> None:
    text = 'a result, .json, or a folder of results'
    command.add_argument('entries', nargs='+', type=pathlib.Path, metavar='ENTRY', help=text)


def _results(entries: list[pathlib.Path]) -> list[pathlib.Path]:
    """Returns the files of results in entries, which are files or folders."""
    paths = []
    for entry in entries:
        found = sorted(entry.rglob('*.json')) if entry.is_dir() else [files.existing(entry)]
        found = [path for path in found if not _is_state(path.relative_to(entry))]
        if not found:
            raise ValueError(f'{entry}: has no results; expected .json files of runs')
        paths += found
    return paths


def _is_state(path: pathlib.Path) -> bool:
    """Returns whether a file is part of a learner's state, or left by a run that was killed."""
    return any(re.search(r'^\.|\.stage\d+$', part) for part in path.parts)


def _read(benchmark: Any, entries: list[pathlib.Path]) -> Iterator[tuple[pathlib.Path, Any]]:
    """Yields path and content of results; unfinished ones in folders are left out, with a note.

    Raises:
      ValueError: an invalid result, or none of a run that has ended.
    """
    ended = False
    for path in _results(entries):
        result = benchmark.read(path, complete=path in entries)
        if 'metrics' in result:
            ended = True
            yield path, result
        else:
            note = f'trl-suite: {path} is left out, since its run has not ended'
            print(program.printable(note), file=sys.stderr, flush=True)
    if not ended:
        raise ValueError(f'{", ".join(map(str, entries))}: no results of runs that have ended')


@contextlib.contextmanager
def _shown(learner: str) -> Iterator[None]:
    """Prints the traceback of errors in a learner's module, given as module:Class, for its author."""
    module = learner.partition(':')[0]
    try:
        yield
    except program.EXPECTED as error:  # others are shown anyway
        frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
        if any(frame.f_globals.get('__name__') == module for frame in frames):
            traceback.print_exc()
        raise


def _list(arguments: argparse.Namespace) -> None:
    benchmark = engine.load('trl_suite.benchmark')
    print(f'{"environment":<36} {"0":>7} {"1":>7} {"limit":>6}  what it tests')
    for id, course in benchmark.CORE.items():
        low, high = benchmark.ends(id)
        limit = course.spec(id).step_limit
        print(f'{id:<36} {low:>7.3f} {high:>7.3f} {limit:>6}  {course.description}')


def _run(arguments: argparse.Namespace) -> None:
    benchmark = engine.load('trl_suite.benchmark')
    courses = [benchmark.get(id) for id in arguments.ids or benchmark.CORE]
    checked('--seed', arguments.seed, int, at_least=0)
    kind = _learner(arguments.learner)
    budget = _budget(arguments.budget, benchmark.BUDGETS)
    folder = arguments.output or pathlib.Path(arguments.learner.rpartition(':')[2])
    folder.mkdir(parents=True, exist_ok=True)
    for course in courses:
        _warn(benchmark.BENCHMARK, course, budget, arguments)
        path = folder / f'{course.name}_s{arguments.seed}.json'
        with _shown(arguments.learner):
            result = benchmark.run(
                course, _made(kind, course, arguments), budget, path, arguments.episodes,
                arguments.seed, arguments.threads, progress=True,
            )  # fmt: skip
        print(f'{path}: score {result["metrics"]["score"]:.3f}', flush=True)


def _list_sequences(arguments: argparse.Namespace) -> None:
    sequences = engine.load('trl_suite.sequences')
    for name, sequence in sequences.SEQUENCES.items():
        print(f'{name:<18} {len(sequence)} environments: {sequence.description}')


def _run_sequence(arguments: argparse.Namespace) -> None:
    sequences = engine.load('trl_suite.sequences')
    sequence = sequences.get(arguments.name)
    checked('--seed', arguments.seed, int, at_least=0)
    kind = _learner(arguments.learner)
    budget = _budget(arguments.budget, sequences.BUDGETS)
    _warn(sequences.BENCHMARK, sequence, budget, arguments)
    with _shown(arguments.learner):
        result = sequences.run(
            sequence, _made(kind, sequence, arguments), budget, arguments.output, arguments.episodes,
            arguments.seed, arguments.threads, progress=True, stages=arguments.stages,
        )  # fmt: skip
    for id, row in zip(sequence.ids, result['scores'], strict=False):
        print(f'after {id:34}', *(f'{score:.3f}' for score in row))
    for name, value in result.get('metrics', {}).items():
        print(f'{name:40} {value:.3f}')


def _warn(benchmark: Any, course: Any, budget: int, arguments: argparse.Namespace) -> None:
    """Says before a run, which may take hours, that its result will not be comparable."""
    notes = benchmark.departures({
        benchmark.field: course.name, 'budget': budget, 'episodes': arguments.episodes,
        'seed': arguments.seed,
    })  # fmt: skip
    if notes:
        print(f'trl-suite: not comparable: {"; ".join(notes)}', file=sys.stderr, flush=True)


def _check(arguments: argparse.Namespace) -> None:
    """Checks results, and prints one line for each."""
    benchmark = engine.load(f'trl_suite.{arguments.benchmark}').BENCHMARK
    for path, result in _read(benchmark, arguments.entries):
        made = ''.join(f', {name} {result[name]}' for name in ('mujoco', 'cpu') if name in result)
        line = (
            f'{path}: {result["learner"]}, {result[benchmark.field]}, budget {result["budget"]}, '
            f'seed {result["seed"]}{made}: {_comparable(benchmark, result)}'
        )
        print(program.printable(line))


def _comparable(benchmark: Any, result: dict[str, Any]) -> str:
    """Returns whether a result has the settings of the benchmark, in words."""
    notes = benchmark.departures(result)
    return f'not comparable: {"; ".join(notes)}' if notes else COMPARABLE


def _report(arguments: argparse.Namespace) -> None:
    report = engine.load('trl_suite.benchmark.report')
    benchmark = engine.load('trl_suite.benchmark')
    if arguments.json is not None:
        for entry in arguments.entries:
            if arguments.json.resolve().is_relative_to(entry.resolve()):
                raise ValueError(
                    f'--json is {arguments.json}, among the results; expected another file or folder'
                )
    results = [result for _, result in _read(benchmark, arguments.entries)]
    found = report.report(results)
    print('\n'.join(map(program.printable, report.table(found).split('\n'))))
    for note, count in collections.Counter(
        _comparable(benchmark, each) for each in results
    ).items():
        if note != COMPARABLE:
            print(program.printable(f'{count} of {len(results)} results: {note}'))
    if arguments.json is not None:
        files.write_json(found, arguments.json)


def _verify(arguments: argparse.Namespace) -> None:
    benchmark = engine.load('trl_suite.benchmark')
    for path, _ in _read(benchmark, arguments.entries):
        result, allowed = benchmark.verify(path, arguments.threads)
        how = 'bit for bit' if not allowed else f'within {allowed}'
        mujoco, cpu = (result.get(name, 'unknown') for name in ('mujoco', 'cpu'))
        score = f'score {result["metrics"]["score"]:.3f}, {_comparable(benchmark, result)}'
        print(
            program.printable(
                f'{path}: verified {how} (made with MuJoCo {mujoco} on {cpu}), {score}'
            )
        )


def _made(kind: Any, course: Any, arguments: argparse.Namespace) -> Any:
    """Makes a learner."""
    try:
        inspect.signature(kind).bind(course, arguments.seed)
    except TypeError as error:
        raise ValueError(
            f'--learner is {arguments.learner!r}; expected a class that is made as CLASS(course, seed): '
            f'{error}'
        ) from None
    return kind(course, arguments.seed)


def _budget(text: str, budgets: dict[str, int]) -> int:
    """Returns a number of samples by its name, or as it is given."""
    try:
        return budgets[text] if text in budgets else checked('budget', float(text), int)
    except ValueError:
        raise ValueError(
            f'--budget is {text!r}; expected {", ".join(budgets)} or a number of samples'
        ) from None


def _learner(text: str) -> Any:
    """Returns a class by 'module:Class'; the current folder is searched first."""
    module, _, name = text.partition(':')
    if not (name and all(part.isidentifier() for part in module.split('.'))):
        raise ValueError(f'--learner is {text!r}; expected module:Class')
    sys.path.insert(0, os.getcwd())
    try:
        with _shown(text):
            found = importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name not in (module, module.partition('.')[0]):
            raise
        raise ValueError(
            f'--learner is {text!r}; expected a module of this folder or an installed one: {error}'
        ) from None
    if not hasattr(found, name):
        classes = [each for each in dir(found) if isinstance(getattr(found, each), type)]
        raise ValueError(errors.unknown(f'learner of the module {module}:', name, classes))
    kind = getattr(found, name)
    lacking = [method for method in ('train', 'policy') if not hasattr(kind, method)]
    if not callable(kind) or lacking:
        raise ValueError(
            f'--learner is {text!r}, which has no {" and ".join(lacking) or "constructor"}; expected a '
            'class with the methods train and policy'
        )
    return kind
