"""Dribbling a ball to a goal, by planning footsteps.

Source: the soccer scenario of the original; 'DeepLoco' (Peng, Berseth, Yin, van de Panne 2017).
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from trl_suite.arenas import SpatialTerrain
from trl_suite.tasks.figure3d import turn
from trl_suite.tasks.footsteps import GOAL_COLOUR
from trl_suite.tasks.high_level import GOAL_LASTS, HighLevel, polar
from trl_suite.tasks.task import Marker
from trl_suite.tasks.tracking3d import CONTROL_TIMESTEP
from trl_suite.world import World

RADIUS, MASS = 0.2, 0.1  # m, kg
FRICTION = (0.45, 0.005, 0.0001)  # 0.5 * 0.9, wherever it lies
SOLREF = (0.01, 1)  # soft enough for a tenth of a kilogram
DRAG = 0.5  # share of its velocity that is left after a second
BALL_AWAY = (0.7, 10.0)  # m from the walker, where it is put
BALL_LASTS = (100.0, 200.0)  # s until it is put elsewhere
GOAL_AWAY = 10.0  # m from the ball, at most
AT_GOAL, NEAR = 0.5, 2.0  # m; ball from goal and from walker, for full reward
SPEED = 1.0  # m/s, of walker and ball
SPEED_SHARPNESS, BALL_SHARPNESS, GOAL_SHARPNESS = 1.5, 0.5, 0.5
# Walker towards the ball, walker near it, ball towards the goal, ball near it.
SOCCER_TERMS = {
    'approach': (0.2 / 1.2, SPEED_SHARPNESS), 'near': (0.2 / 1.2, BALL_SHARPNESS),
    'dribble': (0.4 / 1.2, SPEED_SHARPNESS), 'goal': (0.4 / 1.2, GOAL_SHARPNESS),
}  # fmt: skip


class Soccer(HighLevel):
    """A spatial biped dribbles a ball to a goal; an action is a plan of two footsteps.

    Observation blocks, in this order (heading frame): pose, velocity as in `SpatialImitation`;
      target: bearing and distance of the goal as seen from the ball, rad and m.
      ball: bearing, distance and height of the ball (rad, m, m), its velocity (3), m/s, and its
        angular velocity (3), rad/s.
      low_level: with interface 'frame' only.
    """

    TERMS = SOCCER_TERMS

    def _furnish(self, arena: SpatialTerrain) -> None:
        body = arena.mjcf_model.worldbody.add('body', name='ball', pos=(0, 0, RADIUS))
        body.add('freejoint', name='ball')
        arena.mjcf_model.asset.add(
            'texture', name='ball', type='cube', builtin='checker', width=64, height=64,
            rgb1=(0.95, 0.95, 0.95), rgb2=(0.15, 0.15, 0.15),
        )  # fmt: skip
        arena.mjcf_model.asset.add('material', name='ball', texture='ball')
        body.add(
            'geom', name='ball', type='sphere', size=(RADIUS,), mass=MASS, material='ball', condim=3,
            friction=FRICTION, priority=1, solref=SOLREF, contype=0, conaffinity=7,
        )  # fmt: skip

    def _goal_blocks(self) -> dict[str, int]:
        return {'target': 2, 'ball': 9}

    def bind(self, world: World) -> None:
        super().bind(world)
        n = world.n
        (qpos,), (dof,) = world.joint_addresses(['ball'])
        self._ball_qpos = qpos + np.arange(7)
        self._ball_dof = dof + np.arange(6)
        (self._ball,) = world.body_ids(['ball'])
        inertia = 0.4 * MASS * RADIUS**2
        rate = -np.log(DRAG)
        for row, model in enumerate(world.models):
            model.dof_damping[self._ball_dof] = np.repeat([MASS * rate, inertia * rate], 3)
            world.set_const(row)
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
        random = self._random[row]
        x, y = place + _around(random, *BALL_AWAY)
        self.world.qpos[row, self._ball_qpos] = x, y, RADIUS, 1, 0, 0, 0
        self.world.qvel[row, self._ball_dof] = 0.0
        self._ball_due[row] = self._count[row] + round(
            random.uniform(*BALL_LASTS) / CONTROL_TIMESTEP
        )

    def _draw_goal(self, row: int, place: np.ndarray) -> None:
        random = self._random[row]
        ball = self.world.qpos[row, self._ball_qpos[:2]]
        self.goal[row] = *(ball + _around(random, 0.0, GOAL_AWAY)), 0.0
        lasts = random.uniform(*GOAL_LASTS)
        self._due[row] = self._count[row] + round(lasts / CONTROL_TIMESTEP)

    def simulate(self, rows: np.ndarray | None = None) -> None:
        self._ball_from[...] = self.world.qpos[:, self._ball_qpos[:3]]
        super().simulate(rows)

    def _reward_terms(self, rows: np.ndarray, found: SimpleNamespace) -> None:
        seconds = CONTROL_TIMESTEP * np.maximum(self._lasted[rows], 1)[:, None]
        before, after = self._ball_from[rows], self.world.qpos[rows][:, self._ball_qpos[:3]]
        walker, goal = self._from[rows], self.goal[rows]
        towards_ball = speed_along(found.com[rows] - walker, after - walker, seconds)
        towards_goal = speed_along(after - before, goal - before, seconds)
        self._speed[rows] = towards_goal
        gap = ((after - walker)[:, :2] ** 2).sum(1)
        left = np.sqrt(((goal - after) ** 2).sum(1))
        self.at_goal[rows] = left < AT_GOAL
        terms = np.stack(
            [
                np.exp(-SPEED_SHARPNESS * np.minimum(towards_ball - SPEED, 0) ** 2),
                np.exp(-BALL_SHARPNESS * gap),
                (towards_goal > 0)
                * np.exp(-SPEED_SHARPNESS * np.minimum(towards_goal - SPEED, 0) ** 2),
                np.exp(-GOAL_SHARPNESS * left),
            ],
            axis=1,
        )
        terms[self.at_goal[rows] & (gap < NEAR**2)] = 1.0
        self.reward_terms[rows] = terms * [weight for weight, _ in self.TERMS.values()]

    def _look_at_goal(self, row: int, found: SimpleNamespace) -> None:
        """Puts ball and goal elsewhere when their time is over; reaching it does not."""
        self.goals_reached[row] += self.at_goal[row]
        if self._count[row] >= self._ball_due[row]:
            self._put_ball(row, found.root[row, :2])
            self.world.forward(np.array([row]))
        if self._count[row] >= self._due[row]:
            self._draw_goal(row, found.root[row, :2])

    def _write_goal(self, found: SimpleNamespace) -> None:
        place = self.world.qpos[:, self._ball_qpos[:3]]
        target = self.observation[:, self.blocks['target']]
        target[...] = polar((self.goal - place)[:, None, :2], found)
        ball = self.observation[:, self.blocks['ball']]
        ball[:, :2] = polar((place - found.root)[:, None, :2], found)
        ball[:, 2] = place[:, 2]
        rates = np.stack(
            [self.world.qvel[:, self._ball_dof[:3]], self.world.cvel[:, self._ball, :3]], axis=1
        )
        ball[:, 3:] = turn(rates, found.cosine, found.sine).reshape(len(ball), 6)

    def infos(self) -> dict[str, Any]:
        """As for high-level tasks; and whether the ball is within 0.5 m of the goal, `at_goal`.

        `goals_reached` counts the steps that end so; `speed` is that of the ball towards the goal.
        """
        return {**super().infos(), 'at_goal': self.at_goal.copy()}

    def markers(self, row: int) -> list[Marker]:
        """The plan, and the goal as a disc on the ground."""
        found = super().markers(row)[:-1]
        disc = Marker('cylinder', self.goal[row], (AT_GOAL, 0.005, 0.0), GOAL_COLOUR)
        return [*found, disc]

    _KEPT = (*HighLevel._KEPT, '_ball_from', '_ball_due', 'at_goal')


def speed_along(moved: np.ndarray, way: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """Returns the speed of ways gone (m, 2 or 3) along other ways, on the ground, (m,) m/s."""
    length = np.maximum(np.sqrt((way[:, :2] ** 2).sum(1)), 1e-9)
    return (moved[:, :2] * way[:, :2]).sum(1) / length / seconds[:, 0]


def _around(random: np.random.Generator, low: float, high: float) -> np.ndarray:
    """Returns a way in any direction, of any length from low to high, m."""
    angle = random.uniform(-np.pi, np.pi)
    return random.uniform(low, high) * np.array([np.cos(angle), np.sin(angle)])
