"""The planar terrain types: random features in sequence, also on rolling ground.

The features of the original consist of two primitives:

* a box (gap, wall): level ground, the floor or crest, and one vertex back at the old level. Both
  flanks are one cell wide, so a wall of nominal width 0.2 m (8 cells) is 0.175 m wide at its crest
  and 0.225 m at its foot. The level of the ground is unchanged.
* a rise (step, cliff): level ground, then one vertex at the new level. Heights accumulate.

Faces are vertical. With a `FaceLength` they are ramps, as in DeepTerrainRL, whose vertices are 0.1 m
apart: the ground ascends or descends over the first vertices at the new level, which are as many or
more.

Their random processes are those of its terrain generator (Terrain RL Simulator, 2018): equal in
distribution, not draw by draw.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from trl_suite.terrain.generators import (
    SPACING,
    Parameter,
    Parameters,
    Profile,
    cells,
    limited,
    register,
)
from trl_suite.util import random
from trl_suite.util.compiled import compiled, compiled_inline, nearest_index

LEDGE = 0.1  # m; tread of the intermediate ledges of a cliff

MOST_LENGTH, MOST_COUNT = 1e3, 100  # m, number
_lengths = functools.partial(limited, 0.0, MOST_LENGTH)
_counts = functools.partial(limited, 0.0, MOST_COUNT, '1, number')
_heights = functools.partial(limited, -1e3, 1e3)
_slopes = functools.partial(limited, -100.0, 100.0, '1, rise per m')
# Parameters, by feature; the defaults are those of the original.
GAPS = {
    **_lengths(GapSpacingMin=4, GapSpacingMax=7, GapWMin=0.5, GapWMax=2),
    **_heights(GapHMin=-2, GapHMax=-2),
}
WALLS = {
    **_lengths(WallSpacingMin=6, WallSpacingMax=8, WallWMin=0.2, WallWMax=0.2),
    **_heights(WallHMin=0.25, WallHMax=0.5),
}
STEPS = {
    **_lengths(StepSpacingMin=5, StepSpacingMax=7),
    **_heights(StepH0Min=0.1, StepH0Max=0.4, StepH1Min=-0.4, StepH1Max=-0.1),
}
NARROW_GAPS = {
    **_lengths(NarrowGapSpacingMin=3, NarrowGapSpacingMax=6),
    **_lengths(NarrowGapDistMin=0.1, NarrowGapDistMax=0.4),
    **_lengths(NarrowGapWMin=0.15, NarrowGapWMax=0.5),
    **_heights(NarrowGapDepthMin=-2, NarrowGapDepthMax=-2),
    **_counts(NarrowGapCountMin=1, NarrowGapCountMax=4),
}
CLIFFS = {
    **_lengths(CliffSpacingMin=5, CliffSpacingMax=7),
    **_heights(CliffH0Min=0.1, CliffH0Max=0.4, CliffH1Min=-0.4, CliffH1Max=-0.1),
    **_counts(CliffMiniCountMax=0),
}
BUMPS = _heights(BumpHMin=0, BumpHMax=0.03)
FACES = _lengths(FaceLength=0)
SLOPES = _slopes(SlopeDeltaRange=0.25, SlopeDeltaMin=-0.35, SlopeDeltaMax=0.35)

# Features: each function draws one and writes it as runs of equal height, (number of vertices,
# height), in order. Heights are relative to the ground before the feature; the last run is the
# ground after it.


class Runs(NamedTuple):
    """Preallocated arrays for runs of equal height."""

    counts: np.ndarray
    levels: np.ndarray


# Features, and the index of their first parameter among those of the type. A Max follows its Min.
_GAP, _STEP, _WALL, _MIXED, _NARROW_GAPS, _CLIFF = range(6)
_MIXTURE = {**GAPS, **WALLS, **STEPS}
_SPACING, _WIDTH, _TOP = (list(GAPS).index(f'Gap{name}Min') for name in ('Spacing', 'W', 'H'))
_RISES = list(STEPS).index('StepH0Min'), list(STEPS).index('StepH1Min')
_DISTANCE, _NARROW_WIDTH, _DEPTH, _COUNTS = (
    list(NARROW_GAPS).index(f'NarrowGap{name}Min') for name in ('Dist', 'W', 'Depth', 'Count')
)
_LEDGES = list(CLIFFS).index('CliffMiniCountMax')
_FIRST_WALL, _FIRST_STEP = len(GAPS), len(GAPS) + len(WALLS)
_NAMES = tuple(tuple(names) for names in (GAPS, STEPS, WALLS, _MIXTURE, NARROW_GAPS, CLIFFS))
_MOST_CELLS = cells(MOST_LENGTH)
_MOST_RUNS = 3 * MOST_COUNT + 3  # of a feature


@compiled_inline
def _cells(length: float) -> int:
    return nearest_index(np.ceil(length / SPACING - 1e-9), _MOST_CELLS + 1)


@compiled_inline
def _uniform(of: int, parameters: np.ndarray, bits: int) -> float:
    """Draws from the range of a parameter."""
    return parameters[of] + (parameters[of + 1] - parameters[of]) * random.draw(bits)


@compiled_inline
def _integer(low: float, high: float, bits: int) -> int:
    """Draws an integer, both ends included; interpolated counts are truncated only here."""
    first, last = nearest_index(low, MOST_COUNT + 1), nearest_index(high, MOST_COUNT + 1)
    return first + int((last - first + 1) * random.draw(bits))


@compiled_inline
def _add(number: int, count: int, level: float, runs: Runs) -> int:
    """Appends a run; returns the new number of runs."""
    runs.counts[number], runs.levels[number] = count, level
    return number + 1


@compiled
def _box(number: int, first: int, parameters: np.ndarray, bits: int, runs: Runs) -> int:
    """Adds a gap or a wall, whose parameters begin at index `first`; returns the number of runs."""
    spacing = _cells(_uniform(first + _SPACING, parameters, bits))
    width = _cells(_uniform(first + _WIDTH, parameters, bits))
    number = _add(number, spacing, 0.0, runs)
    number = _add(number, width, _uniform(first + _TOP, parameters, bits), runs)
    return _add(number, 1, 0.0, runs)


@compiled
def _rise_range(first: int, parameters: np.ndarray, bits: int) -> int:
    """Chooses one of the two ranges of a signed rise.

    A range whose ends are both 0 is switched off; of two active ranges, each has probability 1/2.
    The sign of the rise is that of the range: with two positive ranges the ground only ascends.
    """
    low, high = first + _RISES[0], first + _RISES[1]
    down = parameters[high] != 0.0 or parameters[high + 1] != 0.0
    if (parameters[low] != 0.0 or parameters[low + 1] != 0.0) != down:
        _integer(0.0, 0.0, bits)
        return high if down else low
    return high if _integer(0.0, 1.0, bits) else low


@compiled
def _step(number: int, first: int, parameters: np.ndarray, bits: int, runs: Runs) -> int:
    rise = _rise_range(first, parameters, bits)
    spacing = _cells(_uniform(first + _SPACING, parameters, bits))
    number = _add(number, spacing, 0.0, runs)
    return _add(number, 1, _uniform(rise, parameters, bits), runs)


@compiled
def _narrow_gaps(number: int, first: int, parameters: np.ndarray, bits: int, runs: Runs) -> int:
    """A cluster of gaps with stepping stones; all depths are relative to the same surface."""
    spacing = first + _SPACING
    low, high = max(1.0, parameters[first + _COUNTS]), max(1.0, parameters[first + _COUNTS + 1])
    for _ in range(_integer(low, high, bits)):
        number = _add(number, _cells(_uniform(spacing, parameters, bits)), 0.0, runs)
        width = _cells(_uniform(first + _NARROW_WIDTH, parameters, bits))
        number = _add(number, width, _uniform(first + _DEPTH, parameters, bits), runs)
        number = _add(number, 1, 0.0, runs)
        spacing = first + _DISTANCE
    return number


@compiled
def _cliff(number: int, first: int, parameters: np.ndarray, bits: int, runs: Runs) -> int:
    """One tall riser, broken by up to CliffMiniCountMax ledges at random heights."""
    rise = _rise_range(first, parameters, bits)
    tread = _uniform(first + _SPACING, parameters, bits)
    total, level = _uniform(rise, parameters, bits), 0.0
    for _ in range(_integer(0.0, parameters[first + _LEDGES], bits)):
        number = _add(number, _cells(tread), level, runs)
        level += (total - level) * random.draw(bits)
        number = _add(number, 1, level, runs)
        tread = LEDGE
    number = _add(number, _cells(tread), level, runs)
    return _add(number, 1, total, runs)


@compiled
def _draw_feature(kind: int, number: int, parameters: np.ndarray, bits: int, runs: Runs) -> int:
    first = 0
    if kind == _MIXED:
        kind = _integer(float(_GAP), float(_WALL), bits)
        first = _FIRST_STEP if kind == _STEP else _FIRST_WALL if kind == _WALL else 0
    if kind == _STEP:
        return _step(number, first, parameters, bits, runs)
    if kind == _NARROW_GAPS:
        return _narrow_gaps(number, first, parameters, bits, runs)
    if kind == _CLIFF:
        return _cliff(number, first, parameters, bits, runs)
    return _box(number, first, parameters, bits, runs)


@compiled
def _draw_features(
    kind: int, face: int, missing: int, number: int, parameters: np.ndarray, bits: int, runs: Runs
) -> tuple[int, int]:
    """Draws features until no vertices are missing, or the arrays are full.

    Runs that begin with a face have at least its number of cells, `face`.

    Returns:
      The number of runs, and the number of vertices that are still missing.
    """
    counts, levels = runs.counts, runs.levels
    base = levels[number - 1] if number else 0.0
    while missing > 0 and number + _MOST_RUNS <= len(counts):
        before, number = number, _draw_feature(kind, number, parameters, bits, runs)
        for k in range(before, number):
            levels[k] += base
            if counts[k] > 0 and levels[k] != (levels[k - 1] if k else 0.0):
                counts[k] = max(counts[k], face)
            missing -= counts[k]
        base = levels[number - 1]
    return number, missing


@compiled
def _spread(number: int, face: int, runs: Runs, heights: np.ndarray, vertical: np.ndarray) -> None:
    """Writes the vertices of runs.

    One that begins at another height begins with a ramp of `face` cells, or a vertical cell if
    that is 0.
    """
    counts, levels = runs
    i, before = 0, 0.0
    for k in range(number):
        for j in range(i, i + counts[k]):
            heights[j], vertical[j] = levels[k], False
        if levels[k] != before and i < len(vertical):  # a run may have no vertices
            vertical[i] = face == 0
            foot = heights[i - 1] if i else 0.0
            for j in range(min(face - 1, counts[k])):
                heights[i + j] = foot + (levels[k] - foot) * ((j + 1) / face)
        i, before = i + counts[k], levels[k]


def _repeat(kind: int, parameters: Parameters, length: float, rng: np.random.Generator) -> Profile:
    """Repeats a feature until the length is reached; every feature has at least one vertex."""
    wanted = missing = cells(length)
    values = np.array([parameters[name] for name in _NAMES[kind]], float)
    face = cells(min(max(0.0, parameters['FaceLength']), MOST_LENGTH))  # of users' generators, too
    bits, number = random.address(rng), 0
    runs = Runs(np.empty(_MOST_RUNS + missing, int), np.empty(_MOST_RUNS + missing))
    while True:
        number, missing = _draw_features(kind, face, missing, number, values, bits, runs)
        if missing <= 0:
            break
        runs = Runs(*(np.resize(array, 2 * len(array)) for array in runs))
    heights, vertical = np.empty(wanted - missing), np.empty(wanted - missing, bool)
    _spread(number, face, runs, heights, vertical)
    return Profile(heights, vertical)


# Overlays: added to the heights of a stretch.


def _sloped(profile: Profile, parameters: Parameters, rng: np.random.Generator) -> Profile:
    """Adds a mean-reverting random walk of the slope, which starts at slope 0 in every stretch.

    Per vertex the slope changes by up to SlopeDeltaRange: down with a probability that grows
    from 0 to 1 as the slope crosses the band from SlopeDeltaMin to SlopeDeltaMax, else up.
    A band of width 0 adds nothing.
    """
    low, high = parameters['SlopeDeltaMin'], parameters['SlopeDeltaMax']
    if low == high:
        return profile
    count = len(profile.heights)
    changes, thresholds = rng.random((2, count))
    changes *= abs(parameters['SlopeDeltaRange'])
    thresholds = low + (high - low) * thresholds
    heights = np.empty(count)
    _walk(profile.heights, changes, thresholds, heights)
    return Profile(heights, profile.vertical)


@compiled
def _walk(
    heights: np.ndarray, changes: np.ndarray, thresholds: np.ndarray, sloped: np.ndarray
) -> None:
    """Adds a random walk of the slope to heights."""
    slope = offset = 0.0
    for k in range(len(heights)):
        slope = slope - changes[k] if slope > thresholds[k] else slope + changes[k]
        offset += slope
        sloped[k] = heights[k] + offset * SPACING


@register('var2d_flat')
def flat(parameters: Parameters, length: float, rng: np.random.Generator) -> Profile:
    """Level ground."""
    count = cells(length)
    return Profile(np.zeros(count), np.zeros(count, dtype=bool))


@register('var2d_bumps', BUMPS)
def bumps(parameters: Parameters, length: float, rng: np.random.Generator) -> Profile:
    """Level ground with white noise: every vertex but the last is moved up or down."""
    profile = flat(parameters, length, rng)
    sizes, coins = rng.random((2, len(profile.heights) - 1))
    low, high = parameters['BumpHMin'], parameters['BumpHMax']
    profile.heights[:-1] = np.where(coins < 0.5, 1, -1) * (low + (high - low) * sizes)
    return profile


@register('var2d_slopes', SLOPES)
def slopes(parameters: Parameters, length: float, rng: np.random.Generator) -> Profile:
    """Rolling ground."""
    return _sloped(flat(parameters, length, rng), parameters, rng)


@register('var2d_cliffs', {**CLIFFS, **FACES})
def cliffs(parameters: Parameters, length: float, rng: np.random.Generator) -> Profile:
    """Tall risers broken by ledges."""
    return _repeat(_CLIFF, parameters, length, rng)


def _register_feature(name: str, kind: int, own: Mapping[str, Parameter], words: str) -> None:
    """Registers a feature twice: on level ground and on rolling ground; `words` describe it."""

    def level(parameters: Parameters, length: float, rng: np.random.Generator) -> Profile:
        return _repeat(kind, parameters, length, rng)

    def rolling(parameters: Parameters, length: float, rng: np.random.Generator) -> Profile:
        return _sloped(level(parameters, length, rng), parameters, rng)

    level.__doc__, rolling.__doc__ = f'{words} on level ground.', f'{words} on rolling ground.'
    register(f'var2d_{name}', {**own, **FACES})(level)
    register(f'var2d_slopes_{name}', {**own, **FACES, **SLOPES})(rolling)


_register_feature('gaps', _GAP, GAPS, 'Gaps')
_register_feature('walls', _WALL, WALLS, 'Walls')
_register_feature('steps', _STEP, STEPS, 'Steps')
_register_feature('mixed', _MIXED, _MIXTURE, 'Gaps, walls and steps')
_register_feature(
    'narrow_gaps', _NARROW_GAPS, NARROW_GAPS, 'Clusters of gaps with stepping stones between them'
)
