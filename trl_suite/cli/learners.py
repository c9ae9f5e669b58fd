"""What the commands `sequences` and `benchmark` have in common: learners, budgets, checks of results."""

from __future__ import annotations

import argparse
import importlib
import os
import pathlib
import sys
from typing import Any

from trl_suite.cli.arguments import add_command, add_threads, positive
from trl_suite.util import errors, program


def add_learner(command: argparse.ArgumentParser, *budgets: str) -> None:
    """Adds what a run of a learner needs; the first budget is the default."""
    text = 'class of the learner: CLASS(course, seed), with the methods train(stage) and policy()'
    command.add_argument('--learner', required=True, metavar='MODULE:CLASS', help=text)
    text = f'samples for each environment: {", ".join(budgets)}, or N'
    command.add_argument('--budget', default=budgets[0], help=text)
    text = 'episodes per test and environment'
    command.add_argument('--episodes', type=positive, default=32, help=text)
    command.add_argument('--seed', type=int, default=0, help='seed of the run')
    add_threads(command)


def add_check(actions: Any, check: Any) -> None:
    """Adds the action `check`."""
    command = add_command(actions, 'check', 'check results: fields, budget and metrics', check)
    command.add_argument(
        'files', nargs='+', type=pathlib.Path, metavar='FILE', help='a result, .json'
    )


def check(benchmark: Any, paths: list[pathlib.Path]) -> None:
    """Checks results, and prints one line for each."""
    for path in paths:
        result = benchmark.read(path)
        notes = benchmark.departures(result)
        comparable = f'not comparable: {"; ".join(notes)}' if notes else 'valid and comparable'
        made = ''.join(f', {name} {result[name]}' for name in ('mujoco', 'cpu') if name in result)
        line = (
            f'{path}: {result["learner"]}, {result[benchmark.field]}, budget {result["budget"]}, '
            f'seed {result["seed"]}{made}: {comparable}'
        )
        print(program.printable(line))


def budget(text: str, budgets: dict[str, int]) -> int:
    """Returns a number of samples by its name, or as it is given."""
    try:
        return budgets[text] if text in budgets else int(float(text))
    except (ValueError, OverflowError):
        raise ValueError(
            f'--budget is {text!r}; expected {", ".join(budgets)} or a number of samples'
        ) from None


def learner(text: str) -> Any:
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
