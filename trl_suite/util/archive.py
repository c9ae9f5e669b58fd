"""Archives of named arrays (.npz) without pickled objects, written atomically."""

from __future__ import annotations

import io
import math
import os
import pathlib
import zipfile
from collections.abc import Mapping
from typing import Any

import numpy as np

from trl_suite.util.files import LARGEST, check_path, check_size, read_bytes, replacing

MOST_EMPTY = 10**6  # elements of an array without content


def write(path: str | os.PathLike[str], fields: Mapping[str, Any]) -> None:
    """Writes an archive; an existing file is replaced only when the new one is complete.

    Raises:
      ValueError: another suffix than .npz, or a field that would be pickled.
      OSError: the file cannot be written.
    """
    arrays: dict[str, Any] = {name: np.asarray(value) for name, value in fields.items()}
    for name, array in arrays.items():  # NumPy before 2.2 cannot be told not to pickle
        if array.dtype.hasobject:
            raise ValueError(f'field {name!r}: holds objects; expected numbers or text')
    with replacing(check_path(path, ('.npz',))) as part, part.open('wb') as file:
        np.savez_compressed(file, **arrays)


Forms = dict[str, tuple[str, int]]  # by field: the kinds of dtypes, and the number of axes


def forms(text: str) -> Forms:
    """Returns the forms of fields from text, e.g. 'times fiu 1, joints U 1'."""
    parts = (part.split() for part in text.split(','))
    return {name: (kinds, int(axes)) for name, kinds, axes in parts}


def arrays(path: pathlib.Path, what: str, largest: int = LARGEST) -> dict[str, np.ndarray]:
    """Returns the arrays of an archive by name; `what` is what it should contain, for messages.

    Raises:
      ValueError: a corrupt file; the message has the path and the field.
      FileNotFoundError: there is no file at the path.
    """
    found: dict[str, np.ndarray] = {}
    field = ''
    try:
        content = io.BytesIO(read_bytes(path))
        with zipfile.ZipFile(content) as entries:
            check_size(path, largest, sum(entry.file_size for entry in entries.infolist()))
        content.seek(0)
        with np.load(content, allow_pickle=False) as archive:
            for field in archive.files:
                found[field] = array = archive[field]
                if not isinstance(array, np.ndarray):
                    raise ValueError('is not an array')
                # Lists of more elements than bytes would take all memory.
                if math.prod(max(n, 1) for n in array.shape) > max(array.nbytes, MOST_EMPTY):
                    raise ValueError(
                        f'has shape {array.shape}, of type {array.dtype} without content'
                    )
    except FileNotFoundError:
        raise
    except Exception as error:  # a corrupt archive raises many types of exceptions
        where = f'field {field!r}' if field else f'no readable {what}'
        raise ValueError(f'{path}: {where}: {error}'.replace(f' {path}:', '')) from None
    return found


def take(found: dict[str, np.ndarray], name: str, kinds: str, axes: int) -> np.ndarray:
    """Takes out an array whose dtype has one of the kinds, unless it is empty, and which has so many axes."""
    if name not in found:
        raise ValueError(f'field {name!r}: is missing')
    array = found.pop(name)
    if (array.size and array.dtype.kind not in kinds) or array.ndim != axes:
        raise ValueError(f'field {name!r}: has type {array.dtype} and {array.ndim} axes')
    return array


def fields(found: dict[str, np.ndarray], wanted: Forms) -> dict[str, Any]:
    """Takes out the arrays of fields, by name."""
    return {name: take(found, name, *form) for name, form in wanted.items()}
