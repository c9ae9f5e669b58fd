"""`trl-suite list`: the environments of the catalogue."""

from __future__ import annotations

import argparse

from trl_suite import describe, policies
from trl_suite.registry import catalogue
from trl_suite.util import errors

FILTERS = ('domain', 'character', 'actuation', 'terrain', 'tag')


def run(arguments: argparse.Namespace) -> None:
    """Prints the environments of the catalogue that pass the filters, one a line."""
    chosen = list(catalogue.ROWS)
    for name in FILTERS:
        value = getattr(arguments, name)
        if value is None:
            continue
        known = {item for row in catalogue.ROWS for item in _values(row, name)}
        if value not in known:
            raise ValueError(errors.unknown(name, value, known))
        chosen = [row for row in chosen if value in _values(row, name)]
    if arguments.trained:
        shipped = policies.available()
        chosen = [row for row in chosen if row.id in shipped]
    if chosen:
        cells = [(row.id, f'{row.domain}/{row.task}', row.description) for row in chosen]
        print(describe.table(('id', 'domain/task', 'description'), cells, indent=''))
    print(f'{len(chosen)} environment{"" if len(chosen) == 1 else "s"}')


def _values(row: catalogue.Row, name: str) -> frozenset[str]:
    return row.tags if name == 'tag' else frozenset({str(getattr(row, name))})
