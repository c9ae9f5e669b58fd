"""Archives of named arrays (.npz) without pickled objects: whole or not at all."""

from __future__ import annotations

import io
import os
import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np


def write(path: str | os.PathLike[str], fields: Mapping[str, Any]) -> None:
    """Writes an archive; an old file stays until the new one is whole."""
    path = pathlib.Path(path)
    part = path.with_name(f'.{path.name}.{os.getpid()}.part')
    try:
        with part.open('wb') as file:
            arrays = {name: np.asarray(value) for name, value in fields.items()}
            np.savez_compressed(file, allow_pickle=False, **arrays)
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def read(
    path: pathlib.Path,
    what: str,
    fields: Mapping[str, tuple[str, int] | None],
    defaults: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Returns the fields of an archive.

    Args:
      path: file.
      what: what it should hold, for messages.
      fields: names, and for those that become Python objects the kinds of dtype they may have and
        their number of axes; None: an array, which the caller checks.
      defaults: values of fields that may be missing.

    Raises:
      ValueError: for a broken file or a malformed field (names file and field).
      FileNotFoundError: if there is no file at the path.
    """
    content = io.BytesIO(path.read_bytes())
    found: dict[str, Any] = {}
    field = ''
    try:
        archive = np.load(content, allow_pickle=False)
        if not isinstance(archive, np.lib.npyio.NpzFile):
            raise ValueError('a single array')
        for field in fields:
            if field in archive:
                found[field] = archive[field]
            elif not defaults or field not in defaults:
                raise ValueError('is missing')
    except Exception as error:  # a damaged archive fails in a dozen ways
        where = f'field {field!r}' if field else f'no readable {what}'
        raise ValueError(f'{path}: {where}: {error}') from None
    for field, value in found.items():
        form = fields[field]
        if form is None:
            continue
        kinds, axes = form
        if value.dtype.kind not in kinds or value.ndim != axes:
            raise ValueError(f'{path}: field {field!r} has type {value.dtype}, {value.ndim} axes')
        found[field] = value.tolist()
    return {**(defaults or {}), **found}
