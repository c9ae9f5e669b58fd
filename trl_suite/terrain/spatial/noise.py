"""Gradient noise of hills: one fixed tile, repeated periodically and summed in octaves.

Source: K. Perlin, 'Improving noise', 2002 (the permutation and the gradients are his); the tile and
the octaves are those of the original Terrain RL Simulator.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np

from trl_suite.util.compiled import compiled, compiled_inline, nearest_index

TILE = 256  # points of the tile along each axis; the last equals the first
PERIOD = 16  # lattice cells over the tile
_LAYER = 8  # lattice plane of the three-dimensional noise that is used
OCTAVES = 2.0 ** -np.arange(6)  # amplitudes of the octaves
FREQUENCIES = np.array([1, 1.96, 4.03, 7.92, 16.7, 31.12])
_SCALES = tuple(zip(OCTAVES.tolist(), FREQUENCIES.tolist(), strict=True))

_PERMUTATION = np.array(
    list(
        bytes.fromhex("""
    97a0895b5a0f830dc95f6035c2e907e18c24671e458e086325f0150a17be0694f778ea4b001ac53e5efcdb
    cb75230b2039b12158ed953857ae147d88aba844af4aa547868b301ba64d929ee7536fe57a3cd385e6dc69
    5c29372ef528f4668f3641193fa101d85049d14c84bbd05912a9c8c4878274bc9f56a4646dc6adba034034
    d9e2fa7c7b05ca2693767eff5255d4cfce3be32f103a11b6bd1c2adfb7aad577f898022c9aa346dd99659b
    a72bac09811627fd13626c6e4f71e0e8b2b97068daf661e4fb22f2c1eed2900cbfb3a2f1513391ebf90eef
    6b31c0d61fb5c76a9db854ccb07379322d7f0496fe8aeccd5dde72431d1848f38d80c34e42d73d9cb4
""")
    )
)


@functools.cache
def tile() -> np.ndarray:
    """The noise in [0, 1], shape (TILE, TILE): from 0.0005 to 0.906, mean 0.5, deviation 0.128."""
    lattice = np.linspace(0, PERIOD, TILE)
    whole = np.floor(lattice).astype(int)
    fraction = lattice - whole
    low, high = whole % PERIOD, (whole + 1) % PERIOD
    hashes = np.concatenate([_PERMUTATION, _PERMUTATION])

    def corner(i: np.ndarray, j: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Product of the corner's gradient, one of 12, and the offset (x, y, 0) of a point."""
        kind = hashes[hashes[hashes[i][:, None] + j[None]] + _LAYER] & 15
        x, y = np.broadcast_arrays(x[:, None], y[None])
        first = np.where(kind < 8, x, y)
        second = np.where(kind < 4, y, np.where((kind == 12) | (kind == 14), x, 0.0))
        return np.where(kind & 1, -first, first) + np.where(kind & 2, -second, second)

    fade = fraction**3 * (fraction * (fraction * 6 - 15) + 10)
    along = fade[:, None]
    near = corner(low, low, fraction, fraction)
    near += along * (corner(high, low, fraction - 1, fraction) - near)
    far = corner(low, high, fraction, fraction - 1)
    far += along * (corner(high, high, fraction - 1, fraction - 1) - far)
    return 0.5 * (near + fade * (far - near) + 1)


@functools.cache
def _single() -> np.ndarray:
    return np.ascontiguousarray(tile().T, np.float32)


@functools.cache
def _padded() -> list[list[float]]:
    return np.pad(tile(), (0, 1), mode='edge').tolist()


