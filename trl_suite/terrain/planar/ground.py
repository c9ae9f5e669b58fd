"""The unbounded planar ground of one episode."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from trl_suite.terrain.generators import (
    GENERATORS,
    LONGEST,
    SPACING,
    STEEP,
    Profile,
    cells,
    draw,
)
from trl_suite.terrain.parameters import Terrain
from trl_suite.terrain.planar.features import flat

STRETCH = 20.0  # m; nominal length generated at once; slopes restart in every stretch
KEPT = 50.0  # m; ground farther from the latest query is forgotten
PAD_END = 1.0  # m; end of the flat start
INTENDED_CENTRE = -1.0  # m
HIGHEST = 1e6  # m; of ground from a function
_STRETCH, _KEPT, _PAD_END = (cells(length) for length in (STRETCH, KEPT, PAD_END))
_NOWHERE = 2**62  # number of no mark
_UNUSED = np.random.default_rng(0)  # for level ground, which draws nothing
_FAR = 0x9E3779B97F4A7C15F39CC0605CEDC835  # distance of two streams: 2**128 / golden ratio draws


class Mark(NamedTuple):
    """Where two stretches meet, and all that the ground beyond depends on.

    The next stretch away from the centre is drawn from `stream`, the state of a random generator.
    It is None before that, at the centre, and for level ground.
    """

    number: int  # 0 at the centre, 1, 2, ... to the right of it, -1, -2, ... to the left
    vertex: int
    height: float  # of the vertex, m
    stream: dict[str, Any] | None


class PlanarGround:
    """Unbounded planar ground, generated in stretches of 20 m when it is queried.

    Vertex i is at x = i * SPACING, for any integer i; the ground is linear in between. Ground to
    the right and ground to the left have separate random streams, so the ground depends on the seed
    only, not on the order or extent of queries. Ground far from the latest query is forgotten, and
    generated again if it is needed: on the way back, from the centre on.

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
            In the original it is 3 for gait state machines, and for the imitation of a clip that has
            moved x m forward at its start phase x - 0.5, or x + 3 without observation of the ground.

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
        vertex = round((centre if spawn == 'upstream' else INTENDED_CENTRE) / SPACING)
        parameters, sequence = terrain.parameters(terrain_level), seed_sequence(seed)
        self._begin(terrain.type, parameters, sequence, vertex)

    def _begin(
        self,
        type_: str,
        parameters: Mapping[str, float],
        sequence: np.random.SeedSequence,
        centre: int,
    ) -> None:
        self.type: str = type_
        self.parameters: dict[str, float] = dict(parameters)
        self._sequence, self._centre = sequence, Mark(0, centre, 0.0, None)
        # Random streams of the ground to the right and to the left, created on demand, and the numbers
        # of the marks from which they draw next.
        self._streams: list[np.random.Generator | None] = [None, None]
        self._at = [0, 0]
        self._offset = 0.0  # m; argument of the line function at the origin
        span = self.parameters['StartSpan'] if self._line is not None else 0.0
        if span:
            self._offset = float(np.random.default_rng(sequence).uniform(-span, span))
        self._start(self._centre)
        if self._line is not None:
            self._low, self._heights = 0, self._on_line(0, 1)

    def _start(self, mark: Mark) -> None:
        """Forgets all ground; what is queried next is generated from a mark on."""
        # Stretch k, heights without the last one and vertical faces, is between marks k and k + 1.
        self._marks = [mark]
        self._stretches: list[tuple[np.ndarray, np.ndarray]] = []
        self._low, self._heights = mark.vertex, np.array([mark.height])
        self._vertical = np.zeros(0, bool)

    def _join(self) -> None:
        """Joins the stretches: `_heights` of the vertices `_low`, `_low` + 1, ..., and faces."""
        self._low = self._marks[0].vertex
        self._heights = np.concatenate(
            [*(heights for heights, _ in self._stretches), [self._marks[-1].height]]
        )
        self._vertical = np.concatenate([vertical for _, vertical in self._stretches])

    @property
    def extent(self) -> tuple[float, float]:
        """Lowest and highest x of the ground that is held in memory, m."""
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
        x = np.asarray(x, dtype=float)
        if not x.size:
            return x
        position = x / SPACING
        lo, hi = float(position.min()), float(position.max())
        if not (lo >= -LONGEST / SPACING and hi <= LONGEST / SPACING):  # also refuses NaN
            raise ValueError(f'x must be finite and within {LONGEST:g} m of 0, not {x}')
        self._extend(math.floor(lo), math.floor(hi) + 1)
        number = np.floor(position)
        i = number.astype(int) - self._low
        left = self._heights[i]
        return left + (position - number) * (self._heights[i + 1] - left)

    def state(self) -> dict[str, Any]:
        """Returns a state from which `from_state` continues exactly as this ground would.

        It has the seed, not the ground; and, far from the centre, a mark near the latest query, so
        that the ground there need not be generated from the centre on.
        """
        first, last = self._marks[0], self._marks[-1]
        mark = first if first.number > 0 else last if last.number < 0 else None
        return {
            'type': self.type,
            'parameters': dict(self.parameters),
            'entropy': copy.copy(self._sequence.entropy),
            'spawn_key': tuple(self._sequence.spawn_key),
            'centre': self._centre.vertex,
            'mark': None if mark is None else tuple(copy.deepcopy(mark)),
        }

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> PlanarGround:
        """Returns the ground that had this `state`."""
        ground = cls.__new__(cls)
        ground.__setstate__(state)
        return ground

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        sequence = np.random.SeedSequence(state['entropy'], spawn_key=state['spawn_key'])
        self._begin(state['type'], state['parameters'], sequence, state['centre'])
        if state['mark'] is not None:
            self._start(Mark(*state['mark']))

    __getstate__ = state

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
        usable = np.abs(heights) <= HIGHEST
        if not usable.all():
            wrong = np.flatnonzero(~usable)[0]
            raise ValueError(
                f'the function of terrain {self.type!r} returned {heights[wrong]} at x = '
                f'{x[wrong]:g} m; expected finite heights up to {HIGHEST:g} m'
            )
        return heights

    def _extend(self, low: int, high: int) -> None:
        """Generates stretches until the vertices from low to high exist; forgets those far away."""
        if self._low <= low and high < self._low + len(self._heights):
            return
        if self._line is not None:
            heights = self._on_line(low - _STRETCH, high - low + 2 * _STRETCH + 1)
            self._low, self._heights = low - _STRETCH, heights
            self._vertical = np.abs(np.diff(heights)) > STEEP * SPACING
            return
        marks = self._marks
        if (low < marks[0].vertex and marks[0].number > 0) or (
            high > marks[-1].vertex and marks[-1].number < 0
        ):  # forgotten
            self._start(self._centre)
            marks = self._marks
        while marks[-1].vertex < high:
            self._append(right=True)
            while len(marks) > 1 and marks[1].vertex < low - _KEPT:
                del marks[0], self._stretches[0]
        while marks[0].vertex > low:
            self._append(right=False)
            while len(marks) > 1 and marks[-2].vertex > high + _KEPT:
                del marks[-1], self._stretches[-1]
        self._join()

    def _append(self, right: bool) -> None:
        """Generates the next stretch to the right or to the left."""
        mark, profile = self._marks[-1 if right else 0], self._draw(right)
        count, begin = len(profile.heights), mark.vertex if right else mark.vertex - _STRETCH
        pad = 0  # level vertices at the beginning of a stretch over x = 0
        if begin <= 0 < begin + _STRETCH:
            pad = min(_STRETCH, _PAD_END - begin)
        start, end = mark.height, float(profile.heights[-1])
        heights, rises, vertical = np.empty(pad + count), profile.heights[:-1], profile.vertical
        if not right:
            start, rises = -end + mark.height, rises - end
        heights[: pad + 1] = start
        np.add(rises, mark.height, out=heights[pad + 1 :])
        if pad:
            vertical = np.concatenate([np.zeros(pad, bool), vertical])
        if right:
            self._marks.append(Mark(mark.number + 1, mark.vertex + pad + count, start + end, None))
            self._stretches.append((heights, vertical))
        else:
            self._marks.insert(0, Mark(mark.number - 1, mark.vertex - pad - count, start, None))
            self._stretches.insert(0, (heights, vertical))

    def _draw(self, right: bool) -> Profile:
        """Generates the profile of the next stretch to the right or to the left."""
        generator = GENERATORS.get(self.type)
        if generator is not None and generator.function is flat:
            # Not from the streams: creating them takes longer than generating the ground.
            return flat(self.parameters, STRETCH, _UNUSED)
        last, side = (-1, 0) if right else (0, 1)
        mark = self._marks[last]
        random = self._streams[side]
        if random is None or (mark.number == 0 and self._at[side] != 0):
            # Two distant parts of one stream; `jumped` would needlessly draw a seed from the system.
            start = np.random.PCG64(self._sequence)
            random = self._streams[side] = np.random.Generator(
                start if right else start.advance(_FAR)
            )
            self._at[side] = 0
        bits: Any = random.bit_generator
        if self._at[side] != mark.number:
            bits.state = mark.stream
        elif mark.number != 0:
            self._marks[last] = mark._replace(stream=bits.state)
        self._at[side] = _NOWHERE
        profile = draw(self.type, self.parameters, STRETCH, random)
        self._at[side] = mark.number + (1 if right else -1)
        return profile


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
