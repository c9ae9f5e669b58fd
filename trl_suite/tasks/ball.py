"""A ball to dribble to a goal: the body, where it is put, what is seen of it, what it is worth.

Source: the soccer scenario of the original; 'DeepLoco' (Peng, Berseth, Yin, van de Panne 2017).
"""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from trl_suite.arenas import SpatialTerrain
from trl_suite.engine import World
from trl_suite.tasks.figure3d import polar, turn
from trl_suite.tasks.task import drawn_way
from trl_suite.terrain import PRESETS3D

LEVEL = ('plane', 'var3d_flat')  # types of ground on which a ball may lie
RADIUS, MASS = 0.2, 0.1  # m, kg
FRICTION = (0.45, 0.005, 0.0001)  # 0.5 * 0.9, wherever it lies
SOLREF = (0.01, 1)  # soft enough for a tenth of a kilogram
DRAG = 0.5  # share of its velocity that is left after a second
BALL_AWAY = (0.7, 10.0)  # m from the walker, where it is put
BALL_LASTS = (100.0, 200.0)  # s until it is put elsewhere
GOAL_AWAY = (0.0, 10.0)  # m from the ball
AT_GOAL, NEAR = 0.5, 2.0  # m; ball from goal and from walker, for full reward
SPEED = 1.0  # m/s, of walker and ball
SPEED_SHARPNESS, BALL_SHARPNESS, GOAL_SHARPNESS = 1.5, 0.5, 0.5
# Walker towards the ball, walker near it, ball towards the goal, ball near it.
SOCCER_TERMS = {
    'approach': (0.2 / 1.2, SPEED_SHARPNESS), 'near': (0.2 / 1.2, BALL_SHARPNESS),
    'dribble': (0.4 / 1.2, SPEED_SHARPNESS), 'goal': (0.4 / 1.2, GOAL_SHARPNESS),
}  # fmt: skip
MIRRORED = (-1.0, 1.0, 1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0)  # signs of what is seen, in a mirror
_WEIGHTS = np.array([weight for weight, _ in SOCCER_TERMS.values()])


class Ball:
    """One ball in every simulation of a world.

    Attributes:
      qpos, dof: its columns of positions (7) and of velocities (6).
    """

    def __init__(self, arena: SpatialTerrain) -> None:
        """Adds it to an arena; `bind` ties it to the compiled world.

        Raises:
          ValueError: the ground of the arena is not level.
        """
        ground = arena.terrain
        if ground.type not in LEVEL:
            level = ', '.join(name for name, each in PRESETS3D.items() if each.type in LEVEL)
            raise ValueError(
                f'a ball needs level ground, and terrain {ground.name!r} ({ground.type}) is not; '
                f'presets that are: {level}'
            )
        root = arena.mjcf_model
        body = root.worldbody.add('body', name='ball', pos=(0, 0, RADIUS))
        body.add('freejoint', name='ball')
        root.asset.add(
            'texture', name='ball', type='cube', builtin='checker', width=64, height=64,
            rgb1=(0.95, 0.95, 0.95), rgb2=(0.15, 0.15, 0.15),
        )  # fmt: skip
        root.asset.add('material', name='ball', texture='ball')
        body.add(
            'geom', name='ball', type='sphere', size=(RADIUS,), mass=MASS, material='ball', condim=3,
            friction=FRICTION, priority=1, solref=SOLREF, contype=0, conaffinity=7,
        )  # fmt: skip

    def bind(self, world: World) -> None:
        self.world = world
        (qpos,), (dof,) = world.joint_addresses(['ball'])
        self.qpos, self.dof = qpos + np.arange(7), dof + np.arange(6)
        (self._body,) = world.body_ids(['ball'])
        inertia = 0.4 * MASS * RADIUS**2
        rate = -np.log(DRAG)
        for row, model in enumerate(world.models):
            model.dof_damping[self.dof] = np.repeat([MASS * rate, inertia * rate], 3)
            world.set_const(row)

    @property
    def place(self) -> np.ndarray:
        """Where the balls are, (n, 3) m; a copy."""
        return self.world.qpos[:, self.qpos[:3]]

    def put(self, row: int, place: np.ndarray, random: np.random.Generator) -> float:
        """Puts one ball, at rest, about a place (x, y) on level ground; returns for how long, s."""
        x, y = place + drawn_way(random, *BALL_AWAY)
        self.world.qpos[row, self.qpos] = x, y, RADIUS, 1, 0, 0, 0
        self.world.qvel[row, self.dof] = 0.0
        return random.uniform(*BALL_LASTS)

    def goal(
        self, row: int, random: np.random.Generator, away: tuple[float, float] = GOAL_AWAY
    ) -> np.ndarray:
        """Draws a goal about one ball, between two distances (m) from it, (3,) m."""
        return np.append(self.world.qpos[row, self.qpos[:2]] + drawn_way(random, *away), 0.0)

    def write(self, found: SimpleNamespace, out: np.ndarray) -> None:
        """Writes what is seen of the balls, (n, 9), in the heading frame.

        Bearing, distance and height, rad, m and m; velocity, m/s; angular velocity, rad/s.
        """
        place = self.place
        out[:, :2] = polar((place - found.root)[:, None, :2], found)
        out[:, 2] = place[:, 2]
        rates = np.stack(
            [self.world.qvel[:, self.dof[:3]], self.world.cvel[:, self._body, :3]], axis=1
        )
        out[:, 3:] = turn(rates, found.cosine, found.sine).reshape(len(out), 6)


def terms(
    walker: np.ndarray, moved: np.ndarray, before: np.ndarray, after: np.ndarray, goal: np.ndarray,
    seconds: np.ndarray | float, speed: float = SPEED, at_goal: float = AT_GOAL,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Returns what a step was worth.

    Args:
      walker: centre of mass at the beginning of the step, (m, 3) m.
      moved: by how much it moved, (m, 3) m.
      before, after: places of the ball at the beginning and at the end, (m, 3) m.
      goal: its goal, (m, 3) m.
      seconds: duration, (m,).
      speed: m/s of walker and ball from which on the reward is full.
      at_goal: m; nearer to the goal, with the walker near, the reward is full.

    Returns:
      The terms of `SOCCER_TERMS`, weighted, (m, 4); the ball's speed towards the goal, (m,) m/s;
      and whether it is there, (m,) bool.
    """
    towards_ball = _speed_along(moved, after - walker, seconds)
    towards_goal = _speed_along(after - before, goal - before, seconds)
    gap = ((after - walker)[:, :2] ** 2).sum(1)
    left = np.sqrt(((goal - after) ** 2).sum(1))
    arrived = left < at_goal
    result = np.stack(
        [
            np.exp(-SPEED_SHARPNESS * np.minimum(towards_ball - speed, 0) ** 2),
            np.exp(-BALL_SHARPNESS * gap),
            (towards_goal > 0)
            * np.exp(-SPEED_SHARPNESS * np.minimum(towards_goal - speed, 0) ** 2),
            np.exp(-GOAL_SHARPNESS * left),
        ],
        axis=1,
    )
    result[arrived & (gap < NEAR**2)] = 1.0
    return result * _WEIGHTS, towards_goal, arrived


def _speed_along(moved: np.ndarray, way: np.ndarray, seconds: np.ndarray | float) -> np.ndarray:
    """Returns the speed of ways gone (m, 3) along other ways, on the ground, (m,) m/s."""
    length = np.maximum(np.sqrt((way[:, :2] ** 2).sum(1)), 1e-9)
    return (moved[:, :2] * way[:, :2]).sum(1) / length / seconds
