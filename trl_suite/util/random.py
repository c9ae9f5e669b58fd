"""Random numbers in compiled functions: NumPy's PCG64, one stream per simulation.

    state = np.zeros((n, 6), np.uint64)
    seed_stream(3, np.random.SeedSequence(7), state)
    uniform(3, 0.2, 0.7, state)  # as np.random.default_rng(...).uniform(0.2, 0.7)

The numbers are bit-identical to those of `numpy.random.Generator`, so that Python and compiled
functions can draw from the same stream alternately. Compiled functions can also draw from a NumPy
Generator with any bit generator:

    draw(address(rng))  # as rng.random()

Source: NumPy's `PCG64` (M. E. O'Neill, 'PCG', 2014) and its ziggurat for the normal distribution.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from trl_suite.util.compiled import Compiled, compiled

_FULL = (1 << 64) - 1
_MULTIPLIER = 0x2360ED051FC65DA44385DF649FCCF645
_TAIL, _INVERSE_TAIL = 3.6541528853610087963519472518, 0.27366123732975827203338247596
_DOUBLE = 1.0 / 9007199254740992.0


def seed_stream(i: int, sequence: np.random.SeedSequence, state: np.ndarray) -> None:
    """Seeds stream i as `np.random.default_rng(sequence)` would be.

    Args:
      i: number of the stream.
      sequence: the seed.
      state: (n, 6) uint64; high and low words of state and increment, then `has_uint32` and
        `uinteger`, the buffered 32 bits.
    """
    _store(np.random.PCG64(sequence), state[i])


@contextlib.contextmanager
def _continued(words: np.ndarray) -> Iterator[np.random.Generator]:
    """Yields a Generator that continues a stream; on exit its state is stored."""
    bits = np.random.PCG64(0)
    high, low, inc_high, inc_low, has_uint32, uinteger = words.tolist()
    bits.state = {
        'bit_generator': 'PCG64',
        'state': {'state': high << 64 | low, 'inc': inc_high << 64 | inc_low},
        'has_uint32': has_uint32,
        'uinteger': uinteger,
    }
    yield np.random.Generator(bits)
    _store(bits, words)


def _store(bits: np.random.PCG64, words: np.ndarray) -> None:
    found: Any = bits.state
    state, inc = found['state']['state'], found['state']['inc']
    words[:4] = state >> 64, state & _FULL, inc >> 64, inc & _FULL
    words[4:] = found['has_uint32'], found['uinteger']


# Compiled functions have their own PCG64 and ziggurat: those of NumPy keep their states in memory of
# their own, while tasks save, restore and copy the states of all simulations as an array.


@functools.cache
def _next64() -> Callable[..., Any]:
    """Returns a compiled function that returns the next 64 bits of stream i."""
    from numba import njit, uint64

    high, low = np.uint64(_MULTIPLIER >> 64), np.uint64(_MULTIPLIER & _FULL)
    half, mask = np.uint64(32), np.uint64(0xFFFFFFFF)
    one, zero, turn, bits = np.uint64(1), np.uint64(0), np.uint64(58), np.uint64(64)

    @njit(error_model='numpy')
    def upper(a: Any, b: Any) -> Any:
        """Returns the upper word of a product."""
        a1, a0, b1, b0 = a >> half, a & mask, b >> half, b & mask
        middle = a1 * b0 + ((a0 * b0) >> half)
        other = a0 * b1 + (middle & mask)
        return a1 * b1 + (middle >> half) + (other >> half)

    @njit(error_model='numpy')
    def next64(i: int, state: np.ndarray) -> Any:
        s1, s0 = state[i, 0], state[i, 1]
        lower = s0 * low
        carried = upper(s0, low) + s1 * low + s0 * high + state[i, 2]
        total = lower + state[i, 3]
        if total < lower:
            carried += one
        state[i, 0], state[i, 1] = carried, total
        mixed, by = carried ^ total, carried >> turn
        if by == zero:
            return uint64(mixed)
        return uint64((mixed >> by) | (mixed << (bits - by)))

    return next64


def _random_native() -> Callable[..., Any]:
    next64, shift = _next64(), np.uint64(11)

    def random(i: int, state: np.ndarray) -> float:
        return (next64(i, state) >> shift) * _DOUBLE

    return random


def _random(i: int, state: np.ndarray) -> float:
    """Draws from [0, 1), as `Generator.random()`."""
    with _continued(state[i]) as generator:
        return generator.random()


random = Compiled(_random, _random_native)


@compiled
def uniform(i: int, low: float, high: float, state: np.ndarray) -> float:
    """Draws from [low, high), as `Generator.uniform(low, high)`."""
    return low + (high - low) * random(i, state)


class _Bits(ctypes.Structure):
    """NumPy's bitgen_t."""

    _names = ('state', 'next_uint64', 'next_uint32', 'next_double', 'next_raw')
    _fields_ = [(name, ctypes.c_void_p) for name in _names]


