"""Comparisons of trainings: results in a JSON file, a table on a page, and a picture."""

from __future__ import annotations

import argparse
import json
import pathlib
from collections.abc import Callable, Mapping
from typing import Any

import tqdm

from trl_suite.util import files


def parser(description: str, seeds: list[int], path: str) -> argparse.ArgumentParser:
    """Returns a parser with the arguments of all comparisons."""
    parser_ = argparse.ArgumentParser(description=description)
    parser_.add_argument('--seeds', type=int, nargs='+', default=seeds)
    parser_.add_argument('--json', type=pathlib.Path, default=pathlib.Path(path))
    parser_.add_argument('--page', type=pathlib.Path, help='a page whose table is replaced')
    parser_.add_argument(
        '--picture', type=pathlib.Path, help='a file for the curves; needs matplotlib'
    )
    return parser_


def complete(
    path: pathlib.Path, head: Mapping[str, Any], jobs: Mapping[str, Callable[[], Any]]
) -> dict[str, Any]:
    """Runs the jobs whose results are not in a JSON file yet, and adds each one to it.

    Args:
      path: the file; it need not exist.
      head: what all results have in common.
      jobs: key -> function that returns a result.

    Returns:
      The head, and `results`: key -> result.

    Raises:
      ValueError: the file has another head.
    """
    found: dict[str, Any] = {**head, 'results': {}}
    if path.exists():
        found = json.loads(path.read_text())
        for name, value in head.items():
            if found[name] != value:
                raise ValueError(
                    f'{path}: {name} is {found[name]}, not {value}; give another --json'
                )
    for key, job in tqdm.tqdm(jobs.items(), unit='run'):
        if key not in found['results']:
            found['results'][key] = job()
            files.write_json(found, path)
    return found


def show(
    found: dict[str, Any],
    table: Callable[[dict[str, Any]], str],
    plot: Callable[[dict[str, Any], pathlib.Path], None],
    marks: tuple[str, str],
    arguments: argparse.Namespace,
) -> None:
    """Prints the table of the results, and writes page and picture, if asked."""
    print(text := table(found))
    if arguments.picture is not None:
        plot(found, arguments.picture)
    if arguments.page is not None:
        files.replace_between(arguments.page, *marks, text)
