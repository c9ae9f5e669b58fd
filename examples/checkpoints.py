"""Checkpoints of training runs: whole or refused, without pickled objects; one run per folder.

A checkpoint is a line that names the format, a line with the SHA-256 of the rest, and what `torch.save`
writes. It is read with `weights_only`, which lets no file run code: dicts, lists, tuples, numbers,
strings, tensors and arrays may be in it.
"""

from __future__ import annotations

import codecs
import contextlib
import hashlib
import io
import pathlib
import re
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch

from trl_suite.util import files

FORMAT = b'trl_suite checkpoint 1\n'
# What arrays are pickled as.
ARRAYS = [
    np.ndarray, np.dtype, np._core.multiarray._reconstruct, np._core.multiarray.scalar, codecs.encode,
    *(type(np.dtype(kind)) for kind in '?bhilqBHILQefd'),
]  # fmt: skip


def save(state: dict[str, Any], path: pathlib.Path) -> None:
    """Writes a checkpoint; an old one stays until the new one is whole."""
    content = io.BytesIO()
    torch.save(state, content)
    data = content.getbuffer()
    with files.replacing(path) as part, part.open('wb') as file:
        file.write(FORMAT)
        file.write(hashlib.sha256(data).hexdigest().encode() + b'\n')
        file.write(data)


def load(path: pathlib.Path) -> dict[str, Any]:
    """Returns what was saved.

    Raises:
      ValueError: the file is damaged, of another format, or holds other objects; the message names it.
    """
    with path.open('rb') as file:
        known = file.readline(len(FORMAT)) == FORMAT
        digest, data = file.readline(66).strip(), file.read()
    remedy = 'remove it to begin anew'
    if not known:
        raise ValueError(
            f'{path}: no checkpoint of this version (or its beginning is damaged); {remedy}'
        )
    if hashlib.sha256(data).hexdigest().encode() != digest:
        raise ValueError(f'{path}: the checkpoint is damaged or cut off; {remedy}')
    try:
        with torch.serialization.safe_globals(ARRAYS):
            return torch.load(io.BytesIO(data), weights_only=True)
    except Exception as error:  # of the reader's own kinds; what it says advises to trust the file
        other = re.search(r'GLOBAL (\S+)', str(error))
        raise ValueError(
            f'{path}: no checkpoint that can be read: it holds {other[1] if other else "other objects"}; '
            f'expected arrays, numbers and strings; {remedy}'
        ) from None


@contextlib.contextmanager
def only_run(folder: pathlib.Path) -> Iterator[None]:
    """Makes a folder, and refuses a second run in it as long as this one lasts, however it ends.

    Raises:
      RuntimeError: another process trains in the folder; the message has its number.
    """
    folder.mkdir(parents=True, exist_ok=True)
    what = f'trains in {folder}; wait for it, or give another --output'
    with files.locked(folder / '.lock', what):
        yield
