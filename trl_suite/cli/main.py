"""The command line: `trl-suite` or `python -m trl_suite`.

    trl-suite list --domain plaid --tag original
    trl-suite info PD_Dog2D_Gaps_Terrain-v0
    trl-suite rollout PD_Dog2D_Gaps_Terrain-v0 --policy clip --video dog.mp4 --ghost
    trl-suite rollout PD_Dog2D_Gaps_Terrain-v0 --policy reference --html dog.html
    trl-suite view PD_Dog2D_Gaps_Terrain-v0 --browser
    trl-suite evaluate PD_Dog2D_Gaps_Terrain-v0 --policy clip --episodes 100
    trl-suite evaluate PD_Dog2D_Gaps_Terrain-v0 --option randomize=robot --option sensors=mild
    trl-suite dataset PD_Dog2D_Gaps_Terrain-v0 --policy mixed --episodes 100 --minari
    trl-suite terrain slopes_mixed --output slopes.png
    trl-suite clip walk.bvh --character biped2d_full --cycle --output walk.npz
    trl-suite try robot.urdf --spatial
    trl-suite doctor
    trl-suite compile --all
    trl-suite bench PD_Dog2D_Gaps_Terrain-v0
    trl-suite benchmark run --learner my_module:MyLearner --seed 0
    trl-suite benchmark report MyLearner
    trl-suite sequences run plaid_biped --learner my_module:MyLearner --output result.json
    trl-suite sequences check result.json

Invalid input ends with one line on stderr and exit status 2, after the traceback of an error in a
learner's module. Each module of `COMMANDS` declares the
arguments of its commands, and runs them; the engine is imported only when a command that needs it runs.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import os
import sys
from collections.abc import Sequence
from typing import Any, NoReturn

import trl_suite
from trl_suite.util import program

# In the order of the help.
COMMANDS = 'list info rollout view evaluate dataset terrain clip try_file doctor compile bench runs'


def main(argv: Sequence[str] | None = None, prog: str = 'trl-suite') -> int:
    """Runs a command.

    Args:
      argv: arguments, without the program's name; by default those of the process.
      prog: name of the program in the help.

    Returns:
      The exit status: 0; 1 if a check of `doctor` failed; 2 after an error, with one
      line on stderr; 130 after an interrupt, 141 if the reader of the output has gone, 143 after
      SIGTERM.
    """
    arguments = argparse.Namespace()
    try:
        with program.terminable():
            _parser(prog).parse_args(argv, arguments)
            if sys.stdout is None:
                raise OSError('standard output is closed')
            status = arguments.run(arguments) or 0
            sys.stdout.flush()
    except BrokenPipeError:
        # The reader has closed the pipe; nothing may be flushed into it at exit.
        _drop_output()
        return 141
    except program.Terminated:
        print('trl-suite: terminated', file=sys.stderr)
        return 143
    except KeyboardInterrupt:
        print('trl-suite: interrupted', file=sys.stderr)
        return 130
    except (*program.EXPECTED, TypeError) as error:
        # Values of --option may have any type; without one, this is a defect.
        if isinstance(error, TypeError) and not getattr(arguments, 'options', None):
            raise
        try:
            sys.stdout and sys.stdout.flush()
        except (OSError, ValueError):
            _drop_output()
        print(f'trl-suite: error: {program.in_one_line(error)}', file=sys.stderr)
        return 2
    return status


def _drop_output() -> None:
    """Discards output that cannot be written, so that Python does not try again at exit."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, like those of commands."""

    def error(self, message: str) -> NoReturn:
        raise ValueError(f'{message} (see {self.prog} --help)')

    def _print_message(self, message: str, file: Any = None) -> None:
        # argparse ignores errors of writing.
        file = file or sys.stderr
        if file is not None:
            file.write(message)
            file.flush()


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = _Parser(prog=prog, description='Locomotion environments over random terrain.')
    parser.add_argument('--version', action='version', version=f'trl-suite {trl_suite.__version__}')
    commands = parser.add_subparsers(required=True, metavar='command', parser_class=_Parser)
    for name in COMMANDS.split():
        importlib.import_module(f'trl_suite.cli.{name}').declare(commands)
    return parser
