"""`trl-suite gallery`: makes the pictures of environments, terrains and characters."""

from __future__ import annotations

import argparse
import sys

from trl_suite.util import program
from trl_suite.viewing import gallery


def run(arguments: argparse.Namespace) -> int:
    """Makes pictures, and returns 1 if any failed."""
    written, failed = gallery.make(
        arguments.output, arguments.filter, arguments.overwrite, moves=arguments.moving
    )
    for path, error in failed.items():
        print(f'{path}: {program.in_one_line(error)}', file=sys.stderr)
    noun = 'picture' if len(written) == 1 else 'pictures'
    print(f'{len(written)} {noun} written to {arguments.output}, {len(failed)} failed')
    return int(bool(failed))
