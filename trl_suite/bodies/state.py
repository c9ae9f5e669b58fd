"""Named tuples of arrays, whose defaults are the row of one simulation.

class Progress(NamedTuple):
    speed: np.ndarray = REAL
    place: np.ndarray = PLACE

progress = allocated(Progress, n)  # speed (n,), place (n, 3)
"""

from __future__ import annotations

from typing import Any

import numpy as np

REAL, WHOLE, FLAG = np.zeros(()), np.zeros((), int), np.zeros((), bool)
POINT, PLACE = np.zeros(2), np.zeros(3)


def allocated(kind: Any, n: int, **rows: np.ndarray) -> Any:
    """Returns arrays of zeros for n simulations; `rows`: those without defaults, by name."""
    rows = kind._field_defaults | rows
    return kind(**{name: np.zeros((n, *row.shape), row.dtype) for name, row in rows.items()})
