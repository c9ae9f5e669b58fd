"""`trl-suite sequences`: lists the sequences, runs a learner on one, checks results."""

from __future__ import annotations

import argparse
import importlib
import os
import pathlib
import sys
from typing import Any

from trl_suite.cli import engine
from trl_suite.cli.arguments import add_command, add_threads, positive
from trl_suite.util import errors, program


def declare(commands: Any) -> None:
    """Declares the command, its actions, and their arguments."""
    command = add_command(commands, 'sequences', 'benchmark of continual learning')
    actions = command.add_subparsers(required=True, metavar='action')
    add_command(actions, 'list', 'list the sequences', _list)
    text = 'train a learner on a sequence, and test it after each stage'
    command = add_command(actions, 'run', text, _run)
    command.add_argument('name', metavar='NAME', help='name of a sequence')
    text = 'class of the learner: CLASS(sequence, seed), with the methods train(stage) and policy()'
    command.add_argument('--learner', required=True, metavar='MODULE:CLASS', help=text)
    command.add_argument('--budget', default='small', help='samples per stage: small, full, or N')
    command.add_argument(
        '--episodes', type=positive, default=32, help='episodes per test and environment'
    )
    command.add_argument('--stages', type=positive, metavar='N', help='stop after N stages')
    command.add_argument('--seed', type=int, default=0, help='seed of the run')
    add_threads(command)
    command.add_argument(
        '--output',
        type=pathlib.Path,
        default='result.json',
        metavar='FILE',
        help='result, .json; an unfinished run is resumed',
    )
    command = add_command(actions, 'check', 'check results: fields, budget and metrics', _check)
    command.add_argument(
        'files', nargs='+', type=pathlib.Path, metavar='FILE', help='a result, .json'
    )


def _list(arguments: argparse.Namespace) -> None:
    sequences = engine.load('trl_suite.sequences')
    for name, sequence in sequences.SEQUENCES.items():
        print(f'{name:<18} {len(sequence)} environments: {sequence.description}')


def _run(arguments: argparse.Namespace) -> None:
    sequences = engine.load('trl_suite.sequences')
    sequence = sequences.get(arguments.name)
    kind = _learner(arguments.learner)
    result = sequences.run(
        sequence, kind(sequence, arguments.seed), _budget(arguments.budget, sequences.BUDGETS),
        arguments.output, arguments.episodes, arguments.seed, arguments.threads, progress=True,
        stages=arguments.stages,
    )  # fmt: skip
    for id, row in zip(sequence.ids, result['scores'], strict=False):
        print(f'after {id:34}', *(f'{score:.3f}' for score in row))
    for name, value in result.get('metrics', {}).items():
        print(f'{name:40} {value:.3f}')


def _check(arguments: argparse.Namespace) -> None:
    sequences = engine.load('trl_suite.sequences')
    for path in arguments.files:
        result = sequences.read(path)
        notes = sequences.departures(result)
        comparable = f'not comparable: {"; ".join(notes)}' if notes else 'valid and comparable'
        given = [name for name in sequences.results.MADE_WITH if name in result]
        made = ''.join(f', {name} {result[name]}' for name in given)
        line = (
            f'{path}: {result["learner"]}, {result["sequence"]}, budget {result["budget"]}, seed '
            f'{result["seed"]}{made}: {comparable}'
        )
        print(program.printable(line))


def _budget(text: str, budgets: dict[str, int]) -> int:
    try:
        return budgets[text] if text in budgets else int(float(text))
    except (ValueError, OverflowError):
        raise ValueError(
            f'--budget is {text!r}; expected {", ".join(budgets)} or a number of samples'
        ) from None


def _learner(text: str) -> Any:
    """Returns a class by 'module:Class'; the current folder is searched first."""
    module, _, name = text.partition(':')
    if not (name and all(part.isidentifier() for part in module.split('.'))):
        raise ValueError(f'--learner is {text!r}; expected module:Class')
    sys.path.insert(0, os.getcwd())
    found = importlib.import_module(module)
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