_DRAW = ctypes.CFUNCTYPE(ctypes.c_double, ctypes.c_void_p)
_capsule_address = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.py_object, ctypes.c_char_p)(
    ('PyCapsule_GetPointer', ctypes.pythonapi)
)


def address(generator: np.random.Generator) -> int:
    """Returns the address of a generator's bitgen_t, for `draw`; the caller keeps it alive."""
    return _capsule_address(generator.bit_generator.capsule, b'BitGenerator')


def _draw_native() -> Callable[..., Any]:
    from llvmlite import ir
    from numba import types
    from numba.extending import intrinsic

    @intrinsic
    def next_double(typing: Any, address: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            word = ir.IntType(64)
            fields = builder.inttoptr(args[0], word.as_pointer())
            place = builder.gep(fields, [ir.Constant(word, _Bits.next_double.offset // 8)])
            function = ir.FunctionType(ir.DoubleType(), [word]).as_pointer()
            return builder.call(
                builder.inttoptr(builder.load(place), function), [builder.load(fields)]
            )

        return types.float64(types.int64), generate

    def draw(bits: int) -> float:
        return next_double(bits)  # type: ignore[call-arg]

    return draw


def _draw(bits: int) -> float:
    """Draws from [0, 1), as `random()` of the generator whose `address` is given."""
    found = _Bits.from_address(bits)
    return _DRAW(found.next_double)(found.state)


draw = Compiled(_draw, _draw_native)


def _normal_native() -> Callable[..., Any]:
    from numba.np.random import _constants

    limits = _constants.ki_double.astype(np.int64)
    widths, heights, next64 = _constants.wi_double, _constants.fi_double, _next64()
    byte, sign, nine, mantissa = map(np.uint64, (0xFF, 0x100, 9, 0x000FFFFFFFFFFFFF))

    def normal(i: int, state: np.ndarray) -> float:
        while True:
            bits = next64(i, state)
            layer, size = int(bits & byte), int((bits >> nine) & mantissa)
            x = size * widths[layer]
            if bits & sign:
                x = -x
            if size < limits[layer]:
                return x
            if layer == 0:
                while True:
                    beyond = -_INVERSE_TAIL * math.log1p(-random(i, state))
                    level = -math.log1p(-random(i, state))
                    if level + level > beyond * beyond:
                        break
                return -(_TAIL + beyond) if (size >> 8) & 1 else _TAIL + beyond
            edge = (heights[layer - 1] - heights[layer]) * random(i, state) + heights[layer]
            if edge < math.exp(-0.5 * x * x):
                return x

    return normal


def _normal(i: int, state: np.ndarray) -> float:
    """Draws from the standard normal distribution, as `Generator.standard_normal()`."""
    with _continued(state[i]) as generator:
        return generator.standard_normal()


standard_normal = Compiled(_normal, _normal_native)
