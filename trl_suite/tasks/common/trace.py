"""Past positions of a body, for rendering."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trl_suite.tasks.task import Marker
from trl_suite.util.compiled import compiled

EVERY = 5  # control steps between two stored positions
PLACES = 60  # stored positions: 10 s
RADIUS = 0.025  # of the markers, m
COLOUR = (0.98, 0.75, 0.1, 0.9)


class Trace(NamedTuple):
    """The last positions of n bodies.

    Attributes:
      places: (n, PLACES, 3) m, a ring buffer; NaN where no position has been stored yet.
    """

    places: np.ndarray


def trace(n: int) -> Trace:
    """Allocates the trace of n bodies."""
    return Trace(np.full((n, PLACES, 3), np.nan))


@compiled
def follow(i: int, count: int, place: np.ndarray, trace: Trace) -> None:
    """Stores the position of body i, from `place` (n, 3) m, after `count` control steps."""
    if count % EVERY == 0:
        for k in range(3):
            trace.places[i, count // EVERY % PLACES, k] = place[i, k]


def trace_markers(env_id: int, trace: Trace) -> list[Marker]:
    """Returns spheres at the stored positions of a body."""
    places, size = trace.places[env_id], (RADIUS,) * 3
    return [Marker('sphere', place, size, COLOUR) for place in places[np.isfinite(places[:, 0])]]
