"""Cutting one cycle from a clip, so that it can loop."""

from __future__ import annotations

import dataclasses

import numpy as np

from trl_suite.motion import Clip

CYCLE = (0.3, 2.5)  # s; shortest and longest cycle in the search
MOST_FRAMES = 100_000
MOST = 300  # starts, and ends for each, that are compared at a time
RATE_TIME = 0.1  # s; weight of a difference of velocities against one of poses


def cycle(clip: Clip, start: float | None = None, end: float | None = None) -> Clip:
    """Cuts one cycle from a clip, so that it can loop.

    The difference between its end and its start is distributed evenly over the cycle, except for
    the horizontal displacement, which every cycle repeats. Give both times, or none: then the two
    times with the most similar poses and velocities are chosen, 0.3 to 2.5 s apart.

    Args:
      clip: a clip that does not loop.
      start: start of the cycle, s.
      end: end of the cycle, s.

    Raises:
      ValueError: a clip that loops or is too short, times that are not in it, or one without the other,
        or a cycle of too many frames.
    """
    if clip.loop:
        raise ValueError(f'clip {clip.name!r} loops already; expected one that does not')
    if (start is None) is not (end is None):
        raise ValueError('start and end: expected both or none')
    if start is None or end is None:
        start, end = _alike(clip)
    if not 0 <= start < end <= clip.duration:
        raise ValueError(
            f'start and end are {start} and {end}; expected 0 <= start < end <= {clip.duration} s'
        )
    step = float(np.median(np.diff(clip.times)))
    if (frames := round((end - start) / step) + 1) > MOST_FRAMES:
        raise ValueError(
            f'clip {clip.name!r}: a cycle of {frames} frames, {step:g} s apart; expected at most {MOST_FRAMES}'
        )
    share = np.linspace(0, 1, max(3, frames))
    poses = clip.pose(start + share * (end - start))
    layout, flat = clip.layout, 1 if clip.root == 'planar' else 2
    gap = _change(clip, poses[-1], poses[0])
    gap[:flat] = 0.0
    poses = layout.changed(poses, share[:, None] * gap)
    poses[:, :flat] -= poses[0, :flat].copy()
    return dataclasses.replace(clip, times=share * (end - start), poses=poses, loop=True)


def _change(clip: Clip, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Returns changes between poses without whole turns of a planar root: a somersault ends one further."""
    change = clip.layout.change(before, after)
    if clip.root == 'planar':
        change[..., 2] -= 2 * np.pi * np.round(change[..., 2] / (2 * np.pi))
    return change


def _alike(clip: Clip) -> tuple[float, float]:
    """Returns the two times of a clip with the most similar poses and velocities, s."""
    if clip.duration < CYCLE[0]:
        raise ValueError(
            f'clip {clip.name!r} lasts {clip.duration} s; expected at least {CYCLE[0]} s, or the '
            'times of the cycle'
        )
    frame = float(np.median(np.diff(clip.times)))
    last, flat = clip.duration - CYCLE[0], 1 if clip.root == 'planar' else 2
    lengths = np.linspace(*CYCLE, min(MOST, 1 + round((CYCLE[1] - CYCLE[0]) / frame)))

    def best(low: float, high: float) -> tuple[float, float, float]:
        """Returns start and end of the best cycle that starts between two times, and their distance."""
        starts = np.linspace(low, high, max(2, min(MOST, 1 + round((high - low) / frame))))
        found = (np.inf, 0.0, 0.0)
        for start in starts:
            times = start + np.append(0, lengths[start + lengths <= clip.duration + 1e-9])
            times = np.minimum(times, clip.duration)  # after it, a clip does not move
            poses, rates = clip.pose(times), RATE_TIME * clip.velocity(times)
            change = _change(clip, np.broadcast_to(poses[0], poses[1:].shape), poses[1:])
            difference = (change[:, flat:] ** 2).sum(1) + ((rates[1:] - rates[0]) ** 2).sum(1)
            j = int(difference.argmin())
            found = min(found, (float(difference[j]), start, times[1 + j]))
        return found[1], found[2], starts[1] - starts[0]

    start, end, apart = best(0.0, last)
    if apart > frame:  # of a long clip
        start, end, _ = best(max(0.0, start - apart), min(last, start + apart))
    return float(start), float(min(end, clip.duration))
