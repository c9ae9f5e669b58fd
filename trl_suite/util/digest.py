"""A digest of the contents of nested values: numbers, arrays, options, functions."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import pathlib
import types
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np

_CONSTANTS = (
    *(bool, int, float, str, bytes, tuple, np.generic, np.ndarray, type, pathlib.PurePath),
    *(types.FunctionType, types.MethodType, functools.partial),
)


def digest(value: Any, without: Collection[str] = ()) -> str:
    """Returns the first 16 hexadecimal digits of the SHA-256 of a value.

    Equal values have equal digests, in every process with the same version of Python. What counts
    are types, shapes and contents of arrays; entries of mappings and sequences, in order; fields of
    dataclasses; name, bytecode, defaults and closure of functions, but neither the globals that they
    use nor what may change in their closure, such as lists; and of any other object only its class.

    Fields of dataclasses whose names are in `without` do not count.
    """
    parts: list[bytes] = []
    _add(value, parts, without, ())
    return hashlib.sha256(b''.join(parts)).hexdigest()[:16]


def _add(value: Any, parts: list[bytes], without: Collection[str], inside: tuple[Any, ...]) -> None:
    """Appends a value within functions, which may contain themselves, to the bytes of a digest."""

    def add(kind: str, *content: Any, inside: tuple[Any, ...] = inside) -> None:
        parts.append(f'{kind}{len(content)};'.encode())
        for each in content:
            _add(each, parts, without, inside)

    # The most frequent types come first.
    if isinstance(value, np.ndarray) and value.dtype != object:
        parts.append(f'array{value.dtype.str}{value.shape};'.encode())
        parts.append(value.tobytes())
    elif isinstance(value, (bool, np.bool_)):
        parts.append(f'{bool(value)};'.encode())
    elif isinstance(value, (int, np.integer)):
        parts.append(f'{int(value)};'.encode())
    elif isinstance(value, (float, np.floating)):  # 1.0 as 1
        value = float(value)
        parts.append(f'{int(value) if value.is_integer() else value!r};'.encode())
    elif isinstance(value, (str, bytes)):
        text = value.encode() if isinstance(value, str) else value
        parts.append(f'{type(value).__name__}{len(text)};'.encode())
        parts.append(text)
    elif isinstance(value, (list, tuple, np.ndarray)):
        add('sequence', *value)
    elif isinstance(value, Mapping):
        add('mapping', *(part for item in value.items() for part in item))
    elif value is None or value is Ellipsis:
        parts.append(f'{value};'.encode())
    elif isinstance(value, (set, frozenset)):
        add('set', *sorted(digest(each, without) for each in value))
    elif isinstance(value, type):
        add('class', value.__module__, value.__qualname__)
    elif dataclasses.is_dataclass(value):
        names = [field.name for field in dataclasses.fields(value) if field.name not in without]
        add('fields', type(value), *((name, getattr(value, name)) for name in names))
    elif isinstance(value, types.CodeType):
        add('code', value.co_code, value.co_consts, value.co_names)
    elif isinstance(value, functools.partial):
        add('partial', value.func, value.args, value.keywords)
    elif isinstance(value, types.MethodType):
        add('method', value.__func__, value.__self__)
    elif isinstance(value, types.FunctionType):
        add('function', value.__module__, value.__qualname__)
        if value not in inside:
            content = value.__code__, value.__defaults__, value.__kwdefaults__, _closure(value)
            add('content', *content, inside=(*inside, value))
    elif hasattr(value, 'py_func'):  # compiled by Numba
        add('compiled', value.py_func)
    elif isinstance(value, pathlib.PurePath):
        add('path', str(value))
    else:
        add('object', type(value))


def _closure(function: types.FunctionType) -> list[Any]:
    """Returns the values in the closure of a function; None for what may change, and later values."""
    values = []
    for cell in function.__closure__ or ():
        try:
            value = cell.cell_contents
        except ValueError:  # a name that has no value yet
            value = None
        constant = isinstance(value, _CONSTANTS) or dataclasses.is_dataclass(value)
        values.append(value if constant else None)
    return values
