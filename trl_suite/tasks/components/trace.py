"""Where a body has been, for pictures."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trl_suite.tasks.task import Marker
from trl_suite.util.compiled import compiled

EVERY = 5  # control steps between two places
PLACES = 60  # that are kept: 10 s
RADIUS = 0.025  # m
COLOUR = (0.98, 0.75, 0.1, 0.9)


class Trace(NamedTuple):
    """The last places of n bodies.

    Attributes:
      places: (n, PLACES, 3) m; NaN where nothing has been yet.
    """

    places: np.ndarray


def trace(n: int) -> Trace:
    """Makes room for the places of n bodies."""
    return Trace(np.full((n, PLACES, 3), np.nan))


@compiled
def follow(i: int, count: int, place: np.ndarray, trace: Trace) -> None:
    """Takes in where body i of (n, 3) is, m, after `count` control steps."""
    if count % EVERY == 0:
        for k in range(3):
            trace.places[i, count // EVERY % PLACES, k] = place[i, k]


def trace_markers(env_id: int, trace: Trace) -> list[Marker]:
    """Spheres where a body has been."""
    places, size = trace.places[env_id], (RADIUS,) * 3
    return [Marker('sphere', place, size, COLOUR) for place in places[np.isfinite(places[:, 0])]]
