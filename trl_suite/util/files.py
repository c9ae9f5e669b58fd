"""Files that appear under their names when they are complete, never before."""

from __future__ import annotations

import contextlib
import difflib
import json
import os
import pathlib
from collections.abc import Iterator
from typing import Any

Path = str | os.PathLike[str]


def check_path(path: Path, suffixes: tuple[str, ...]) -> pathlib.Path:
    """Returns a path that can be written, so that nobody waits for a file that cannot be.

    Raises:
      ValueError: the suffix is none of the given ones.
      OSError: the folder does not exist, or the path is a folder.
    """
    path = pathlib.Path(path)
    _check_suffix(path, suffixes)
    if not path.parent.is_dir():
        raise FileNotFoundError(f'{path}: the folder {str(path.parent)!r} does not exist')
    if path.is_dir():
        raise IsADirectoryError(f'{path}: is a folder')
    return path


def existing(path: Path, suffixes: tuple[str, ...]) -> pathlib.Path:
    """Returns a path that can be read.

    Raises:
      ValueError: the suffix is none of the given ones.
      FileNotFoundError: there is no such file; the message has those with similar names beside it.
    """
    path = pathlib.Path(path)
    _check_suffix(path, suffixes)
    if not path.is_file():
        beside = [p.name for p in path.parent.glob('*')] if path.parent.is_dir() else []
        near = difflib.get_close_matches(path.name, beside, n=3, cutoff=0.5)
        hint = f'; did you mean {" or ".join(map(repr, near))}?' if near else ''
        raise FileNotFoundError(f'{path}: there is no such file{hint}')
    return path


def _check_suffix(path: pathlib.Path, suffixes: tuple[str, ...]) -> None:
    if path.suffix.lower() not in suffixes:
        raise ValueError(
            f'{path}: unknown suffix {path.suffix!r}; expected {" or ".join(suffixes)}'
        )


@contextlib.contextmanager
def replacing(path: pathlib.Path) -> Iterator[pathlib.Path]:
    """Yields a temporary path beside `path` that takes its place once all went well."""
    part = path.with_name(f'.{path.stem}.{os.getpid()}.part{path.suffix}')
    try:
        yield part
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def write_json(content: Any, path: pathlib.Path) -> None:
    """Writes a .json file, readable by people too.

    Raises:
      ValueError: the content has a number that is not finite.
      OSError: the file cannot be written.
    """
    with replacing(path) as part:
        part.write_text(f'{json.dumps(content, indent=1, allow_nan=False)}\n', encoding='utf-8')