def grid(
    x: np.ndarray, y: np.ndarray, offset: np.ndarray, frequency: float, amplitude: float
) -> np.ndarray:
    """Sum of the octaves on a grid.

    Args:
      x, y: coordinates of the grid lines, m, shapes (k,) and (m,).
      offset: position of (0, 0) in the tile, (2,).
      frequency: tiles per m of the first octave.
      amplitude: amplitude of the first octave, m.

    Returns:
      Heights in m, shape (k, m), in single precision.
    """
    x, y = np.ascontiguousarray(x, float), np.ascontiguousarray(y, float)
    heights = np.empty((len(x), len(y)), np.float32)
    amplitudes, factors = 2 * amplitude * OCTAVES, frequency * FREQUENCIES
    crossings, found = (np.empty((size, len(x)), np.float32) for size in (TILE, len(y)))
    room = _Room(np.empty(len(x), np.int32), np.empty(len(x), np.float32), crossings, found)
    lowest = np.float32(-amplitude * OCTAVES.sum())
    _sum_octaves(
        x, y, offset, lowest, amplitudes.astype(np.float32), factors, _single(), room, heights
    )
    return heights


class _Room(NamedTuple):
    """Work arrays for the lines of a grid along y."""

    cells: np.ndarray  # cells of the tile that contain the lines
    shares: np.ndarray  # positions of the lines in these cells
    crossings: np.ndarray  # heights at the intersections with lines of the tile
    heights: np.ndarray  # of the grid; neighbours along x are adjacent in memory


@compiled
def _sum_octaves(
    x: np.ndarray,
    y: np.ndarray,
    offset: np.ndarray,
    lowest: np.float32,
    amplitudes: np.ndarray,
    factors: np.ndarray,
    noise: np.ndarray,
    room: _Room,
    heights: np.ndarray,
) -> None:
    """Writes the sum of the octaves on a grid; `noise` is the tile along y, then along x."""
    cells, shares, crossings, found = room.cells, room.shares, room.crossings, room.heights
    for b in range(len(y)):
        for a in range(len(x)):
            found[b, a] = lowest
    for octave in range(len(factors)):
        factor, amplitude = factors[octave], amplitudes[octave]
        for a in range(len(x)):
            cells[a], shares[a] = _cell(x[a] * factor + offset[0])
        first, last = TILE, 0
        for b in range(len(y)):
            cell, _ = _cell(y[b] * factor + offset[1])
            first, last = min(first, cell), max(last, cell + 1)
        for j in range(first, last + 1):
            for a in range(len(x)):
                near = noise[j, cells[a]]
                rise = (noise[j, cells[a] + 1] - near) * shares[a]
                crossings[j, a] = (near + rise) * amplitude
        for b in range(len(y)):
            cell, share = _cell(y[b] * factor + offset[1])
            for a in range(len(x)):
                left = crossings[cell, a]
                rise = (crossings[cell + 1, a] - left) * share
                found[b, a] = (found[b, a] + left) + rise
    for a in range(len(x)):
        for b in range(len(y)):
            heights[a, b] = found[b, a]


@compiled_inline
def _cell(position: float) -> tuple[int, np.float32]:
    """Index of the tile's cell at a position in tiles, and the position in that cell."""
    position = position % 1.0 * (TILE - 1)
    cell = nearest_index(position, TILE - 1)
    return cell, np.float32(position - cell)


def above(x: float, y: float, offset: np.ndarray, frequency: float) -> bool:
    """Whether the sum of the octaves at one point is above 0; see `grid`."""
    noise, span, total = _padded(), TILE - 1, 0.0
    u0, v0 = offset.tolist()
    x, y = x * frequency, y * frequency
    for octave, factor in _SCALES:
        u, v = (x * factor + u0) % 1.0 * span, (y * factor + v0) % 1.0 * span
        i, j = int(u), int(v)
        low, high = noise[i], noise[i + 1]
        u, v = u - i, v - j
        near = low[j] + u * (high[j] - low[j])
        far = low[j + 1] + u * (high[j + 1] - low[j + 1])
        total += octave * (2 * (near + v * (far - near)) - 1)
        if abs(total) > octave:  # more than the sum of all further octaves
            break
    return total > 0
