"""Falls of tasks with long steps: a fall link often touches the ground, as in the original."""

from __future__ import annotations

import numpy as np

from trl_suite.util.compiled import compiled

# The decaying average of samples, with contact or without, and that above which it is a fall.
DECAY, GAIN, THRESHOLD = 0.9, 1 / 11, 0.25


@compiled
def sample(i: int, touches: bool, down: np.ndarray) -> None:
    """Updates the average `down` (n,) of a simulation by a sample."""
    down[i] *= DECAY
    if touches:
        down[i] += GAIN


def condition() -> str:
    """Returns the condition in words, after the names of the links."""
    share, count = 0.0, 0
    while share <= THRESHOLD:
        share, count = DECAY * share + GAIN, count + 1
    return (
        f'touches the ground in {count} consecutive samples, or so often that d > {THRESHOLD:g}, where '
        f'every sample multiplies d by {DECAY:g} and adds 1/{1 / GAIN:.0f} if there is contact'
    )
