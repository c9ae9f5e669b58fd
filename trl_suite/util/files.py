"""Reading of strangers' files, checks of paths, and atomic writing of files."""

from __future__ import annotations

import contextlib
import difflib
import io
import json
import os
import pathlib
import re
import secrets
import stat
import tempfile
from collections.abc import Iterator, Mapping
from typing import Any, TextIO

from trl_suite.util import errors
from trl_suite.util.libraries import optional

fcntl = optional('fcntl')  # Windows has none
Path = str | os.PathLike[str]
LARGEST = 2**28  # bytes of a file, or of the arrays of an archive, 268 MB


def check_path(path: Path, suffixes: tuple[str, ...]) -> pathlib.Path:
    """Returns the path of a file to be written; checks it before a long computation starts.

    Raises:
      ValueError: the suffix is not one of `suffixes`, or the path is a pipe or a device.
      OSError: the folder does not exist or cannot be written, the path is a folder, or the system
        does not accept the name.
    """
    path = pathlib.Path(path)
    _check_suffix(path, suffixes)
    if not path.parent.is_dir():
        raise FileNotFoundError(f'{path}: the folder {str(path.parent)!r} does not exist')
    if path.is_dir():
        raise IsADirectoryError(f'{path}: is a folder')
    if path.exists():
        _check_regular(path)
    trial = _beside(path, 'test')
    try:
        try:
            trial.touch()
        finally:
            trial.unlink(missing_ok=True)
    except PermissionError:
        raise PermissionError(
            f'{path}: the folder {str(path.parent)!r} cannot be written'
        ) from None
    except OSError as error:
        error.filename = str(path)
        raise
    return path


def existing(path: Path, suffixes: tuple[str, ...] | None = None) -> pathlib.Path:
    """Returns the path of an existing file.

    Raises:
      ValueError: suffixes are given, and that of the path is not one of them; or it is not a
        regular file.
      FileNotFoundError: there is no such file; the message has similar names in the same folder.
    """
    path = pathlib.Path(path)
    if suffixes is not None:
        _check_suffix(path, suffixes)
    if not path.exists():
        beside = [p.name for p in path.parent.glob('*')] if path.parent.is_dir() else []
        near = difflib.get_close_matches(path.name, beside, n=3, cutoff=0.5)
        hint = f'; did you mean {" or ".join(map(repr, near))}?' if near else ''
        raise FileNotFoundError(f'{path}: there is no such file{hint}')
    _check_regular(path)
    return path


def _check_regular(path: pathlib.Path) -> None:
    """Refuses folders, pipes, sockets and devices; opening a pipe would wait for its other end."""
    if not path.is_file():
        raise ValueError(f'{path}: is a folder, a pipe or a device; expected a regular file')


def _check_suffix(path: pathlib.Path, suffixes: tuple[str, ...]) -> None:
    if path.suffix.lower() not in suffixes:
        raise ValueError(
            f'{path}: unknown suffix {path.suffix!r}; expected {" or ".join(suffixes)}'
        )


def check_size(path: Path, largest: int = LARGEST, size: int | None = None) -> None:
    """Checks a file before it is read: its size, or that of its content if it differs, bytes."""
    if size is None:
        size = pathlib.Path(path).stat().st_size
        _check_regular(pathlib.Path(path))
    if size > largest:
        raise ValueError(
            f'{path}: has {size / 1e6:.0f} MB; expected no more than {largest / 1e6:.0f} MB'
        )


def check_own(path: Path, status: os.stat_result) -> None:
    """Checks that no other user can have written a file, or to a folder.

    Nothing is checked on systems without user ids, such as Windows. `path` is for the message of
    the PermissionError.
    """
    if not hasattr(os, 'geteuid'):
        return
    if status.st_uid != os.geteuid():
        raise PermissionError(f'{path} belongs to another user')
    if status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise PermissionError(f'{path} can be written by other users')


def read_bytes(path: Path, largest: int = LARGEST) -> bytes:
    """Returns the content of a file; errors are those of `check_size`."""
    check_size(path, largest)
    with open(path, 'rb') as file:
        size = os.fstat(file.fileno()).st_size
        content = file.read(size + 1)
    if len(content) > size:  # as of those in /proc
        raise ValueError(f'{path}: has more than its size; expected a regular file')
    return content


def read_text(path: Path) -> str:
    """Returns the text of a file."""
    content = io.BytesIO(read_bytes(path))
    try:
        return io.TextIOWrapper(content, encoding='utf-8-sig').read()
    except UnicodeDecodeError as error:
        raise ValueError(
            f'{path}: not text in UTF-8: {error.reason} at byte {error.start}'
        ) from None


