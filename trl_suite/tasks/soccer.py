"""Dribbling a ball to a goal, by planning footsteps.

Source: the soccer scenario of the original; 'DeepLoco' (Peng, Berseth, Yin, van de Panne 2017).
"""

from __future__ import annotations

from types import MappingProxyType, SimpleNamespace
from typing import Any

import numpy as np

from trl_suite.arenas import SpatialTerrain
from trl_suite.engine import World
from trl_suite.tasks import ball
from trl_suite.tasks.figure3d import polar
from trl_suite.tasks.footsteps import GOAL_COLOUR
from trl_suite.tasks.high_level import HighLevel
from trl_suite.tasks.task import Marker
from trl_suite.tasks.tracking3d import CONTROL_TIMESTEP


class Soccer(HighLevel):
    """A spatial biped dribbles a ball to a goal; an action is a plan of two footsteps.

    `target_speed` is that of walker and ball; `goal_reached` and `goal_distance` are from the ball,
    whose ground must be level.

    Observation blocks, in this order (heading frame): pose, velocity as in `SpatialImitation`;
      target: bearing and distance of the goal as seen from the ball, rad and m.
      ball: bearing, distance and height of the ball (rad, m, m), its velocity (3), m/s, and its
        angular velocity (3), rad/s.
      low_level: with interface 'frame' only.
    """

    TERMS = ball.SOCCER_TERMS
    GOAL_REACHED = ball.AT_GOAL
    GOAL_BLOCKS = MappingProxyType({**HighLevel.GOAL_BLOCKS, 'ball': ball.MIRRORED})

    def _furnish(self, arena: SpatialTerrain) -> None:
        self.ball = ball.Ball(arena)

    def bind(self, world: World) -> None:
        super().bind(world)
        self.ball.bind(world)
        n = world.n
        self._ball_from = np.zeros((n, 3))  # m; ball at the beginning of the step
        self._ball_due = np.zeros(n, int)  # control step at which it is put elsewhere
        self.at_goal = np.zeros(n, bool)  # whether the ball is there

    def _begun_on_ground(self, rows: np.ndarray) -> None:
        super()._begun_on_ground(rows)
        self.at_goal[rows] = False
        self.world.forward(rows)  # balls have been put down

    def _begin_goal(self, row: int, found: SimpleNamespace) -> None:
        self._put_ball(row, found.root[row, :2])
        self._draw_goal(row, found.root[row, :2])

    def _put_ball(self, row: int, place: np.ndarray) -> None:
        lasts = self.ball.put(row, place, self._random[row])
        self._ball_due[row] = self._count[row] + round(lasts / CONTROL_TIMESTEP)

    def _goal_drawn(self, row: int, place: np.ndarray) -> np.ndarray:
        away = ball.GOAL_AWAY if self._goal_distance is None else self._goal_distance
        return self.ball.goal(row, self._random[row], away)

    def simulate(self, rows: np.ndarray | None = None) -> None:
        self._ball_from[...] = self.ball.place
        super().simulate(rows)

    def _reward_terms(self, rows: np.ndarray, found: SimpleNamespace) -> None:
        walker = self._from[rows]
        terms, self._speed[rows], self.at_goal[rows] = ball.terms(
            walker, found.com[rows] - walker, self._ball_from[rows], self.ball.place[rows],
            self.goal[rows], CONTROL_TIMESTEP * np.maximum(self._lasted[rows], 1),
            self._target_speed, self._goal_reached,
        )  # fmt: skip
        self.reward_terms[rows] = terms

    def _look_at_goal(self, row: int, found: SimpleNamespace) -> None:
        """Puts ball and goal elsewhere when their time is over; reaching it does not."""
        self.goals_reached[row] += self.at_goal[row]
        if self._count[row] >= self._ball_due[row]:
            self._put_ball(row, found.root[row, :2])
            self.world.forward(np.array([row]))
        if self._count[row] >= self._due[row]:
            self._draw_goal(row, found.root[row, :2])

    def _write_goal(self, found: SimpleNamespace) -> None:
        target = self.observation[:, self.blocks['target']]
        target[...] = polar((self.goal - self.ball.place)[:, None, :2], found)
        self.ball.write(found, self.observation[:, self.blocks['ball']])

    def infos(self) -> dict[str, Any]:
        """As for high-level tasks; and whether the ball is at the goal, `at_goal`.

        `goals_reached` counts the steps that end so; `speed` is that of the ball towards the goal.
        """
        return {**super().infos(), 'at_goal': self.at_goal.copy()}

    def markers(self, row: int) -> list[Marker]:
        """The plan, the way of the centre of mass, and the goal as a disc on the ground."""
        found = super().markers(row)[:-1]
        disc = Marker('cylinder', self.goal[row], (self._goal_reached, 0.005, 0.0), GOAL_COLOUR)
        return [*found, disc]

    _KEPT = (*HighLevel._KEPT, '_ball_from', '_ball_due', 'at_goal')
