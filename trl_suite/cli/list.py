"""`trl-suite list`: the environments of the catalogue."""

from __future__ import annotations

import argparse
from typing import Any

from trl_suite import policies
from trl_suite.cli.arguments import add_command
from trl_suite.registry import catalogue
from trl_suite.util import errors, tables

FILTERS = ('domain', 'character', 'actuation', 'terrain', 'tag')


def declare(commands: Any) -> None:
    """Declares the command and its arguments."""
    command = add_command(commands, 'list', 'list the environments of the catalogue', run)
    for name in FILTERS:
        command.add_argument(f'--{name}', help=f'only environments of this {name}')
    command.add_argument(
        '--trained', action='store_true', help='only environments with a shipped policy'
    )


def run(arguments: argparse.Namespace) -> None:
    """Prints the environments of the catalogue that pass the filters, one a line."""
    chosen = list(catalogue.SPECS)
    for name in FILTERS:
        value = getattr(arguments, name)
        if value is None:
            continue
        known = {item for spec in catalogue.SPECS for item in _values(spec, name)}
        errors.check_known(name, known, value)
        chosen = [row for row in chosen if value in _values(row, name)]
    if arguments.trained:
        shipped = policies.available()
        chosen = [spec for spec in chosen if spec.id in shipped]
    if chosen:
        cells = [(spec.id, f'{spec.domain}/{spec.task}', spec.description) for spec in chosen]
        print(tables.table(('id', 'domain/task', 'description'), cells, indent=''))
    print(f'{len(chosen)} environment{"" if len(chosen) == 1 else "s"}')


def _values(spec: catalogue.EnvSpec, name: str) -> frozenset[str]:
    return spec.tags if name == 'tag' else frozenset({str(getattr(spec, name))})
