"""Copies the files of a training run to persistent storage: a folder, or a URL of fsspec.

Examples of URLs: `s3://bucket/runs`, `gs://bucket/runs`, `sftp://host/home/me/runs`. Most protocols need an
additional package, which fsspec names if it is missing.
"""

from __future__ import annotations

import contextlib
import os
import pathlib
import sys
import tempfile
import threading
import uuid
from collections.abc import Iterator

import fsspec
import runs

CHECKPOINT = 'checkpoint.pt'
EVERY = 5.0  # s; interval at which a new checkpoint is looked for


def absolute(url: str) -> str:
    """Returns a URL unchanged, and the absolute path of a folder."""
    return url if '://' in url else os.path.abspath(url)


def fetch(url: str, folder: pathlib.Path) -> None:
    """Copies the files of a run into a folder; there may be none."""
    system, path = fsspec.core.url_to_fs(url)
    if not system.exists(path):
        return
    for found in system.find(path):
        name = found.removeprefix(path).lstrip('/')
        if not _hidden(name):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            system.get_file(found, str(folder / name))


def _names(folder: pathlib.Path) -> list[str]:
    """Returns the files in a folder and in its subfolders, but hidden ones."""
    paths = (path for path in folder.rglob('*') if path.is_file())
    names = (path.relative_to(folder).as_posix() for path in paths)
    return [name for name in names if not _hidden(name)]


def _hidden(name: str) -> bool:
    return any(part.startswith('.') for part in name.split('/'))


def put(folder: pathlib.Path, url: str) -> None:
    """Copies the files of a run to a store.

    A file replaces that of the store only when it is complete. The checkpoint is copied last, so that the
    files that it needs are present.
    """
    system, path = fsspec.core.url_to_fs(url)
    for name in sorted(_names(folder), key=lambda name: name.endswith(CHECKPOINT)):
        place, _, own = f'{path}/{name}'.rpartition('/')
        system.makedirs(place, exist_ok=True)
        part = f'{place}/.{own}.{uuid.uuid4().hex}.part'
        system.put_file(str(folder / name), part)
        system.mv(part, f'{place}/{own}')


def remove(url: str) -> None:
    """Removes the files of a run; there may be none.

    Raises:
      FileExistsError: there are files, but none that a run writes.
    """
    system, path = fsspec.core.url_to_fs(url)
    if not system.exists(path):
        return
    if system.find(path) and not any(system.exists(f'{path}/{name}') for name in runs.WRITTEN):
        raise FileExistsError(f'{url}: is not the folder of a run; remove it, or choose another')
    system.rm(path, recursive=True)


@contextlib.contextmanager
def kept(folder: pathlib.Path, url: str) -> Iterator[None]:
    """Copies a run from a store, and back to it after each checkpoint and at the end."""
    fetch(url, folder)
    ended = threading.Event()
    thread = threading.Thread(target=_follow, args=(folder, url, ended), daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
    put(folder, url)


def _follow(folder: pathlib.Path, url: str, ended: threading.Event) -> None:
    before = _written(folder)
    while not ended.wait(EVERY):
        now = _written(folder)
        if now == before:
            continue
        # Files are replaced, never changed, so hard links keep the current versions. The checkpoint is
        # linked first, so that the other files are not older.
        with tempfile.TemporaryDirectory(dir=folder.parent) as moment:
            for name in sorted(_names(folder), key=lambda name: not name.endswith(CHECKPOINT)):
                linked = pathlib.Path(moment, name)
                linked.parent.mkdir(parents=True, exist_ok=True)
                with contextlib.suppress(FileNotFoundError):
                    os.link(folder / name, linked)
            try:
                put(pathlib.Path(moment), url)
            except Exception as error:  # of any file system; the next copy may succeed
                print(f'{url}: {error}', file=sys.stderr)
            else:
                before = now


def _written(folder: pathlib.Path) -> int:
    """Returns the time at which the last checkpoint was written, ns; 0 if there is none."""
    return max((path.stat().st_mtime_ns for path in folder.rglob(CHECKPOINT)), default=0)
