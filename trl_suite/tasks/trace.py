"""Where a body has been, for pictures."""

from __future__ import annotations

import numpy as np

from trl_suite.tasks.task import Marker

EVERY = 5  # control steps between two places
PLACES = 60  # that are kept: 10 s
RADIUS = 0.025  # m
COLOUR = (0.98, 0.75, 0.1, 0.9)


class Trace:
    """The last places of n bodies.

    Attributes:
      places: (n, PLACES, 3) m; NaN where nothing has been yet.
    """

    def __init__(self, n: int) -> None:
        self.places = np.full((n, PLACES, 3), np.nan)

    def begin(self, rows: np.ndarray) -> None:
        self.places[rows] = np.nan

    def follow(self, rows: np.ndarray, count: np.ndarray, place: np.ndarray) -> None:
        """Takes in where some bodies are, (m, 3) m, after `count` (m,) control steps."""
        kept = count % EVERY == 0
        self.places[rows[kept], count[kept] // EVERY % PLACES] = place[kept]

    def markers(self, row: int) -> list[Marker]:
        places = self.places[row]
        size = (RADIUS,) * 3
        return [
            Marker('sphere', place, size, COLOUR) for place in places[np.isfinite(places[:, 0])]
        ]
