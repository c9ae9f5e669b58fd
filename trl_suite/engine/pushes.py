"""Pushes: forces of finite duration on one body of each simulation, at random times.

The force that acts during a control step is the mean of the push over that step, so that the
impulse of a push is force times duration, however long control steps are and wherever in a step it
begins. It is added to `xfrc_applied` while the physics is advanced, and removed afterwards: what a
task or a user writes there is kept.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from trl_suite.util.compiled import compiled
from trl_suite.util.random import uniform

FORCE, DURATION, INTERVAL, DIRECTION = range(4)  # rows of `Pushes.ranges`


class PushState(NamedTuple):
    """The current or next push of each simulation; part of the state of a simulation.

    Attributes:
      begin, end: simulated time at which it begins and ends, (n,) s; infinite if there is none.
      force: (n, 3) N.
      impulse: impulse of all pushes since the array was last cleared, (n, 3) N s.
      stream: random stream, see `trl_suite.util.random.Streams`, (n, 6).
    """

    begin: np.ndarray
    end: np.ndarray
    force: np.ndarray
    impulse: np.ndarray
    stream: np.ndarray


class Pushes(NamedTuple):
    """Pushes of n simulations.

    Attributes:
      state: the pushes.
      ranges: bounds of force (N), duration (s), interval (s) and direction (rad to the left of +x),
        (4, 2), between which they are drawn uniformly.
      mass: mass by which the force is multiplied over its duration, (1,) kg, if the first of the
        ranges has changes of velocity in m/s; 0 if it has forces.
      planar: whether forces act along x only, (1,); the sign is that of the cosine of the
        direction.
      body: body on which the force acts, at its centre of mass, (1,).
      forces: address of `xfrc_applied` in each mjData, (n,).
      scratch: forces on the body without and with the push, (n, 6) N.
      places: addresses of the rows of `scratch`, (n,).
    """

    state: PushState
    ranges: np.ndarray
    mass: np.ndarray
    planar: np.ndarray
    body: np.ndarray
    forces: np.ndarray
    scratch: np.ndarray
    places: np.ndarray


def no_pushes(forces: np.ndarray) -> Pushes:
    """Returns arrays without any push, for n addresses of `xfrc_applied`."""
    n = len(forces)
    scratch = np.zeros((n, 6))
    start = scratch.__array_interface__['data'][0]
    return Pushes(
        PushState(
            np.full(n, np.inf), np.full(n, np.inf), np.zeros((n, 3)), np.zeros((n, 3)),
            np.zeros((n, 6), np.uint64),
        ),
        np.zeros((4, 2)), np.zeros(1), np.zeros(1, bool), np.zeros(1, int), forces, scratch,
        start + scratch.strides[0] * np.arange(n),
    )  # fmt: skip


@compiled
def draw(i: int, after: float, pushes: Pushes) -> None:
    """Draws the next push; its interval begins at a time `after`."""
    state, ranges = pushes.state, pushes.ranges
    begin = after + uniform(i, ranges[INTERVAL, 0], ranges[INTERVAL, 1], state.stream)
    duration = uniform(i, ranges[DURATION, 0], ranges[DURATION, 1], state.stream)
    force = uniform(i, ranges[FORCE, 0], ranges[FORCE, 1], state.stream)
    angle = uniform(i, ranges[DIRECTION, 0], ranges[DIRECTION, 1], state.stream)
    if pushes.mass[0] > 0.0:
        force *= pushes.mass[0] / duration
    ahead, aside = math.cos(angle), math.sin(angle)
    if pushes.planar[0]:
        ahead, aside = (1.0 if ahead >= 0.0 else -1.0), 0.0
    state.begin[i], state.end[i] = begin, begin + duration
    state.force[i, 0], state.force[i, 1], state.force[i, 2] = force * ahead, force * aside, 0.0


@compiled
def advance(i: int, time: float, duration: float, pushes: Pushes) -> bool:
    """Writes the mean force of a period to `scratch[i, 3:]`, and draws pushes that follow in it.

    Args:
      i: index of the simulation.
      time: start of the period, s.
      duration: its duration, s.
      pushes: the pushes.

    Returns:
      Whether there is a force in this period.
    """
    state, finish, pushed = pushes.state, time + duration, False
    while state.begin[i] < finish:
        overlap = min(state.end[i], finish) - max(state.begin[i], time)
        if overlap > 0.0:
            if not pushed:
                pushed = True
                for k in range(3):
                    pushes.scratch[i, 3 + k] = 0.0
            for k in range(3):
                state.impulse[i, k] += overlap * state.force[i, k]
                pushes.scratch[i, 3 + k] += (overlap / duration) * state.force[i, k]
        if state.end[i] > finish:
            break
        draw(i, state.end[i], pushes)
    return pushed
