"""`trl-suite info`: everything about one environment."""

from __future__ import annotations

import argparse

from trl_suite import describe
from trl_suite.cli import engine


def run(arguments: argparse.Namespace) -> None:
    """Prints everything about one environment."""
    suite = engine.load()
    spec = suite.find(arguments.id)
    environment = suite.build_environment(spec, {}, {})
    print(f'{spec.id}\n  {spec.description}')
    print(f'  also {", ".join((f"{spec.domain}/{spec.task}", *spec.aliases))}; tags:', end=' ')
    print(', '.join(sorted(spec.tags)))
    for title, text in describe.sections(spec, environment):
        print(f'\n{title}\n{text}')
