"""Reads and writes of memory at addresses, in compiled code.

They need Numba intrinsics; with `NUMBA_DISABLE_JIT=1`, Python functions do the same.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any

import numpy as np

from trl_suite.util.compiled import Compiled


def address(array: np.ndarray) -> int:
    """Returns the address of the first number of an array; the caller keeps the array alive."""
    return array.__array_interface__['data'][0]


def _pointer(kind: str) -> Any:
    """Returns an intrinsic that converts an address to a pointer to numbers of type `kind`."""
    from numba import types
    from numba.extending import intrinsic

    @intrinsic
    def pointer(typing: Any, address: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return builder.inttoptr(args[0], context.get_value_type(signature.return_type))

        return types.CPointer(getattr(types, kind))(types.int64), generate

    return pointer


def _copy_native() -> Callable[..., Any]:
    import numba

    pointer = _pointer('float64')

    def copy(target: int, source: int, count: int) -> None:
        to = numba.carray(pointer(target), (count,))
        of = numba.carray(pointer(source), (count,))
        for k in range(count):
            to[k] = of[k]

    return copy


def _copy(target: int, source: int, count: int) -> None:
    """Copies numbers from one address to another."""
    ctypes.memmove(int(target), int(source), 8 * int(count))


def _count_native() -> Callable[..., Any]:
    import numba

    pointer = _pointer('int32')

    def count_at(address: int) -> int:
        return numba.carray(pointer(address), (1,))[0]

    return count_at


def _count(address: int) -> int:
    """Returns the int at an address."""
    return ctypes.c_int32.from_address(int(address)).value


def _get_native() -> Callable[..., Any]:
    import numba

    pointer = _pointer('float64')

    def get(address: int, k: int) -> float:
        return numba.carray(pointer(address), (k + 1,))[k]

    return get


def _get(address: int, k: int) -> float:
    """Returns number k of the floats at an address."""
    return ctypes.c_double.from_address(int(address) + 8 * int(k)).value


def _put_native() -> Callable[..., Any]:
    import numba

    pointer = _pointer('float64')

    def put(address: int, k: int, value: float) -> None:
        numba.carray(pointer(address), (k + 1,))[k] = value

    return put


def _put(address: int, k: int, value: float) -> None:
    """Writes number k of the floats at an address."""
    ctypes.c_double.from_address(int(address) + 8 * int(k)).value = float(value)


copy = Compiled(_copy, _copy_native)
count = Compiled(_count, _count_native)
get = Compiled(_get, _get_native)
put = Compiled(_put, _put_native)
