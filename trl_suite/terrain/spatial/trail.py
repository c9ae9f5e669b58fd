"""The winding path of `trail3d`."""

from __future__ import annotations

import math

import numpy as np

from trl_suite.terrain.spatial import noise
from trl_suite.terrain.spatial.layout import GRID

SEGMENT = 2.0  # m
BEGIN = (-1.25, 0.0)  # m; start of the first segment
STRAIGHT = 2  # number of straight segments before the first turn
FREQUENCY = 0.005  # tiles of noise per m: five times finer than hills
AMPLITUDE = 5.0  # m; of the first octave
# rad; |heading| up to which turns are unbiased, and from which they always turn back.
EASY, WIDEST = 1.0, 0.6 * math.pi
MARGIN = 10.0  # m; a trail this far ahead does not return
MOST = 100_000  # segments


class Trail:
    """Segments of a path, generated on demand.

    Each segment has a different width, turns (by a smaller angle where the path is narrow, and with
    a higher probability towards straight ahead if its heading is more than 1 rad off), and may step
    up or down. Where the noise of the surrounding ground is above its mean, the smallest width of
    the path is larger.

    Attributes:
      start, end: end points of the existing segments, m, (k, 2).
      heading: heading of each segment, rad, (k,).
      width: width of each segment, m, (k,).
      height: height of each segment, m, (k,).
      offset: offset of the noise around the trail, (2,).
    """

    def __init__(self, parameters: dict[str, float], rng: np.random.Generator) -> None:
        """Generates the first segments.

        Args:
          parameters: those of `trail3d`.
          rng: used whenever the trail is extended; nothing else may draw from it.
        """
        self._parameters, self._rng = parameters, rng
        self.offset = rng.random(2)
        first, second = parameters['PathWidth0'], parameters['PathWidth1']
        self._narrowest, self._widest = min(first, second), max(first, second)
        width = self._narrowest + (self._widest - self._narrowest) * rng.random()
        # Of each segment: start (2), heading, width, height.
        self._segments = np.zeros((0, 5))
        self._added: list[tuple[float, float, float, float, float]] = []
        self._tip = (*BEGIN, 0.0, width, parameters['PathHeight0'])
        for _ in range(STRAIGHT):
            self._append()
        self._arrays()

    def extend(self, count: int) -> None:
        """Extends the trail to at least `count` segments."""
        for _ in range(min(count, MOST) - len(self._segments)):
            self._turn()
            self._append()
        self._arrays()

    def reach(self, x: float) -> None:
        """Extends the trail so far that further segments do not return to x m or less."""
        while self._tip[0] < x + MARGIN and len(self._segments) + len(self._added) < MOST:
            self._turn()
            self._append()
        self._arrays()

    def leave(self, half_side: float) -> int:
        """Returns the number of segments up to the first that ends outside a square at the origin."""
        self.reach(half_side)
        outside = (np.abs(self.end) > half_side).any(1)
        return int(outside.argmax()) + 1

    def paint(self, heights: np.ndarray, i: np.ndarray, j: np.ndarray) -> None:
        """Writes the trail into a grid: the vertices within half the width of a segment.

        Later segments overwrite earlier ones.

        Args:
          heights: (k, m), changed in place.
          i, j: indices of the vertices along x and y, consecutive, (k,) and (m,).
        """
        self.reach(i[-1] * GRID + 0.5 * self._widest)
        half = 0.5 * self.width[:, None]
        corner, size = np.array([i[0], j[0]]), (len(i), len(j))
        low = np.floor((np.minimum(self.start, self.end) - half) / GRID).astype(int) - corner
        high = np.ceil((np.maximum(self.start, self.end) + half) / GRID).astype(int) - corner + 1
        low, high = np.maximum(low, 0), np.minimum(high, size)
        crossing = np.flatnonzero((low < high).all(1))
        columns, rows = (i * GRID)[:, None], j * GRID
        for (a, c), (b, d), k in zip(
            low[crossing].tolist(), high[crossing].tolist(), crossing.tolist(), strict=True
        ):
            x0, y0, heading, width, height = self._segments[k].tolist()
            cosine, sine = math.cos(heading), math.sin(heading)
            x, y = columns[a:b] - x0, rows[c:d] - y0
            along = x * cosine + y * sine
            # Beyond the ends of a segment, the distance to the nearer end.
            beyond = along - np.minimum(np.maximum(along, 0), SEGMENT)
            distance = np.square(y * cosine - x * sine) + np.square(beyond)
            heights[a:b, c:d][distance <= 0.25 * width * width] = height

    def _turn(self) -> None:
        """Draws width, heading and height of the next segment."""
        parameters, random = self._parameters, self._rng.random
        x, y, heading, width, height = self._tip
        spread = self._widest - self._narrowest
        lowest = self._narrowest
        if spread and noise.above(x, -y, self.offset, FREQUENCY):
            lowest += 0.25 * spread
        width += parameters['PathWidthDeltaStdev'] * self._rng.standard_normal()
        width = min(max(width, lowest), self._widest)
        largest = parameters['PathMaxTurnDelta']
        if width < self._narrowest + 0.25 * spread:
            largest *= 0.5
        turn = largest * random()
        excess = math.copysign(max(abs(heading) - EASY, 0), heading)
        if random() < 0.5 * (1 + excess / (WIDEST - EASY)):
            turn = -turn
        if random() < parameters['TrailStepProb']:
            low, high = parameters['StepHeightMin'], parameters['StepHeightMax']
            step = low + (high - low) * random()
            height += step if random() < 0.5 else -step
        self._tip = (x, y, heading + turn, width, height)

    def _append(self) -> None:
        """Appends the segment that starts at the tip."""
        self._added.append(self._tip)
        x, y, heading, width, height = self._tip
        x, y = x + SEGMENT * math.cos(heading), y + SEGMENT * math.sin(heading)
        self._tip = (x, y, heading, width, height)

    def _arrays(self) -> None:
        if not self._added:
            return
        self._segments = segments = np.concatenate([self._segments, self._added])
        self._added = []
        self.start, self.heading = segments[:, :2], segments[:, 2]
        self.width, self.height = segments[:, 3], segments[:, 4]
        direction = np.stack([np.cos(self.heading), np.sin(self.heading)], 1)
        self.end = self.start + SEGMENT * direction
