"""Goals on the ground, which are redrawn when they are reached or their time has expired."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from trl_suite.kinematics.blocks import Block, Noise, signs
from trl_suite.tasks.task import CONTROL_TIMESTEP, Marker

GOAL_LASTS = (50.0, 100.0)  # s until a goal that was not reached is redrawn
GOAL_COLOUR = (0.85, 0.15, 0.2, 0.8)
FLAG = (0.1, 0.6, 0.0)  # m; marker of the goal: radius and half height of a cylinder


class Goals(NamedTuple):
    """The goal of each simulation.

    Attributes:
      place: position, (n, 3) m.
      due: control step of the episode at which it is redrawn, (n,).
      reached: number of goals reached in the episode, (n,).
      wanted: whether it must be redrawn now, (n,).
    """

    place: np.ndarray
    due: np.ndarray
    reached: np.ndarray
    wanted: np.ndarray


def goals(n: int) -> Goals:
    """Allocates the goals of n simulations."""
    return Goals(np.zeros((n, 3)), np.zeros(n, int), np.zeros(n, int), np.zeros(n, bool))


def set_goal(
    env_id: int, place: np.ndarray, count: int, random: np.random.Generator, goals: Goals
) -> None:
    """Sets a goal (3,) m at control step `count` of the episode, and draws when it expires."""
    goals.place[env_id] = place
    goals.due[env_id] = count + round(random.uniform(*GOAL_LASTS) / CONTROL_TIMESTEP)


GOAL = Block(
    'goal', 2, 'rad, m', 'bearing (positive to the left) and distance of the goal',
    Noise((0.01, 0.03, 0.1)), signs((-1.0, 1.0)),
)  # fmt: skip


def flag(goal: Any) -> Marker:
    """Returns the marker of a goal (3,), m."""
    return Marker('cylinder', np.add(goal, (0, 0, FLAG[1])), FLAG, GOAL_COLOUR)
