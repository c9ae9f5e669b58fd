"""Files of training runs: checkpoints, with a check of their integrity, and curves; one run per folder.

A checkpoint is a line that names the format, a line with the SHA-256 of the rest, and the output of
`torch.save`. It is read with `weights_only`, so that loading a file cannot run code: it may contain
dicts, lists, tuples, numbers, strings, tensors and arrays.
"""

from __future__ import annotations

import codecs
import contextlib
import dataclasses
import hashlib
import io
import json
import pathlib
import re
from collections.abc import Collection, Iterator
from typing import Any

import numpy as np
import torch

from trl_suite.util import files

FORMAT = b'trl_suite checkpoint 1\n'
LARGEST = 2**32  # bytes
# Globals in pickled arrays; `bytes` in empty ones.
ARRAYS = [
    np.ndarray, np.dtype, np._core.multiarray._reconstruct, np._core.multiarray.scalar, codecs.encode,
    bytes,
    *(type(np.dtype(kind)) for kind in '?bhilqBHILQefd'),
]  # fmt: skip


def write_curve(
    folder: pathlib.Path, id_: str, seed: int, settings: Any, threads: int, curve: list[Any],
    **more: Any,
) -> None:  # fmt: skip
    """Writes `curve.json`: the learning curve of a run, its settings, a dataclass, and `more`."""
    record = {
        'id': id_, 'seed': seed, **more, 'settings': dataclasses.asdict(settings),
        'threads': threads, 'curve': curve,
    }  # fmt: skip
    with files.replacing(folder / 'curve.json') as part:
        part.write_text(json.dumps(record, indent=1))  # settings may be infinite


def save(state: dict[str, Any], path: pathlib.Path) -> None:
    """Writes a checkpoint; an old one is replaced only when the new one is complete."""
    content = io.BytesIO()
    torch.save(state, content)
    data = content.getbuffer()
    with files.replacing(path) as part, part.open('wb') as file:
        file.write(FORMAT)
        file.write(hashlib.sha256(data).hexdigest().encode() + b'\n')
        file.write(data)


def load(path: pathlib.Path) -> dict[str, Any]:
    """Returns the state in a checkpoint.

    Raises:
      ValueError: the file is too large or damaged, has another format, or contains other objects;
        the message has its path.
    """
    file = io.BytesIO(files.read_bytes(path, LARGEST))
    known = file.readline(len(FORMAT)) == FORMAT
    digest, data = file.readline(66).strip(), file.read()
    remedy = 'remove it to start again'
    if not known:
        raise ValueError(
            f'{path}: not a checkpoint of this version (or its beginning is damaged); {remedy}'
        )
    if hashlib.sha256(data).hexdigest().encode() != digest:
        raise ValueError(f'{path}: the checkpoint is damaged or incomplete; {remedy}')
    try:
        with torch.serialization.safe_globals(ARRAYS):
            return torch.load(io.BytesIO(data), weights_only=True)
    except (
        Exception
    ) as error:  # UnpicklingError and others; torch's message suggests to trust the file
        other = re.search(r'GLOBAL (\S+)', str(error))
        raise ValueError(
            f'{path}: the checkpoint contains {other[1] if other else "other objects"}; '
            f'expected arrays, numbers and strings; {remedy}'
        ) from None


def load_run(
    folder: pathlib.Path, settings: Any, changeable: Collection[str] = ()
) -> dict[str, Any]:
    """Returns the state in the checkpoint of a run.

    Args:
      folder: of the run; the file is `checkpoint.pt`.
      settings: settings with which the run continues, a dataclass.
      changeable: names of settings that may differ from those in the checkpoint.

    Raises:
      ValueError: as `load`, or the checkpoint has other settings.
    """
    state, own = load(folder / 'checkpoint.pt'), dataclasses.asdict(settings)
    if {**state['settings'], **{name: own[name] for name in changeable}} != own:
        raise ValueError(f'{folder} holds a run with other settings: {state["settings"]}')
    return state


@contextlib.contextmanager
def only_run(folder: pathlib.Path) -> Iterator[None]:
    """Creates a folder, and locks it against other runs until this run ends or its process dies.

    Raises:
      RuntimeError: another process trains in the folder; the message has its id.
    """
    folder.mkdir(parents=True, exist_ok=True)
    what = f'trains in {folder}; wait for it, or give another --output'
    with files.locked(folder / '.lock', what):
        yield
