"""Archives of named arrays (.npz) without pickled objects, written atomically."""

from __future__ import annotations

import os
import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from trl_suite.util.files import load_arrays, replacing


def write(path: str | os.PathLike[str], fields: Mapping[str, Any]) -> None:
    """Writes an archive; an existing file is replaced only when the new one is complete."""
    arrays = {name: np.asarray(value) for name, value in fields.items()}
    with replacing(pathlib.Path(path)) as part, part.open('wb') as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def read(
    path: pathlib.Path,
    what: str,
    fields: Mapping[str, tuple[str, int] | None],
    defaults: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Returns the fields of an archive.

    Args:
      path: file.
      what: what the file should contain, for messages.
      fields: names of the fields. The value of a field that becomes a Python object is the allowed
        kinds of its dtype and its number of axes; None means an array, which the caller checks.
      defaults: values of fields that may be missing.
    """
    found: dict[str, Any] = {}
    field = ''
    try:
        archive = load_arrays(path)
        for field in fields:
            if field in archive:
                found[field] = archive[field]
            elif not defaults or field not in defaults:
                raise ValueError('is missing')
    except FileNotFoundError:
        raise
    except Exception as error:  # a corrupt archive raises many types of exceptions
        where = f'field {field!r}' if field else f'no readable {what}'
        raise ValueError(f'{path}: {where}: {error}'.replace(f' {path}:', '')) from None
    for field, value in found.items():
        form = fields[field]
        if form is None:
            continue
        kinds, axes = form
        if value.dtype.kind not in kinds or value.ndim != axes:
            raise ValueError(f'{path}: field {field!r} has type {value.dtype}, {value.ndim} axes')
        found[field] = value.tolist()
    return {**(defaults or {}), **found}
