"""The unbounded planar ground of one episode."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from trl_suite.terrain.parameters import Terrain
from trl_suite.terrain.planar.features import flat
from trl_suite.terrain.planar.generators import GENERATORS, LONGEST, SPACING, STEEP, cells, draw
from trl_suite.util.compiled import compiled

STRETCH = 20.0  # m; nominal length generated at once; slopes restart in every stretch
PAD_END = 1.0  # m; end of the flat start
INTENDED_CENTRE = -1.0  # m
_UNUSED = np.random.default_rng(0)  # for level ground, which draws nothing
_FAR = 0x9E3779B97F4A7C15F39CC0605CEDC835  # distance of two streams: 2**128 / golden ratio draws


class PlanarGround:
    """Unbounded planar ground, generated in stretches of 20 m when it is queried.

    Vertex i is at x = i * SPACING, for any integer i; the ground is linear in between. Ground to
    the right and ground to the left have separate random streams, so the ground depends on the seed
    only, not on the order or extent of queries.

    The first two stretches meet at height 0 at the `centre`. A stretch over x = 0 begins with flat
    ground, intended to reach x = +1 (the original's rule). With the centre at -1, as the original
    intended, the ground is flat from x = -1 to +1, and the first spacing follows. When run, the
    original has its centre elsewhere; then either a feature ends exactly at the centre behind the
    character (centre in (-1, 0]), or one ends at the centre in front of it and the flat ground
    lies 20 m behind (centre > 0).

    Ground that is a function of x (see `from_function`) has neither stretches nor a flat start: its
    heights are those of the function, shifted by a random offset if it has a `start_span`.

    Attributes:
      type: the terrain type.
      parameters: a value for every parameter of the type.
    """

    def __init__(
        self,
        terrain: Terrain,
        seed: int | np.random.SeedSequence | np.random.Generator,
        *,
        terrain_level: float = 0.0,
        spawn: str = 'intended',
        centre: float = 0.0,
    ):
        """Prepares the ground; it is generated when it is first queried.

        Args:
          terrain: the type and parameters of the ground; planar.
          seed: an integer, a SeedSequence (not changed: the same one gives the same ground), or a
            Generator (from which four numbers are drawn).
          terrain_level: number of the parameter set, see `Terrain.parameters`.
          spawn: 'intended' for flat ground from x = -1 to +1, or 'upstream' for the start that the
            original has when run.
          centre: x where the first two stretches meet if spawn is 'upstream', m; otherwise unused.
            In the original it is 3 for gait state machines, and x - 0.5 for the imitation of a clip
            that has moved x m forward at its start phase.

        Raises:
          ValueError: three-dimensional terrain, unknown spawn, a centre that is not finite or whose
            magnitude exceeds LONGEST, or a terrain_level that is not a number.
          TypeError: the seed has another type.
        """
        if terrain.spatial:
            raise ValueError(
                f'terrain {terrain.name!r} ({terrain.type}) is three-dimensional; planar characters '
                'and a PlanarGround need planar terrain'
            )
        if spawn not in ('intended', 'upstream'):
            raise ValueError(f"spawn must be 'intended' or 'upstream', not {spawn!r}")
        if not abs(centre) <= LONGEST:
            raise ValueError(f'centre must be a number within {LONGEST:g} m of 0, not {centre!r}')
        self.type = terrain.type
        self.parameters = terrain.parameters(terrain_level)
        # Heights of the vertices _low, _low + 1, ...; `_vertical` is for the cells between them.
        self._low = round((centre if spawn == 'upstream' else INTENDED_CENTRE) / SPACING)
        self._heights = np.zeros(1)
        self._vertical = np.zeros(0, dtype=bool)
        self._sequence = seed_sequence(seed)
        self._offset = 0.0  # m; argument of the line function at the origin
        if self._line is not None:
            self._low = 0
            span = self.parameters['StartSpan']
            if span:
                self._offset = float(np.random.default_rng(self._sequence).uniform(-span, span))
            self._heights = self._on_line(0, 1)

    @functools.cached_property
    def _streams(self) -> tuple[np.random.Generator, np.random.Generator]:
        """Random generators of the ground to the right and to the left."""
        # Two distant parts of one stream; `jumped` would needlessly draw a seed from the system.
        right, left = np.random.PCG64(self._sequence), np.random.PCG64(self._sequence)
        left.advance(_FAR)
        return np.random.Generator(right), np.random.Generator(left)

    @property
    def extent(self) -> tuple[float, float]:
        """Lowest and highest x of the ground that exists so far, m."""
        return self._low * SPACING, (self._low + len(self._heights) - 1) * SPACING

    def ensure(self, lo: float, hi: float) -> None:
        """Generates the ground from lo to hi (m) where it does not exist yet.

        Raises:
          ValueError: lo or hi is not finite, or further than LONGEST from 0.
        """
        if not (abs(lo) <= LONGEST and abs(hi) <= LONGEST):
            raise ValueError(f'ground exists within {LONGEST:g} m of 0, not from {lo!r} to {hi!r}')
        self._extend(math.floor(lo / SPACING), math.ceil(hi / SPACING))

    def window(self, lo_index: int, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Returns the vertices lo_index, lo_index + 1, ..., generated if necessary.

        Returns:
          heights: m, shape (count,).
          vertical: True where the cell that ends at the vertex is a vertical face, shape (count,).
        """
        if count < 1:
            raise ValueError(f'count must be positive, not {count!r}')
        # One more vertex to the left, so that the first cell is known.
        self.ensure((lo_index - 1) * SPACING, (lo_index + count - 1) * SPACING)
        first = lo_index - self._low
        heights = self._heights[first : first + count]
        return heights.copy(), self._vertical[first - 1 : first - 1 + count].copy()

    def height(self, x: npt.ArrayLike) -> np.ndarray:
        """Returns the heights of the ground at x (m), of the shape of x, by linear interpolation.

        Raises:
          ValueError: a value of x is not finite, or further than LONGEST from 0.
        """
        left, rise, fraction = self._cell(x)
        return left + fraction * rise

    def slope(self, x: npt.ArrayLike) -> np.ndarray:
        """Returns dh/dx of the cells that contain x (m); at a vertex, of the cell to its right.

        Vertical faces are one cell wide, as in the polyline.

        Raises:
          ValueError: as `height`.
        """
        return self._cell(x)[1] / SPACING

    def state(self) -> dict[str, Any]:
        """Returns a state from which `from_state` continues exactly as this ground would."""
        return {
            'type': self.type,
            'parameters': dict(self.parameters),
            'low': self._low,
            'heights': self._heights.copy(),
            'vertical': self._vertical.copy(),
            'right': self._streams[0].bit_generator.state,
            'left': self._streams[1].bit_generator.state,
            'offset': self._offset,
        }

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> PlanarGround:
        """Returns the ground that had this `state`."""
        strip = cls.__new__(cls)
        strip.set_state(state)
        return strip

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Restores the ground to the time at which `state` was taken."""
        right, left = np.random.default_rng(0), np.random.default_rng(0)
        right.bit_generator.state, left.bit_generator.state = state['right'], state['left']
        self.type, self.parameters = state['type'], dict(state['parameters'])
        self._low = state['low']
        self._heights, self._vertical = state['heights'].copy(), state['vertical'].copy()
        self._streams = right, left
        self._offset = state.get('offset', 0.0)

    @property
    def _line(self) -> Callable[[np.ndarray], np.ndarray] | None:
        """The function of x that gives the heights; None for other ground."""
        generator = GENERATORS.get(self.type)
        return None if generator is None else generator.line

    def _on_line(self, first: int, count: int) -> np.ndarray:
        """Heights of vertices from the line function, (count,) m."""
        assert self._line is not None
        x = (first + np.arange(count)) * SPACING + self._offset
        heights = np.asarray(self._line(x), dtype=float)
        if heights.shape != x.shape:
            raise ValueError(
                f'the function of terrain {self.type!r} must return heights of shape {x.shape}, as its '
                f'argument has; it returned an array of shape {heights.shape}'
            )
        if not np.isfinite(heights).all():
            wrong = np.flatnonzero(~np.isfinite(heights))[0]
            raise ValueError(
                f'the function of terrain {self.type!r} returned {heights[wrong]} at x = '
                f'{x[wrong]:g} m; expected finite heights'
            )
        return heights

    def _cell(self, x: npt.ArrayLike) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns the height of the vertex left of x, the rise over the cell, and x in the cell."""
        x = np.asarray(x, dtype=float)
        if not x.size:
            return x, x, x
        position = x / SPACING
        lo, hi = float(position.min()), float(position.max())
        if not (lo >= -LONGEST / SPACING and hi <= LONGEST / SPACING):  # also refuses NaN
            raise ValueError(f'x must be finite and within {LONGEST:g} m of 0, not {x}')
        self._extend(math.floor(lo), math.floor(hi) + 1)
        number = np.floor(position)
        i = number.astype(int) - self._low
        left = self._heights[i]
        return left, self._heights[i + 1] - left, position - number

    def _extend(self, low: int, high: int) -> None:
        """Generates stretches until the vertices from low to high exist."""
        end = self._low + len(self._heights) - 1
        if self._line is not None:
            self._extend_line(min(low, self._low), max(high, end))
            return
        start, right, left = self._low, [], []
        while end < high:
            right.append(self._stretch(end, 0))
            end += right[-1][0] + len(right[-1][1])
        while start > low:
            left.append(self._stretch(start - cells(STRETCH), 1))
            start -= left[-1][0] + len(left[-1][1])
        if not (right or left):
            return
        heights, vertical = np.empty(end - start + 1), np.empty(end - start, bool)
        first, last = self._low - start, self._low - start + len(self._vertical)
        heights[first : last + 1], vertical[first:last] = self._heights, self._vertical
        for stretch in right:
            last = _append(last, *stretch, heights, vertical)
        for stretch in left:
            first = _prepend(first, *stretch, heights, vertical)
        self._low, self._heights, self._vertical = start, heights, vertical

    def _extend_line(self, low: int, high: int) -> None:
        """Adds missing vertices from low to high, and a margin, from the line function."""
        end, more = self._low + len(self._heights) - 1, cells(STRETCH)
        parts = [self._heights]
        if low < self._low:
            parts.insert(0, self._on_line(low - more, self._low - low + more))
            self._low = low - more
        if high > end:
            parts.append(self._on_line(end + 1, high - end + more))
        if len(parts) > 1:
            self._heights = np.concatenate(parts)
            self._vertical = np.abs(np.diff(self._heights)) > STEEP * SPACING

    def _stretch(self, begin: int, side: int) -> tuple[int, np.ndarray, np.ndarray]:
        """Generates a stretch that begins at a vertex.

        Returns:
          The number of level vertices at its beginning (not 0 only if it covers x = 0), and heights
          and vertical faces of the vertices that follow, as in a `Profile`.
        """
        generator = GENERATORS.get(self.type)
        if generator is not None and generator.function is flat:
            # Not from the streams: creating them takes longer than generating the ground.
            profile = flat(self.parameters, STRETCH, _UNUSED)
        else:
            profile = draw(self.type, self.parameters, STRETCH, self._streams[side])
        pad = 0
        if begin <= 0 < begin + cells(STRETCH):
            pad = min(cells(STRETCH), cells(PAD_END) - begin)
        return pad, profile.heights, profile.vertical


@compiled
def _append(
    last: int, pad: int, more: np.ndarray, faces: np.ndarray, heights: np.ndarray,
    vertical: np.ndarray,
) -> int:  # fmt: skip
    """Writes a stretch after the last vertex; returns the index of the new last vertex."""
    base = heights[last]
    for k in range(pad):
        heights[last + 1 + k], vertical[last + k] = base, False
    last += pad
    for k in range(len(more)):
        heights[last + 1 + k], vertical[last + k] = base + more[k], faces[k]
    return last + len(more)


@compiled
def _prepend(
    first: int, pad: int, more: np.ndarray, faces: np.ndarray, heights: np.ndarray,
    vertical: np.ndarray,
) -> int:  # fmt: skip
    """Writes a stretch before the first vertex, with which its last vertex coincides.

    Its start, at relative height 0, becomes the new first vertex; returns the index of that vertex.
    """
    height, end = heights[first], more[-1]
    first -= pad + len(more)
    for k in range(pad + 1):
        heights[first + k] = -end + height
    for k in range(pad):
        vertical[first + k] = False
    for k in range(len(more) - 1):
        heights[first + pad + 1 + k] = more[k] - end + height
    for k in range(len(more)):
        vertical[first + pad + k] = faces[k]
    return first


def seed_sequence(
    seed: int | np.random.SeedSequence | np.random.Generator,
) -> np.random.SeedSequence:
    """Returns the SeedSequence of a seed."""
    if isinstance(seed, (int, np.integer)) and not isinstance(seed, bool) and seed >= 0:
        return np.random.SeedSequence(int(seed))
    if isinstance(seed, np.random.SeedSequence):
        return seed
    if isinstance(seed, np.random.Generator):
        return np.random.SeedSequence(seed.integers(2**32, size=4).tolist())
    raise TypeError(f'seed must be an int >= 0, a SeedSequence or a Generator, not {seed!r}')
