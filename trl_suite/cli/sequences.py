"""`trl-suite sequences`: lists the sequences, runs a learner on one, checks results."""

from __future__ import annotations

import argparse
import pathlib
from typing import Any

from trl_suite.cli import engine, learners
from trl_suite.cli.arguments import add_command, positive


def declare(commands: Any) -> None:
    """Declares the command, its actions, and their arguments."""
    command = add_command(commands, 'sequences', 'benchmark of continual learning')
    actions = command.add_subparsers(required=True, metavar='action')
    add_command(actions, 'list', 'list the sequences', _list)
    text = 'train a learner on a sequence, and test it after each stage'
    command = add_command(actions, 'run', text, _run)
    command.add_argument('name', metavar='NAME', help='name of a sequence')
    learners.add_learner(command, 'small', 'full')
    command.add_argument('--stages', type=positive, metavar='N', help='stop after N stages')
    command.add_argument(
        '--output',
        type=pathlib.Path,
        default='result.json',
        metavar='FILE',
        help='result, .json; an unfinished run is resumed',
    )
    learners.add_check(actions, _check)


def _list(arguments: argparse.Namespace) -> None:
    sequences = engine.load('trl_suite.sequences')
    for name, sequence in sequences.SEQUENCES.items():
        print(f'{name:<18} {len(sequence)} environments: {sequence.description}')


def _run(arguments: argparse.Namespace) -> None:
    sequences = engine.load('trl_suite.sequences')
    sequence = sequences.get(arguments.name)
    kind = learners.learner(arguments.learner)
    result = sequences.run(
        sequence, kind(sequence, arguments.seed), learners.budget(arguments.budget, sequences.BUDGETS),
        arguments.output, arguments.episodes, arguments.seed, arguments.threads, progress=True,
        stages=arguments.stages,
    )  # fmt: skip
    for id, row in zip(sequence.ids, result['scores'], strict=False):
        print(f'after {id:34}', *(f'{score:.3f}' for score in row))
    for name, value in result.get('metrics', {}).items():
        print(f'{name:40} {value:.3f}')


def _check(arguments: argparse.Namespace) -> None:
    learners.check(engine.load('trl_suite.sequences').BENCHMARK, arguments.files)