def without_repetition(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Returns an object of JSON, as a hook of `json.loads`; a key that is given twice is an error."""
    content: dict[str, Any] = {}
    for key, value in pairs:
        if key in content:
            raise ValueError(f'key {key!r} is given twice')
        content[key] = value
    return content


def read_json(path: Path) -> Any:
    """Returns the content of a JSON file, whose objects may not repeat keys."""
    text = read_text(path)
    try:
        return json.loads(text, object_pairs_hook=without_repetition)
    except RecursionError:
        raise ValueError(f'{path}: not JSON: nested too deeply') from None
    except ValueError as error:  # also raised for integers with too many digits
        raise ValueError(f'{path}: not JSON: {error}') from None


@contextlib.contextmanager
def replacing(path: pathlib.Path) -> Iterator[pathlib.Path]:
    """Yields a temporary path in the same folder; the file replaces `path` if nothing is raised.

    Raises:
      OSError: any that is raised inside; the path is added if the error has none, as for errors of
        `write`.
    """
    part = _beside(path, 'part')
    try:
        yield part
        os.replace(part, path)
    except OSError as error:
        if error.errno is not None and error.filename in (None, str(part), part):
            error.filename = str(path)
        raise
    finally:
        part.unlink(missing_ok=True)


def write_text(text: str, path: pathlib.Path) -> None:
    """Writes a text file in UTF-8; see `replacing`."""
    with replacing(path) as part:
        part.write_text(text, encoding='utf-8')


def _beside(path: pathlib.Path, kind: str) -> pathlib.Path:
    """Returns a temporary name; its suffix is in lower case, as libraries that write files need it."""
    # Processes on other machines or in other containers may have the same number.
    number = f'{os.getpid()}-{secrets.token_hex(4)}'
    return path.with_name(f'.{path.stem}.{number}.{kind}{path.suffix.lower()}')


def folder_beside(path: pathlib.Path) -> tempfile.TemporaryDirectory[str]:
    """Returns a temporary folder from or to which `path` can be renamed; a context, as `replacing`."""
    return tempfile.TemporaryDirectory(
        prefix=f'.{path.name}.', suffix='.part', dir=path.parent, ignore_cleanup_errors=True
    )


def remove_folder(path: pathlib.Path) -> None:
    """Removes a folder with all that is in it; a process that is killed meanwhile leaves all or none."""
    with folder_beside(path) as outer:
        os.replace(path, pathlib.Path(outer, path.name))


def between(page: str, name: str, program: str, text: str) -> str:
    """Returns a page with other lines between the marks of a text that a program writes.

    Raises:
      ValueError: the page lacks a mark.
    """
    begin, end = f'<!-- {name}, written by {program} -->', f'<!-- /{name} -->'
    before, found, rest = page.partition(begin)
    _, ended, after = rest.partition(end)
    if not (found and ended):
        raise ValueError(f'expected the lines {begin!r} and {end!r}')
    return f'{before}{begin}\n{text}\n{end}{after}'


def replace_between(path: pathlib.Path, name: str, program: str, text: str) -> None:
    """Replaces the lines between the marks in a page, see `between`."""
    with errors.naming(path):
        new = between(path.read_text(encoding='utf-8'), name, program, text)
    write_text(new, path)


@contextlib.contextmanager
def locked(path: pathlib.Path, what: str | None = None) -> Iterator[None]:
    """Holds a lock file that names this process; a process that ends in any way releases it.

    Nothing is locked on systems without `fcntl`, such as Windows, and on file systems without locks.

    Args:
      path: the lock file; removed at the end.
      what: what another process that has the lock does, for the message; None waits for that process.

    Raises:
      RuntimeError: another process has the lock; the message has its number.
      OSError: the file cannot be written, or is a link, or no lock file.
    """
    if fcntl is None:
        yield
        return
    while True:
        with _opened_lock(path) as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | (0 if what is None else fcntl.LOCK_NB))
            except BlockingIOError:
                raise RuntimeError(f'process {file.read().strip() or "?"} {what}') from None
            except OSError:
                pass  # the file system has no locks
            if not _is_at(path, file):
                continue  # the process that had the lock has just removed this file
            if not re.fullmatch(r'\d*\n?', file.read(100)):
                raise FileExistsError(f'{path}: is no lock file; move it away')
            file.seek(0)
            file.truncate()
            file.write(f'{os.getpid()}\n')
            file.flush()
            try:
                yield
            finally:
                if _is_at(path, file):  # and not the lock of a process that made the folder anew
                    path.unlink(missing_ok=True)
            return


def _is_at(path: pathlib.Path, file: TextIO) -> bool:
    try:
        return os.path.samestat(os.stat(path), os.fstat(file.fileno()))
    except FileNotFoundError:
        return False


def _opened_lock(path: pathlib.Path) -> TextIO:
    """Opens a lock file, or creates it; does not follow links, or wait for a pipe."""
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK
    number = os.open(path, flags, 0o666)
    if not stat.S_ISREG(os.fstat(number).st_mode):
        os.close(number)
        raise FileExistsError(f'{path}: is no lock file; move it away')
    return os.fdopen(number, 'r+', encoding='utf-8', errors='replace')


def write_json(
    content: Any, path: pathlib.Path, indent: int | None = 1, allow_nan: bool = False
) -> None:
    """Writes a .json file, in one line if `indent` is None."""
    write_text(json.dumps(content, indent=indent, allow_nan=allow_nan) + '\n', path)


@contextlib.contextmanager
def changing(
    path: pathlib.Path, start: Mapping[str, Any] | None = None, **how: Any
) -> Iterator[dict[str, Any]]:
    """Yields the content of a .json file, to be changed, and writes it if it was.

    Other processes that change the file in this way wait meanwhile, so that none erases what another
    has added.

    Args:
      path: the file; its folder is made.
      start: content of a new file. An existing one must have the same settings, which are all values
        but lists and objects.
      **how: options of `write_json`.

    Raises:
      ValueError: the file has other settings.
    """
    content = json.loads(json.dumps(start or {}))
    settings = {
        name: value for name, value in content.items() if not isinstance(value, (dict, list))
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    with locked(path.with_name(f'.{path.name}.lock')):
        if path.exists():
            content = read_json(path)
        before = json.dumps(content)
        for name, value in settings.items():
            if content.get(name) != value:
                other = f'{name} is {content.get(name)!r}, not {value!r}'
                raise ValueError(f'{path} has other settings: {other}; give these, or another file')
        yield content
        if json.dumps(content) != before:
            write_json(content, path, **how)
