"""The command line: `trl-suite` or `python -m trl_suite`.

    trl-suite list --domain plaid --tag original
    trl-suite info PD_Dog2D_Gaps_Terrain-v0
    trl-suite rollout PD_Dog2D_Gaps_Terrain-v0 --policy clip --video dog.mp4 --ghost
    trl-suite rollout PD_Dog2D_Gaps_Terrain-v0 --policy reference --html dog.html
    trl-suite view PD_Dog2D_Gaps_Terrain-v0 --browser
    trl-suite evaluate PD_Dog2D_Gaps_Terrain-v0 --policy clip --episodes 100
    trl-suite evaluate PD_Dog2D_Gaps_Terrain-v0 --option randomize=robot --option sensors=mild
    trl-suite terrain slopes_mixed --output slopes.png
    trl-suite clip walk.bvh --character biped2d_full --cycle --output walk.npz
    trl-suite try robot.urdf --spatial
    trl-suite doctor
    trl-suite compile --all
    trl-suite bench PD_Dog2D_Gaps_Terrain-v0
    trl-suite sequences run plaid_biped --learner my_module:MyLearner --output result.json
    trl-suite sequences check result.json

Invalid input ends with one line on stderr and exit status 2. A command NAME is the function `run` of
the module `trl_suite.cli.NAME` (`try_file` for `try`, which is a keyword of Python); the engine is
imported only by commands that need it.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import json
import os
import pathlib
import re
import sys
from collections.abc import Sequence
from typing import Any, NoReturn

import trl_suite
from trl_suite.cli import engine
from trl_suite.cli.list import FILTERS
from trl_suite.environments import named_policies as acting
from trl_suite.util import program


def main(argv: Sequence[str] | None = None, prog: str = 'trl-suite') -> int:
    """Runs a command.

    Args:
      argv: arguments, without the program's name; by default those of the process.
      prog: name of the program in the help.

    Returns:
      The exit status: 0; 1 if a check of `doctor` failed; 2 after an error, with one
      line on stderr; 130 after an interrupt, 143 after SIGTERM.
    """
    arguments = argparse.Namespace()
    try:
        with program.terminable():
            _parser(prog).parse_args(argv, arguments)
            if sys.stdout is None:
                raise OSError('standard output is closed')
            command = engine.load(f'trl_suite.cli.{arguments.command}')
            status = command.run(arguments) or 0
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
        if isinstance(error, OSError) and error.errno == errno.ENOSPC:
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

    def add(name: str, text: str) -> argparse.ArgumentParser:
        command = commands.add_parser(
            name, help=text, description=text[0].upper() + text[1:] + '.',
            formatter_class=argparse.ArgumentDefaultsHelpFormatter,
        )  # fmt: skip
        command.set_defaults(command=name)
        return command

    def add_policy(command: argparse.ArgumentParser, default: str) -> None:
        command.add_argument(
            '--policy', default=default, type=_policy_name, metavar='POLICY',
            help=f'{", ".join(acting.POLICIES)}, or an .npz file; reference: the shipped policy, randomized: '
            'one that was trained in worlds and with sensors that vary, generalist: one for all terrains of '
            'a character; which some environments have',
        )  # fmt: skip

    def add_options(command: argparse.ArgumentParser) -> None:
        command.add_argument(
            '--option', type=_option, action='append', metavar='NAME=JSON', dest='options',
            help='option of the task, such as randomize=robot; the value is JSON or a name; may be repeated',
        )  # fmt: skip

    command = add('list', 'list the environments of the catalogue')
    for name in FILTERS:
        command.add_argument(f'--{name}', help=f'only environments of this {name}')
    command.add_argument(
        '--trained', action='store_true', help='only environments with a shipped policy'
    )

    command = add('info', 'describe one environment in full')
    command.add_argument('id', metavar='ID', help="id, or 'domain/task'")

    command = add('rollout', 'run a policy for a number of steps')
    command.add_argument('id', metavar='ID', help="id, or 'domain/task'")
    command.add_argument('--seed', type=int, default=0, help='seed of environment and policy')
    command.add_argument('--steps', type=_positive, default=256, help='number of control steps')
    add_policy(command, 'random')
    add_options(command)
    command.add_argument(
        '--video', type=pathlib.Path, metavar='FILE', help='write a video, .mp4 or .gif'
    )
    command.add_argument(
        '--html', type=pathlib.Path, metavar='FILE', help='write an interactive replay, .html'
    )
    command.add_argument(
        '--strip', type=pathlib.Path, metavar='FILE', help='write a film strip, .png'
    )
    command.add_argument('--columns', type=_positive, default=8, help='pictures in the strip')
    command.add_argument(
        '--trajectory', type=pathlib.Path, metavar='FILE', help='write all time steps, .npz'
    )
    command.add_argument('--ghost', action='store_true', help='show the reference clip as well')
    command.add_argument(
        '--size', type=_size, default='640x480', metavar='WxH', help='size of pictures in pixels'
    )
    command.add_argument('--camera', default='side', help='name of a camera')

    command = add(
        'view', "show an environment with a policy, in dm_control's viewer or in a web browser"
    )
    command.add_argument('id', metavar='ID', help="id, or 'domain/task'")
    command.add_argument(
        '--policy', default='best', type=_best_or_policy, metavar='POLICY',
        help=f'{", ".join(acting.POLICIES)}, or an .npz file; best: the first of these that exists',
    )  # fmt: skip
    command.add_argument('--seed', type=int, default=0, help='seed of environment and policy')
    add_options(command)
    command.add_argument(
        '--browser', action='store_true',
        help="show it in web browsers, with controls, instead of dm_control's viewer (F1: its keys)",
    )  # fmt: skip
    command.add_argument('--host', default='127.0.0.1', help='address to listen on with --browser')
    command.add_argument(
        '--port', type=_positive, default=8080, help='first port to try with --browser'
    )

    command = add('evaluate', 'run a policy for whole episodes, and print a summary')
    command.add_argument('id', metavar='ID', help="id, or 'domain/task'")
    add_policy(command, 'reference')
    add_options(command)
    command.add_argument('--episodes', type=_positive, default=50, help='number of episodes')
    command.add_argument(
        '--seed', type=int, default=0, help='seed of the environments and the policy'
    )
    command.add_argument(
        '--threads', type=int, default=0, help='threads of the physics; 0: all cores'
    )
    command.add_argument(
        '--step-limit', type=_positive, metavar='N',
        help="steps after which an episode is truncated, instead of the environment's limit",
    )  # fmt: skip
    command.add_argument(
        '--json', type=pathlib.Path, metavar='FILE', help='write all results, .json'
    )

    command = add('terrain', 'plot random grounds of a terrain, or write one as a mesh')
    command.add_argument(
        'terrain', metavar='NAME-or-FILE', help='a preset, or a .json or .txt file'
    )
    command.add_argument('--draws', type=_positive, default=3, help='number of grounds')
    command.add_argument(
        '--length', type=float, default=40.0, help='length of a profile, or side of a map, in m'
    )
    command.add_argument('--seed', type=int, default=0, help='seed of the grounds')
    command.add_argument(
        '--terrain-level', type=float, default=0.0, help='index of the parameter set'
    )
    command.add_argument(
        '--output', type=pathlib.Path, metavar='FILE',
        help='write a plot, .png, or a mesh of the first ground, .obj, .glb or .stl',
    )  # fmt: skip

    command = add('clip', 'retarget a motion file to a character, and check it')
    command.add_argument(
        'file', metavar='FILE', type=pathlib.Path,
        help='BVH, Acclaim (.amc), JSON of TerrainRL or DeepMimic, or a clip; recognised from the content',
    )  # fmt: skip
    command.add_argument('--character', required=True, help='name of a character')
    command.add_argument(
        '--skeleton', type=pathlib.Path, metavar='FILE', help='the .asf file of an .amc file'
    )
    command.add_argument(
        '--map', type=pathlib.Path, metavar='FILE',
        help="a .json that maps the character's joints to the motion's; by default usual names are tried",
    )  # fmt: skip
    command.add_argument(
        '--scale', type=float, help='scale of lengths; by default the ratio of limb lengths'
    )
    command.add_argument(
        '--cycle', nargs='*', type=float, metavar='TIME',
        help='cut one cycle, between two times (s), or without times the best cycle that is found',
    )  # fmt: skip
    command.add_argument('--frames', action='store_true', help='print the faults of every frame')
    command.add_argument('--output', type=pathlib.Path, metavar='FILE', help='write the clip, .npz')
    command.add_argument(
        '--strip', type=pathlib.Path, metavar='FILE', help='write a film strip, .png'
    )

    command = add('try', 'read a character from a file, print its properties, and render it')
    command.set_defaults(command='try_file')
    command.add_argument('file', metavar='FILE', type=pathlib.Path, help='an .xml, .mjcf or .urdf')
    command.add_argument(
        '--root', metavar='BODY', help='root of the character, parent of all other links'
    )
    command.add_argument(
        '--end-effectors', nargs='+', metavar='BODY', help='by default the last body of each limb'
    )
    command.add_argument(
        '--fall-links', nargs='*', metavar='BODY',
        help='links that must not touch the ground; without names there are none; by default the '
        'first that can touch it',
    )  # fmt: skip
    command.add_argument(
        '--spatial', action=argparse.BooleanOptionalAction,
        help="whether the character is three-dimensional; by default derived from the root's joints",
    )  # fmt: skip
    command.add_argument(
        '--turn', nargs=4, type=float, metavar=('W', 'X', 'Y', 'Z'),
        help='quaternion that rotates the character so that it faces +x, with z up',
    )  # fmt: skip
    command.add_argument(
        '--balance-inertia', action='store_true',
        help='replace moments of inertia that no body has by their mean',
    )  # fmt: skip
    command.add_argument(
        '--output',
        type=pathlib.Path,
        metavar='FILE',
        help='file of the picture on three terrains, .png',
    )

    add('doctor', 'check the installation; print problems and remedies')

    command = add('compile', 'compile environments, so that their first steps need not wait')
    command.add_argument('ids', metavar='ID', nargs='*', help="ids, or 'domain/task'")
    command.add_argument('--all', action='store_true', help='all environments of the catalogue')

    command = add('bench', 'measure the speed of this machine against raw MuJoCo')
    command.add_argument(
        'id',
        metavar='ID',
        nargs='?',
        default='PD_Biped2D_Gaps_Terrain-v0',
        help="id, or 'domain/task'",
    )
    command.add_argument(
        '--num-envs', type=_positive, default=64, help='simulations of the vector environment'
    )
    command.add_argument(
        '--threads', type=int, default=0, help='threads of the physics; 0: all cores'
    )
    command.add_argument(
        '--seconds', type=float, default=2.0, help='duration of each of four measurements'
    )
    command.add_argument(
        '--json', type=pathlib.Path, metavar='FILE', help='write all results, .json'
    )

    actions = add('sequences', 'benchmark of continual learning').add_subparsers(
        required=True, dest='action', metavar='action'
    )
    actions.add_parser('list', help='list the sequences')
    command = actions.add_parser(
        'run', help='train a learner on a sequence, and test it after each stage',
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )  # fmt: skip
    command.add_argument('name', metavar='NAME', help='name of a sequence')
    command.add_argument(
        '--learner', required=True, metavar='MODULE:CLASS',
        help='class of the learner: CLASS(sequence, seed), with the methods train(stage) and policy()',
    )  # fmt: skip
    command.add_argument('--budget', default='small', help='samples per stage: small, full, or N')
    command.add_argument(
        '--episodes', type=_positive, default=32, help='episodes per test and environment'
    )
    command.add_argument('--stages', type=_positive, metavar='N', help='stop after N stages')
    command.add_argument('--seed', type=int, default=0, help='seed of the run')
    command.add_argument(
        '--threads', type=int, default=0, help='threads of the physics; 0: all cores'
    )
    command.add_argument(
        '--output', type=pathlib.Path, default='result.json', metavar='FILE',
        help='result, .json; an unfinished run is resumed',
    )  # fmt: skip
    command = actions.add_parser('check', help='check results: fields, budget and metrics')
    command.add_argument(
        'files', nargs='+', type=pathlib.Path, metavar='FILE', help='a result, .json'
    )
    return parser


def _positive(text: str) -> int:
    with contextlib.suppress(ValueError):
        if int(text) > 0:
            return int(text)
    raise argparse.ArgumentTypeError(f'{text!r} is not a positive integer')


def _option(text: str) -> tuple[str, object]:
    """Returns name and value of an option; a value that is not JSON is a string."""
    name, equals, value = text.partition('=')
    if not (name and equals):
        raise argparse.ArgumentTypeError(f'{text!r} is not NAME=JSON, such as randomize=robot')
    try:
        return name, json.loads(value)
    except (ValueError, RecursionError):
        if value[:1] in ('{', '[', '"'):
            raise argparse.ArgumentTypeError(f'the value of {text!r} is not JSON') from None
        return name, value


def _policy_name(text: str) -> str:
    try:
        return acting.check(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _best_or_policy(text: str) -> str:
    return text if text == 'best' else _policy_name(text)


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r'(\d+)x(\d+)', text)
    if not match:
        raise argparse.ArgumentTypeError(f'{text!r} is not a size such as 640x480')
    return int(match[1]), int(match[2])
