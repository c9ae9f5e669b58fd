"""`trl-suite info`: everything about one environment."""

from __future__ import annotations

import argparse

from trl_suite import describe
from trl_suite.cli import engine


def run(arguments: argparse.Namespace) -> None:
    """Prints everything about one environment."""
    suite = engine.load()
    row = suite.find(arguments.id)
    environment = suite.build_row(row, {}, {})
    print(f'{row.id}\n  {row.description}')
    print(f'  also {", ".join((f"{row.domain}/{row.task}", *row.aliases))}; tags:', end=' ')
    print(', '.join(sorted(row.tags)))
    for title, text in describe.sections(row, environment):
        print(f'\n{title}\n{text}')
