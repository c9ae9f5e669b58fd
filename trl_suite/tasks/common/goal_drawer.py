"""Goals, and the ball that is dribbled to them, drawn again when their time has expired."""

from __future__ import annotations

import numpy as np

from trl_suite.arenas import SpatialArena
from trl_suite.engine import World
from trl_suite.tasks.common.ball import GOAL_AWAY, Ball
from trl_suite.tasks.common.goals import Goals, set_goal
from trl_suite.tasks.common.spatial_rules import Clock
from trl_suite.tasks.task import random_displacement


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
        self, world: World, goals: Goals, clock: Clock, random: list[np.random.Generator]
    ) -> None:
        """Connects it to a world.

        Args:
          world: the simulations.
          goals: their goals, written here.
          clock: their clocks.
          random: the random generator of each simulation; a list that the task updates.
        """
        self._world, self._goals, self._clock, self._random = world, goals, clock, random

    def begin(self, i: int, place: np.ndarray) -> None:
        """Places the ball of a simulation, and draws the first goal of its episode.

        Args:
          i: index of the simulation.
          place: position of the walker, (2,) m.
        """
        if self._ball:
            self._ball.put(i, place, self._clock.steps[i], self._random[i])
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
                self._ball.put(i, places[i], self._clock.steps[i], self._random[i])
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
        set_goal(i, goal, self._clock.steps[i], random, self._goals)
