"""Pushes: forces of finite duration on bodies of each simulation, at random times.

The force that acts during a control step is the mean of the push over that step, so that the
impulse of a push is force times duration, however long control steps are and wherever in a step it
begins. It is added to `xfrc_applied` while the physics is advanced, and removed afterwards: what a
task or a user writes there is kept.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from trl_suite.util.compiled import compiled, floats_at
from trl_suite.util.random import uniform

FORCE, DURATION, INTERVAL, DIRECTION = range(4)  # rows of `Pushes.ranges`
_STRIDE = 48  # bytes; `xfrc_applied` has force and torque of each body


class PushState(NamedTuple):
    """The current or next push of each of P series, part of the state of n simulations.

    Attributes:
      begin, end: simulated time at which it begins and ends, (n, P) s; infinite if there is none.
      force: (n, P, 3) N.
      impulse: impulse of all pushes since the array was last cleared, (n, 3) N s.
      stream: random stream, see `trl_suite.util.random.seed_stream`, (n, 6).
    """

    begin: np.ndarray
    end: np.ndarray
    force: np.ndarray
    impulse: np.ndarray
    stream: np.ndarray


class Pushes(NamedTuple):
    """P series of pushes in n simulations.

    Attributes:
      state: the pushes.
      ranges: bounds of force (N), duration (s), interval (s) and direction (rad to the left of +x),
        (P, 4, 2), between which they are drawn uniformly.
      mass: mass by which the force is multiplied over its duration, (P,) kg, if the first of the
        ranges has changes of velocity in m/s; 0 if it has forces.
      planar: whether forces act along x only, (P,); the sign is that of the cosine of the
        direction.
      body: body on which the force acts, at its centre of mass, (P,).
      applied: address of `xfrc_applied` in each mjData, (n,).
      kept: forces on the bodies without the pushes, (n, P, 3) N.
    """

    state: PushState
    ranges: np.ndarray
    mass: np.ndarray
    planar: np.ndarray
    body: np.ndarray
    applied: np.ndarray
    kept: np.ndarray


def no_pushes(applied: np.ndarray, series: int) -> Pushes:
    """Returns arrays without any push, for n addresses of `xfrc_applied`."""
    n = len(applied)
    return Pushes(
        state=PushState(
            begin=np.full((n, series), np.inf),
            end=np.full((n, series), np.inf),
            force=np.zeros((n, series, 3)),
            impulse=np.zeros((n, 3)),
            stream=np.zeros((n, 6), np.uint64),
        ),
        ranges=np.zeros((series, 4, 2)),
        mass=np.zeros(series),
        planar=np.zeros(series, bool),
        body=np.zeros(series, int),
        applied=applied,
        kept=np.zeros((n, series, 3)),
    )


@compiled
def draw(i: int, k: int, after: float, pushes: Pushes) -> None:
    """Draws the next push of series k; its interval begins at a time `after`."""
    state, ranges = pushes.state, pushes.ranges[k]
    begin = after + uniform(i, ranges[INTERVAL, 0], ranges[INTERVAL, 1], state.stream)
    duration = uniform(i, ranges[DURATION, 0], ranges[DURATION, 1], state.stream)
    force = uniform(i, ranges[FORCE, 0], ranges[FORCE, 1], state.stream)
    angle = uniform(i, ranges[DIRECTION, 0], ranges[DIRECTION, 1], state.stream)
    if pushes.mass[k] > 0.0:
        force *= pushes.mass[k] / duration
    ahead, aside = math.cos(angle), math.sin(angle)
    if pushes.planar[k]:
        ahead, aside = (1.0 if ahead >= 0.0 else -1.0), 0.0
    state.begin[i, k], state.end[i, k] = begin, begin + duration
    state.force[i, k, 0], state.force[i, k, 1], state.force[i, k, 2] = (
        force * ahead,
        force * aside,
        0.0,
    )


# Numba leaves out what follows a return for an argument that is None, and so does not compile pushes
# for an engine without.


@compiled
def push(i: int, time: float, duration: float, pushes: Pushes | None) -> None:
    """Adds the mean forces of a period to those on the bodies, and draws pushes that follow in it.

    Args:
      i: index of the simulation.
      time: start of the period, s.
      duration: its duration, s.
      pushes: the pushes; None for none.
    """
    if pushes is None:
        return
    state, finish = pushes.state, time + duration
    for k in range(len(pushes.body)):
        applied = floats_at(pushes.applied[i] + _STRIDE * pushes.body[k], 3)
        for axis in range(3):
            pushes.kept[i, k, axis] = applied[axis]
        while state.begin[i, k] < finish:
            overlap = min(state.end[i, k], finish) - max(state.begin[i, k], time)
            if overlap > 0.0:
                for axis in range(3):
                    state.impulse[i, axis] += overlap * state.force[i, k, axis]
                    applied[axis] += (overlap / duration) * state.force[i, k, axis]
            if state.end[i, k] > finish:
                break
            draw(i, k, state.end[i, k], pushes)


@compiled
def release(i: int, pushes: Pushes | None) -> None:
    """Restores the forces on the bodies, bit for bit."""
    if pushes is None:
        return
    for k in range(len(pushes.body) - 1, -1, -1):
        applied = floats_at(pushes.applied[i] + _STRIDE * pushes.body[k], 3)
        for axis in range(3):
            applied[axis] = pushes.kept[i, k, axis]
