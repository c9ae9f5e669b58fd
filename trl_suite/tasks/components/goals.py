"""Goals on the ground that are drawn anew when they were reached, or not in time; a component."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from trl_suite.tasks.components.spatial_rules import CONTROL_TIMESTEP
from trl_suite.tasks.task import Marker

GOAL_LASTS = (50.0, 100.0)  # s until a goal that was not reached is drawn anew
GOAL_COLOUR = (0.85, 0.15, 0.2, 0.8)
FLAG = (0.1, 0.6, 0.0)  # m; marker of the goal: radius and half height


class Goals(NamedTuple):
    """The goal of each simulation.

    Attributes:
      place: (n, 3) m.
      due: control step of the episode at which it is drawn anew, (n,).
      reached: how many were reached in the episode, (n,).
      wanted: whether another one is wanted now, (n,).
    """

    place: np.ndarray
    due: np.ndarray
    reached: np.ndarray
    wanted: np.ndarray


def goals(n: int) -> Goals:
    """Makes room for the goals of n simulations."""
    return Goals(np.zeros((n, 3)), np.zeros(n, int), np.zeros(n, int), np.zeros(n, bool))


def set_goal(
    env_id: int, place: np.ndarray, count: int, random: np.random.Generator, goals: Goals
) -> None:
    """Sets a goal (3,) m at a control step of the episode, and draws how long it lasts."""
    goals.place[env_id] = place
    goals.due[env_id] = count + round(random.uniform(*GOAL_LASTS) / CONTROL_TIMESTEP)


def flag(goal: Any) -> Marker:
    """Returns what stands at a goal (3,), m."""
    return Marker('cylinder', np.add(goal, (0, 0, FLAG[1])), FLAG, GOAL_COLOUR)
