"""A ball to dribble to a goal: body, placement, observation, reward terms.

Source: the soccer scenario of the original; 'DeepLoco' (Peng, Berseth, Yin, van de Panne 2017).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from trl_suite.arenas import SpatialArena
from trl_suite.bodies.blocks import SPIN, VECTOR, Block, Noise, signs
from trl_suite.bodies.body import Measurement, ahead_and_left, polar
from trl_suite.bodies.reference import CONTROL_TIMESTEP
from trl_suite.bodies.spatial import SpatialState
from trl_suite.bodies.state import FLAG, PLACE, WHOLE, allocated
from trl_suite.engine import World
from trl_suite.tasks.common.goals import GOAL, GOAL_AWAY, GOAL_COLOUR
from trl_suite.tasks.rewards import Outcome, Term, give, terms_data
from trl_suite.tasks.task import Marker, random_displacement
from trl_suite.terrain import PRESETS3D
from trl_suite.util.compiled import compiled, compiled_inline

LEVEL = ('plane', 'var3d_flat')  # types of terrain on which a ball is supported
RADIUS, MASS = 0.2, 0.1  # m, kg
FRICTION = (0.45, 0.005, 0.0001)  # sliding: 0.5 * 0.9; the ball's friction has priority
SOLREF = (0.01, 1)  # soft enough for a mass of 0.1 kg
DRAG = 0.5  # ratio of its velocity to that one second earlier, without contact
BALL_AWAY = (0.7, 10.0)  # m; distance from the walker when it is placed
BALL_LASTS = (100.0, 200.0)  # s until it is placed again
AT_GOAL, NEAR = 0.5, 2.0  # m; distances of the ball from goal and walker for full reward
SPEED = 1.0  # m/s; target speed of walker and ball
SPEED_SHARPNESS, BALL_SHARPNESS, GOAL_SHARPNESS = 1.5, 0.5, 0.5
_SPEEDS = f'exp(-{SPEED_SHARPNESS:g} min(0, v - target speed)^2)'


def soccer_terms(share: float = 1.0) -> tuple[Term, ...]:
    """Returns the terms of a reward for dribbling, whose weights sum to `share`."""
    return tuple(
        Term(name, share * weight, meaning)
        for name, weight, meaning in (
            ('approach', 0.2 / 1.2, f'{_SPEEDS}, v: speed of the centre of mass towards the ball, m/s'),
            (
                'near', 0.2 / 1.2,
                f'exp(-{BALL_SHARPNESS:g} d^2), d: horizontal distance of the ball from the centre of mass at '
                'the beginning of the step, m',
            ),
            (
                'dribble', 0.4 / 1.2,
                f'{_SPEEDS}, v: speed of the ball towards the goal, m/s; 0 unless v > 0',
            ),
            (
                'goal', 0.4 / 1.2,
                f"exp(-{GOAL_SHARPNESS:g} d), d: distance from the ball's centre to the goal on the ground, m",
            ),
        )
    )  # fmt: skip


BALL = Block(
    'ball', 9, 'rad, m, m/s, rad/s',
    'bearing, distance and height of the ball; its velocity (3) and its angular velocity (3)',
    Noise((0.01, 0.03, 0.1)), signs((-1.0, 1.0, 1.0, *VECTOR, *SPIN)),
)  # fmt: skip
BALL_GOAL = dataclasses.replace(GOAL, meaning='bearing and distance of the goal from the ball')


class BallState(NamedTuple):
    """State of each ball, (n, ...).

    Attributes:
      due: control step of the episode at which it is placed again.
      begin: its position at the beginning of the step, (n, 3) m.
      walker: position of the walker's centre of mass at that time, (n, 3) m.
      at_goal: whether it is at the goal.
      wanted: whether it must be placed again now.
    """

    due: np.ndarray = WHOLE
    begin: np.ndarray = PLACE
    walker: np.ndarray = PLACE
    at_goal: np.ndarray = FLAG
    wanted: np.ndarray = FLAG


class BallData(NamedTuple):
    """Balls for compiled functions.

    Attributes:
      qpos, dof: first addresses of its position (7) in qpos and velocity (6) in qvel; -1: no ball.
      body: its body id.
      target_speed: speed of walker and ball for full reward, m/s.
      goal_radius: distance of the ball from the goal for full reward, if the walker is near, m.
      terms: the reward terms, of which those of `soccer_terms` are written here.
    """

    qpos: int
    dof: int
    body: int
    target_speed: float
    goal_radius: float
    terms: Any
    state: BallState


def no_ball(n: int) -> BallData:
    """Returns the rules for a task without a ball."""
    return BallData(-1, -1, -1, 0.0, 0.0, terms_data(soccer_terms()), allocated(BallState, n))


# Of simulation i.


@compiled
def remember(i: int, physics: SpatialState, measurement: Measurement, ball: BallData) -> None:
    """Stores the positions of ball and walker at the beginning of a step."""
    for k in range(3):
        ball.state.begin[i, k] = physics.qpos[i, ball.qpos + k]
        ball.state.walker[i, k] = measurement.com[i, k]


@compiled
def dribble(
    i: int, seconds: float, goal: np.ndarray, physics: SpatialState,
    measurement: Measurement, ball: BallData, outcome: Outcome,
) -> float:  # fmt: skip
    """Writes the reward terms of a step, and whether the ball is at its goal.

    Args:
      i: index of the simulation.
      seconds: duration of the step, s.
      goal: positions of the goals, (n, 3) m.
      physics, measurement: state and measurement of all simulations at the end of the step.
      ball: the balls, with positions at the beginning of the step.
      outcome: of which the reward terms are written.

    Returns:
      The ball's speed towards the goal, m/s.
    """
    walker, begin = ball.state.walker, ball.state.begin
    x, y = physics.qpos[i, ball.qpos], physics.qpos[i, ball.qpos + 1]
    z = physics.qpos[i, ball.qpos + 2]
    gap_x, gap_y = x - walker[i, 0], y - walker[i, 1]
    towards_ball = _speed_along(
        measurement.com[i, 0] - walker[i, 0],
        measurement.com[i, 1] - walker[i, 1],
        gap_x,
        gap_y,
        seconds,
    )
    towards_goal = _speed_along(
        x - begin[i, 0], y - begin[i, 1], goal[i, 0] - begin[i, 0], goal[i, 1] - begin[i, 1],
        seconds,
    )  # fmt: skip
    gap = gap_x * gap_x + gap_y * gap_y
    left_x, left_y, left_z = goal[i, 0] - x, goal[i, 1] - y, goal[i, 2] - z
    left = math.sqrt(left_x * left_x + left_y * left_y + left_z * left_z)
    arrived = left < ball.goal_radius
    ball.state.at_goal[i] = arrived
    if arrived and gap < NEAR * NEAR:
        approach = near = dribbling = at_goal = 1.0
    else:
        lack = min(towards_ball - ball.target_speed, 0.0)
        approach = math.exp(-SPEED_SHARPNESS * (lack * lack))
        near = math.exp(-BALL_SHARPNESS * gap)
        lack = min(towards_goal - ball.target_speed, 0.0)
        dribbling = math.exp(-SPEED_SHARPNESS * (lack * lack)) if towards_goal > 0.0 else 0.0
        at_goal = math.exp(-GOAL_SHARPNESS * left)
    terms = ball.terms
    give(i, approach, terms.approach, outcome)
    give(i, near, terms.near, outcome)
    give(i, dribbling, terms.dribble, outcome)
    give(i, at_goal, terms.goal, outcome)
    return towards_goal


@compiled_inline
def _speed_along(
    moved_x: float, moved_y: float, way_x: float, way_y: float, seconds: float
) -> float:
    """Returns the mean speed of a displacement along a horizontal direction, m/s."""
    length = max(math.sqrt(way_x * way_x + way_y * way_y), 1e-9)
    return (moved_x * way_x + moved_y * way_y) / length / seconds


@compiled
def observe_ball(
    i: int, columns: Any, goal: np.ndarray, physics: SpatialState, measurement: Measurement,
    ball: BallData, observation: np.ndarray,
) -> None:  # fmt: skip
    """Writes the blocks `BALL_GOAL` and `BALL`, in the heading frame of the walker.

    Bearings are positive to the left; `goal` (n, 3) m are the positions of the goals.
    """
    column = columns.goal
    x, y = physics.qpos[i, ball.qpos], physics.qpos[i, ball.qpos + 1]
    bearing, distance = polar(i, goal[i, 0] - x, goal[i, 1] - y, measurement)
    observation[i, column], observation[i, column + 1] = bearing, distance
    bearing, distance = polar(
        i, x - measurement.root[i, 0], y - measurement.root[i, 1], measurement
    )
    column = columns.ball
    observation[i, column], observation[i, column + 1] = bearing, distance
    observation[i, column + 2] = physics.qpos[i, ball.qpos + 2]
    ahead, left = ahead_and_left(
        i, physics.qvel[i, ball.dof], physics.qvel[i, ball.dof + 1], measurement
    )
    observation[i, column + 3], observation[i, column + 4] = ahead, left
    observation[i, column + 5] = physics.qvel[i, ball.dof + 2]
    spin = physics.cvel[i, ball.body]
    ahead, left = ahead_and_left(i, spin[0], spin[1], measurement)
    observation[i, column + 6], observation[i, column + 7] = ahead, left
    observation[i, column + 8] = spin[2]


class Ball:
    """One ball in every simulation of a world.

    Attributes:
      qpos, dof: its addresses in qpos (7) and in qvel (6).
    """

    def __init__(self, arena: SpatialArena) -> None:
        """Adds it to an arena; `bind` resolves its ids in the compiled world.

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
            # Like the ground: all that collides with the ground collides with the ball, too.
            friction=FRICTION, priority=1, solref=SOLREF, contype=1, conaffinity=1,
        )  # fmt: skip

    def bind(self, world: World) -> None:
        self.world = world
        (qpos,), (dof,) = world.joint_addresses(['ball'])
        self.qpos, self.dof = qpos + np.arange(7), dof + np.arange(6)
        (self._body,) = world.body_ids(['ball'])
        inertia = 0.4 * MASS * RADIUS**2
        rate = -np.log(DRAG)
        for env_id, model in enumerate(world.models):
            model.dof_damping[self.dof] = np.repeat([MASS * rate, inertia * rate], 3)
            world.set_const(env_id)

        self.state = allocated(BallState, world.n)

    def rules(self, target_speed: float, goal_radius: float, terms: Iterable[Term]) -> BallData:
        """Returns the balls for compiled functions; see `BallData`."""
        qpos, dof = int(self.qpos[0]), int(self.dof[0])
        return BallData(
            qpos, dof, int(self._body), target_speed, goal_radius, terms_data(terms), self.state
        )

    @property
    def place(self) -> np.ndarray:
        """Positions of the balls, (n, 3) m; a copy."""
        return self.world.qpos[:, self.qpos[:3]]

    def put(self, env_id: int, place: np.ndarray, count: int, random: np.random.Generator) -> None:
        """Places one ball, at rest, at a random displacement from a position on level ground.

        Args:
          env_id: index of the simulation.
          place: the position, (2,) m.
          count: current control step of the episode.
          random: generator of the displacement and of the time until the ball is placed again.
        """
        x, y = place + random_displacement(random, *BALL_AWAY)
        self.world.qpos[env_id, self.qpos] = x, y, RADIUS, 1, 0, 0, 0
        self.world.qvel[env_id, self.dof] = 0.0
        lasts = random.uniform(*BALL_LASTS)
        self.state.due[env_id] = count + round(lasts / CONTROL_TIMESTEP)

    def goal(
        self, env_id: int, random: np.random.Generator, away: tuple[float, float] = GOAL_AWAY
    ) -> np.ndarray:
        """Draws a goal (3,) m at a distance from one ball between two bounds, m."""
        return np.append(
            self.world.qpos[env_id, self.qpos[:2]] + random_displacement(random, *away), 0.0
        )


def goal_disc(goal: np.ndarray, radius: float) -> Marker:
    """Returns the marker of a ball's goal (3,) m."""
    return Marker('cylinder', goal, (radius, 0.005, 0.0), GOAL_COLOUR)
