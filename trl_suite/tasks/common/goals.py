"""Goals on the ground, which are redrawn when they are reached or their time has expired."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from trl_suite.arenas import SpatialArena
from trl_suite.bodies.blocks import Block, Noise, signs
from trl_suite.bodies.body import Measurement, polar
from trl_suite.bodies.reference import CONTROL_TIMESTEP
from trl_suite.bodies.state import FLAG, PLACE, WHOLE
from trl_suite.engine import World
from trl_suite.tasks.task import Marker, random_displacement
from trl_suite.util.compiled import compiled

if TYPE_CHECKING:
    from trl_suite.tasks.common.ball import Ball

GOAL_LASTS = (50.0, 100.0)  # s until a goal that was not reached is redrawn
GOAL_AWAY = (0.0, 10.0)  # m; distance of a new goal from the ball
GOAL_COLOUR = (0.85, 0.15, 0.2, 0.8)
TRACE_EVERY = 5  # control steps between two stored positions
TRACE_PLACES = 60  # stored positions: 10 s
TRACE_RADIUS = 0.025  # of the markers, m
TRACE_COLOUR = (0.98, 0.75, 0.1, 0.9)
FLAG_SIZE = (0.1, 0.6, 0.0)  # m; marker of the goal: radius and half height of a cylinder


class Goals(NamedTuple):
    """The goal of each simulation.

    Attributes:
      place: position, (n, 3) m.
      due: control step of the episode at which it is redrawn, (n,).
      reached: number of goals reached in the episode, (n,).
      wanted: whether it must be redrawn now, (n,).
    """

    place: np.ndarray = PLACE
    due: np.ndarray = WHOLE
    reached: np.ndarray = WHOLE
    wanted: np.ndarray = FLAG


GOAL = Block(
    'goal',
    2,
    'rad, m',
    'bearing (positive to the left) and distance of the goal',
    Noise((0.01, 0.03, 0.1)),
    signs((-1.0, 1.0)),
)


@compiled
def observe_place(
    i: int, column: int, x: float, y: float, measurement: Measurement, observation: np.ndarray
) -> None:
    """Writes bearing and distance of a place x, y m from the root, in world axes."""
    bearing, distance = polar(i, x, y, measurement)
    observation[i, column], observation[i, column + 1] = bearing, distance


def flag(goal: Any) -> Marker:
    """Returns the marker of a goal (3,), m."""
    return Marker('cylinder', np.add(goal, (0, 0, FLAG_SIZE[1])), FLAG_SIZE, GOAL_COLOUR)


class GoalDrawer:
    """Draws the goals of all simulations, and places their balls, if there are any."""

    def __init__(
        self,
        arena: SpatialArena,
        ball: Ball | None,
        rule: str,
        distance: tuple[float, float] | None = None,
    ) -> None:
        """Keeps how goals are drawn; `bind` is called before they are.

        Args:
          arena: the arena, which draws goals by the rule.
          ball: the ball, whose goal is drawn around it; None: the goal is that of the walker.
          rule: where goals of a walker are, see `SpatialGround.goal`.
          distance: minimum and maximum distance of goals from walker or ball, in any direction, m;
            None: by the rule, or `GOAL_AWAY` from a ball.
        """
        self._arena, self._ball, self._rule, self._distance = arena, ball, rule, distance

    def bind(
        self, world: World, goals: Goals, steps: np.ndarray, random: list[np.random.Generator]
    ) -> None:
        """Connects it to a world.

        Args:
          world: the simulations.
          goals: their goals, written here.
          steps: control steps of each episode, (n,).
          random: the random generator of each simulation; a list that the task updates.
        """
        self._world, self._goals, self._steps, self._random = world, goals, steps, random

    def begin(self, i: int, place: np.ndarray) -> None:
        """Places the ball of a simulation, and draws the first goal of its episode.

        Args:
          i: index of the simulation.
          place: position of the walker, (2,) m.
        """
        if self._ball:
            self._ball.put(i, place, self._steps[i], self._random[i])
        self._draw(i, place)

    def redraw(self, env_ids: np.ndarray, places: np.ndarray) -> None:
        """Places balls and draws goals again, where they have expired or were reached.

        Args:
          env_ids: indices of simulations.
          places: positions of the walkers of all simulations, (n, 2) m.
        """
        if self._ball:
            wanted = env_ids[self._ball.state.wanted[env_ids]]
            for i in wanted.tolist():
                self._ball.put(i, places[i], self._steps[i], self._random[i])
            self._world.forward(wanted)
        for i in env_ids[self._goals.wanted[env_ids]].tolist():
            self._draw(i, places[i])

    def _draw(self, i: int, place: np.ndarray) -> None:
        random = self._random[i]
        if self._ball:
            goal = self._ball.goal(i, random, self._distance or GOAL_AWAY)
        elif self._distance is None:
            goal = self._arena.goal(i, random, place, self._rule)
        else:
            x, y = place + random_displacement(random, *self._distance)
            height = self._arena.height(np.array([[x]]), np.array([[y]]), np.array([i]))
            goal = np.array([x, y, height[0, 0]])
        self._goals.place[i] = goal
        lasts = random.uniform(*GOAL_LASTS)
        self._goals.due[i] = self._steps[i] + round(lasts / CONTROL_TIMESTEP)


# Past positions of a body, for rendering.


class Trace(NamedTuple):
    """The last positions of n bodies.

    Attributes:
      places: (n, TRACE_PLACES, 3) m, a ring buffer; NaN where no position has been stored yet.
    """

    places: np.ndarray


def trace(n: int) -> Trace:
    """Allocates the trace of n bodies."""
    return Trace(np.full((n, TRACE_PLACES, 3), np.nan))


@compiled
def follow(i: int, count: int, place: np.ndarray, trace: Trace) -> None:
    """Stores the position of body i, from `place` (n, 3) m, after `count` control steps."""
    if count % TRACE_EVERY == 0:
        for k in range(3):
            trace.places[i, count // TRACE_EVERY % TRACE_PLACES, k] = place[i, k]


def trace_markers(env_id: int, trace: Trace) -> list[Marker]:
    """Returns spheres at the stored positions of a body."""
    places, size = trace.places[env_id], (TRACE_RADIUS,) * 3
    return [
        Marker('sphere', place, size, TRACE_COLOUR) for place in places[np.isfinite(places[:, 0])]
    ]
