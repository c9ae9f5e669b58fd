"""What the arguments of several commands have in common."""

from __future__ import annotations

import argparse
import json
import pathlib
from collections.abc import Callable
from typing import Any

from trl_suite.environments import named_policies as acting
from trl_suite.util import files

Run = Callable[[argparse.Namespace], int | None]


def add_command(
    commands: Any, name: str, text: str, run: Run | None = None
) -> argparse.ArgumentParser:
    """Adds a command to the result of `add_subparsers`.

    `text` says what it does, and `run`, which returns the exit status or None, does it.
    """
    command = commands.add_parser(
        name,
        help=text,
        description=f'{text[0].upper()}{text[1:]}.',
        formatter_class=_Help,
    )
    command.set_defaults(run=run)
    return command


class _Help(argparse.ArgumentDefaultsHelpFormatter):
    """Shows defaults, except for None, which is none."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        return action.help if action.default is None else super()._get_help_string(action)


def check_used(arguments: argparse.Namespace, name: str, *users: str) -> None:
    """Raises a ValueError if an option, by its name in Python, is given without those that use it."""
    given = (getattr(arguments, each) for each in users)
    if getattr(arguments, name) and not any(given):
        names = (f'--{each.replace("_", "-")}' for each in (name, *users))
        raise ValueError(f'{next(names)} has no effect without {" or ".join(names)}')


def add_id(command: argparse.ArgumentParser, **options: Any) -> None:
    """Adds the id of an environment."""
    command.add_argument('id', metavar='ID', help="id, or 'domain/task'", **options)


def add_policy(command: argparse.ArgumentParser, default: str) -> None:
    """Adds the name of a policy."""
    text = (
        f'{", ".join(acting.POLICIES)}, or an .npz file; reference: the shipped policy, randomized: '
        'one that was trained in worlds and with sensors that vary, generalist: one for all terrains '
        'of a character; which some environments have'
    )
    command.add_argument(
        '--policy', default=default, type=valid(acting.check), metavar='POLICY', help=text
    )


def add_options(command: argparse.ArgumentParser) -> None:
    """Adds options of the task, a list of names and values."""
    text = (
        'option of the task, such as randomize=robot; the value is JSON or a name; may be repeated'
    )
    command.add_argument(
        '--option', type=_option, action='append', metavar='NAME=JSON', dest='options', help=text
    )


def options_of(arguments: argparse.Namespace) -> dict[str, Any]:
    """Returns the options of the task by name.

    Raises:
      ValueError: one is given twice.
    """
    return files.without_repetition(arguments.options or [])


def add_threads(command: argparse.ArgumentParser) -> None:
    """Adds the number of threads."""
    text = 'threads of the physics; 0: all cores'
    command.add_argument('--threads', type=int, default=0, help=text)


def add_file(command: argparse.ArgumentParser, name: str, text: str, *suffixes: str) -> None:
    """Adds a file, whose path is checked before the command runs, if suffixes are given."""
    kind = valid(lambda path: files.check_path(path, suffixes)) if suffixes else pathlib.Path
    command.add_argument(name, type=kind, metavar='FILE', help=text)


def valid(convert: Callable[[str], Any]) -> Callable[[str], Any]:
    """Returns a type of arguments: a function whose ValueErrors are shown to the user."""

    def converted(text: str) -> Any:
        try:
            return convert(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    return converted


@valid
def positive(text: str) -> int:
    """Converts a positive integer."""
    if not (text.isdecimal() and int(text)):
        raise ValueError(f'{text!r} is not a positive integer')
    return int(text)


def _option(text: str) -> tuple[str, object]:
    """Returns name and value of an option; a value that is not JSON is a string."""
    name, equals, value = text.partition('=')
    if not (name and equals):
        raise argparse.ArgumentTypeError(f'{text!r} is not NAME=JSON, such as randomize=robot')
    if name == 'random':
        raise argparse.ArgumentTypeError(f'{text!r}: the seed is no option; use --seed')
    try:
        return name, json.loads(value, object_pairs_hook=files.without_repetition)
    except (ValueError, RecursionError) as error:
        if value[:1] in ('{', '[', '"'):
            raise argparse.ArgumentTypeError(
                f'the value of {text!r} is not JSON: {error}'
            ) from None
        return name, value
