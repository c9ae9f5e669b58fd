"""`trl-suite info`: a full description of one environment."""

from __future__ import annotations

import argparse
from typing import Any

from trl_suite.cli import engine
from trl_suite.cli.arguments import add_command, add_id


def declare(commands: Any) -> None:
    """Declares the command and its arguments."""
    add_id(add_command(commands, 'info', 'describe one environment in full', run))


def run(arguments: argparse.Namespace) -> None:
    """Prints a full description of one environment."""
    suite, describe = engine.load(), engine.load('trl_suite.describe')
    spec = suite.find(arguments.id)
    environment = suite.build_environment(spec, {}, {})
    print(f'{spec.id}\n  {spec.description}')
    print(f'  also {", ".join((f"{spec.domain}/{spec.task}", *spec.aliases))}; tags:', end=' ')
    print(', '.join(sorted(spec.tags)))
    for title, text in describe.sections(spec, environment):
        print(f'\n{title}\n{text}')
