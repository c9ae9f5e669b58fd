"""`trl-suite dataset`: writes episodes of a policy as a data set for offline learning."""

from __future__ import annotations

import argparse
from typing import Any

from trl_suite.cli import engine
from trl_suite.cli.arguments import add_command, add_id, add_threads, positive


def declare(commands: Any) -> None:
    """Declares the command and its arguments."""
    text = 'write episodes of a policy as a data set for offline learning'
    command = add_command(commands, 'dataset', text, run)
    add_id(command)
    text = 'reference: the shipped policy; mixed: with a share of random actions, which every episode draws'
    names = ('reference', 'mixed', 'random')
    command.add_argument('--policy', default='mixed', choices=names, help=text)
    command.add_argument('--episodes', type=positive, default=100, help='number of episodes')
    command.add_argument('--seed', type=int, default=0, help='seed of the episodes')
    text = "in Minari's format, into its folder"
    command.add_argument(
        '--minari', action='store_true', required=True, default=argparse.SUPPRESS, help=text
    )
    add_threads(command)


def run(arguments: argparse.Namespace) -> None:
    """Writes the data set, and prints its name."""
    adapter = engine.load('trl_suite.adapters.minari')
    given = arguments.id, arguments.policy, arguments.episodes, arguments.seed, arguments.threads
    print(adapter.write(*given))
