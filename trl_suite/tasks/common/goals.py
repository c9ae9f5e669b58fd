"""Goals on the ground to walk to, or to dribble a ball to, one after the other.

A goal is redrawn when its time has expired, and that of a walker also when it is reached. Source of the
ball: the soccer scenario of the original; 'DeepLoco' (Peng, Berseth, Yin, van de Panne 2017).
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, NamedTuple

import numpy as np

from trl_suite.arenas import SpatialArena
from trl_suite.bodies.blocks import Block, Noise, signs
from trl_suite.bodies.body import Measurement, ahead_and_left, polar
from trl_suite.bodies.reference import CONTROL_TIMESTEP
from trl_suite.bodies.spatial import SpatialState
from trl_suite.bodies.state import FLAG, PLACE, REAL, WHOLE, allocated
from trl_suite.engine import World
from trl_suite.motion.layout import SPIN, VECTOR
from trl_suite.tasks.body_task import BodyTask
from trl_suite.tasks.rewards import Outcome, Term, give, terms_data
from trl_suite.tasks.task import Marker, random_displacement
from trl_suite.terrain import PRESETS3D
from trl_suite.util.compiled import compiled, compiled_inline

GOAL_LASTS = (50.0, 100.0)  # s until a goal that was not reached is redrawn
GOAL_AWAY = (0.0, 10.0)  # m; distance of a new goal from the ball
GOAL_COLOUR = (0.85, 0.15, 0.2, 0.8)
TRACE_EVERY = 5  # control steps between two stored positions
TRACE_PLACES = 60  # stored positions: 10 s
TRACE_RADIUS = 0.025  # of the markers, m
TRACE_COLOUR = (0.98, 0.75, 0.1, 0.9)
FLAG_SIZE = (0.1, 0.6, 0.0)  # m; marker of the goal: radius and half height of a cylinder
LEVEL = ('plane', 'var3d_flat')  # types of terrain on which a ball is supported
BALL_RADIUS, BALL_MASS = 0.2, 0.1  # m, kg
FRICTION = (0.45, 0.005, 0.0001)  # sliding: 0.5 * 0.9; the ball's friction has priority
SOLREF = (0.01, 1)  # soft enough for a mass of 0.1 kg
DRAG = 0.5  # ratio of its velocity to that one second earlier, without contact
BALL_AWAY = (0.7, 10.0)  # m; distance from the walker when it is placed
BALL_LASTS = (100.0, 200.0)  # s until it is placed again
AT_GOAL, NEAR_BALL = 0.5, 2.0  # m; distances of the ball from goal and walker for full reward
SPEED = 1.0  # m/s; target speed of walker and ball
SPEED_SHARPNESS, BALL_SHARPNESS, GOAL_SHARPNESS = 1.5, 0.5, 0.5
SPEED_REWARD = f'exp(-{SPEED_SHARPNESS:g} min(0, v - target speed)^2)'


def soccer_terms(share: float = 1.0) -> tuple[Term, ...]:
    """Returns the terms of a reward for dribbling, whose weights sum to `share`."""
    return tuple(
        Term(name, share * weight, meaning)
        for name, weight, meaning in (
            (
                'approach', 0.2 / 1.2,
                f'{SPEED_REWARD}, v: speed of the centre of mass towards the place of the ball at the end of the step, m/s',
            ),
            (
                'near', 0.2 / 1.2,
                f'exp(-{BALL_SHARPNESS:g} d^2), d: horizontal distance of the ball at the end of the step from the '
                'centre of mass at its beginning, m',
            ),
            (
                'dribble', 0.4 / 1.2,
                f'{SPEED_REWARD}, v: speed of the ball towards the goal, m/s; 0 unless v > 0',
            ),
            (
                'goal', 0.4 / 1.2,
                f"exp(-{GOAL_SHARPNESS:g} d), d: distance from the ball's centre to the goal on the ground, m",
            ),
        )
    )  # fmt: skip


class Goals(NamedTuple):
    """The goal of each simulation, and the way to it.

    Attributes:
      place: position, (n, 3) m.
      due: control step of the episode at which it is redrawn, (n,).
      reached: number of goals reached in the episode; with a ball, of steps that ended with it at its
        goal, (n,).
      wanted: whether it must be redrawn now, (n,).
      walker: position of the walker's centre of mass at the beginning of the step, (n, 3) m.
      speed: speed of walker or ball towards the goal, in the last step, (n,) m/s.
      trace: last positions of the centre of mass, for rendering, a ring buffer, (n, TRACE_PLACES, 3)
        m; NaN where no position has been stored yet.
    """

    trace: np.ndarray
    place: np.ndarray = PLACE
    due: np.ndarray = WHOLE
    reached: np.ndarray = WHOLE
    wanted: np.ndarray = FLAG
    walker: np.ndarray = PLACE
    speed: np.ndarray = REAL


GOAL = Block(
    'goal',
    2,
    'rad, m',
    'bearing (positive to the left) and distance of the goal',
    Noise((0.01, 0.03, 0.1)),
    signs((-1.0, 1.0)),
)


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
      at_goal: whether it is at the goal.
      wanted: whether it must be placed again now.
    """

    due: np.ndarray = WHOLE
    begin: np.ndarray = PLACE
    at_goal: np.ndarray = FLAG
    wanted: np.ndarray = FLAG


class GoalData(NamedTuple):
    """Goals, and the balls if there are any, for compiled functions.

    Attributes:
      near: distance of walker or ball from the goal at which it is reached, m.
      target_speed: speed of walker and ball for full reward, m/s.
      with_ball: whether the goal is that of a ball.
      qpos, dof: first addresses of the ball's position (7) in qpos and velocity (6) in qvel; -1: none.
      body: its body id.
      terms: the reward terms, of which `dribble` writes those of `soccer_terms`; unused without a ball.
    """

    goals: Goals
    near: float
    target_speed: float
    with_ball: bool
    qpos: int
    dof: int
    body: int
    terms: Any
    ball: BallState


# Of simulation i.


@compiled
def observe_place(
    i: int, column: int, x: float, y: float, measurement: Measurement, observation: np.ndarray
) -> None:
    """Writes bearing and distance of a displacement x, y m in world axes."""
    bearing, distance = polar(i, x, y, measurement)
    observation[i, column], observation[i, column + 1] = bearing, distance


@compiled
def store_trace(i: int, count: int, measurement: Measurement, goals: Goals) -> None:
    """Stores the position of a walker after `count` control steps."""
    if count % TRACE_EVERY == 0:
        for k in range(3):
            goals.trace[i, count // TRACE_EVERY % TRACE_PLACES, k] = measurement.com[i, k]


@compiled
def store_start(i: int, physics: SpatialState, measurement: Measurement, data: GoalData) -> None:
    """Stores the positions of walker and ball at the beginning of a step."""
    for k in range(3):
        data.goals.walker[i, k] = measurement.com[i, k]
        if data.with_ball:
            data.ball.begin[i, k] = physics.qpos[i, data.qpos + k]


@compiled
def dribble(
    i: int,
    seconds: float,
    physics: SpatialState,
    measurement: Measurement,
    data: GoalData,
    outcome: Outcome,
) -> float:
    """Writes the reward terms of a step, and whether the ball is at its goal.

    Args:
      i: index of the simulation.
      seconds: duration of the step, s.
      physics, measurement: state and measurement of all simulations at the end of the step.
      data: goals and balls, with positions at the beginning of the step.
      outcome: of which the reward terms are written.

    Returns:
      The ball's speed towards the goal, m/s.
    """
    ball, goal, terms = data.ball, data.goals.place, data.terms
    walker, begin = data.goals.walker, ball.begin
    x, y = physics.qpos[i, data.qpos], physics.qpos[i, data.qpos + 1]
    z = physics.qpos[i, data.qpos + 2]
    # As in the original: from the walker at the beginning of the step to the ball at its end.
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
    arrived = left < data.near
    ball.at_goal[i] = arrived
    if arrived and gap < NEAR_BALL * NEAR_BALL:
        approach = near = dribbling = at_goal = 1.0
    else:
        approach = speed_reward(towards_ball, data.target_speed)
        near = math.exp(-BALL_SHARPNESS * gap)
        dribbling = speed_reward(towards_goal, data.target_speed) if towards_goal > 0.0 else 0.0
        at_goal = math.exp(-GOAL_SHARPNESS * left)
    give(i, approach, terms.approach, outcome)
    give(i, near, terms.near, outcome)
    give(i, dribbling, terms.dribble, outcome)
    give(i, at_goal, terms.goal, outcome)
    return towards_goal


@compiled_inline
def speed_reward(speed: float, target: float) -> float:
    """Returns `SPEED_REWARD`."""
    lack = min(speed - target, 0.0)
    return math.exp(-SPEED_SHARPNESS * (lack * lack))


@compiled_inline
def _speed_along(
    moved_x: float, moved_y: float, way_x: float, way_y: float, seconds: float
) -> float:
    """Returns the mean speed of a displacement along a horizontal direction, m/s."""
    length = max(math.sqrt(way_x * way_x + way_y * way_y), 1e-9)
    return (moved_x * way_x + moved_y * way_y) / length / seconds


@compiled
def test_goal(i: int, count: int, measurement: Measurement, data: GoalData) -> bool:
    """Tests goal and ball after `count` control steps; returns whether one must be redrawn."""
    goals, ball = data.goals, data.ball
    late = count >= goals.due[i]
    if data.with_ball:  # a ball's goal is not redrawn when it is reached
        reached = ball.at_goal[i]
        ball.wanted[i], goals.wanted[i] = count >= ball.due[i], late
    else:
        x = goals.place[i, 0] - measurement.root[i, 0]
        y = goals.place[i, 1] - measurement.root[i, 1]
        reached = math.hypot(x, y) < data.near
        goals.wanted[i] = reached or late
    goals.reached[i] += reached
    return goals.wanted[i] or ball.wanted[i]


@compiled
def observe_goal(
    i: int,
    columns: Any,
    physics: SpatialState,
    measurement: Measurement,
    data: GoalData,
    observation: np.ndarray,
) -> None:
    """Writes the blocks `GOAL`, or `BALL_GOAL` and `BALL`; bearings are positive to the left."""
    goal, column = data.goals.place, columns.goal
    if not data.with_ball:
        x, y = goal[i, 0] - measurement.root[i, 0], goal[i, 1] - measurement.root[i, 1]
        observe_place(i, column, x, y, measurement, observation)
        return
    x, y = physics.qpos[i, data.qpos], physics.qpos[i, data.qpos + 1]
    observe_place(i, column, goal[i, 0] - x, goal[i, 1] - y, measurement, observation)
    x, y, column = x - measurement.root[i, 0], y - measurement.root[i, 1], columns.ball
    observe_place(i, column, x, y, measurement, observation)
    observation[i, column + 2] = physics.qpos[i, data.qpos + 2]
    ahead, left = ahead_and_left(
        i, physics.qvel[i, data.dof], physics.qvel[i, data.dof + 1], measurement
    )
    observation[i, column + 3], observation[i, column + 4] = ahead, left
    observation[i, column + 5] = physics.qvel[i, data.dof + 2]
    spin = physics.cvel[i, data.body]
    ahead, left = ahead_and_left(i, spin[0], spin[1], measurement)
    observation[i, column + 6], observation[i, column + 7] = ahead, left
    observation[i, column + 8] = spin[2]


def flag(goal: Any) -> Marker:
    """Returns the marker of a goal (3,), m."""
    return Marker('cylinder', np.add(goal, (0, 0, FLAG_SIZE[1])), FLAG_SIZE, GOAL_COLOUR)


class Ball:
    """One ball in every simulation of a world.

    Attributes:
      qpos, dof: its addresses in qpos (7) and in qvel (6).
      body: its body id.
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
        body = root.worldbody.add('body', name='ball', pos=(0, 0, BALL_RADIUS))
        body.add('freejoint', name='ball')
        root.asset.add(
            'texture', name='ball', type='cube', builtin='checker', width=64, height=64,
            rgb1=(0.95, 0.95, 0.95), rgb2=(0.15, 0.15, 0.15),
        )  # fmt: skip
        root.asset.add('material', name='ball', texture='ball')
        body.add(
            'geom', name='ball', type='sphere', size=(BALL_RADIUS,), mass=BALL_MASS, material='ball', condim=3,
            # Like the ground: all that collides with the ground collides with the ball, too.
            friction=FRICTION, priority=1, solref=SOLREF, contype=1, conaffinity=1,
        )  # fmt: skip

    def bind(self, world: World, state: BallState) -> None:
        self.world, self.state = world, state
        (qpos,), (dof,) = world.joint_addresses(['ball'])
        self.qpos, self.dof = qpos + np.arange(7), dof + np.arange(6)
        (self.body,) = world.body_ids(['ball'])
        inertia = 0.4 * BALL_MASS * BALL_RADIUS**2
        rate = -np.log(DRAG)
        for env_id, model in enumerate(world.models):
            model.dof_damping[self.dof] = np.repeat([BALL_MASS * rate, inertia * rate], 3)
            world.set_const(env_id)

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
        self.world.qpos[env_id, self.qpos] = x, y, BALL_RADIUS, 1, 0, 0, 0
        self.world.qvel[env_id, self.dof] = 0.0
        lasts = random.uniform(*BALL_LASTS)
        self.state.due[env_id] = count + round(lasts / CONTROL_TIMESTEP)


class GoalTask(BodyTask):
    """A walker that goes from goal to goal, or dribbles a ball to them.

    Attributes:
      ball: the ball; None: the goals are those of the walker.
      goals: the goal of each simulation.
      goal_reached: distance within which a goal is reached, m.
    """

    RULE = 'near'  # where goals of a walker are, see `SpatialGround.goal`
    goal_distance: tuple[float, float] | None = None  # m; from walker or ball, in any direction
    goal_reached: float
    ball: Ball | None = None

    @property
    def goal(self) -> np.ndarray:
        """Goal of the walker, or of the ball, (n, 3) m."""
        return self.goals.place

    def _bind_goals(self, world: World, target_speed: float) -> GoalData:
        """Allocates goals, and binds the ball.

        Raises:
          ValueError: the centre of the ball is always farther from a goal, which is on the ground.
        """
        if self.ball and self.goal_reached <= BALL_RADIUS:
            raise ValueError(
                f'goal_reached is {self.goal_reached:g}; expected more than the radius of the ball, '
                f'{BALL_RADIUS:g} m'
            )
        n, ball, terms = world.n, self.ball, soccer_terms()
        self.goals = allocated(Goals, n, trace=np.zeros((TRACE_PLACES, 3)))
        self.saved = (*self.saved, self.goals)
        self.info_arrays |= {'goals_reached': self.goals.reached, 'speed': self.goals.speed}
        qpos = dof = body = -1
        state = allocated(BallState, n)
        if ball:
            ball.bind(world, state)
            self.saved = (*self.saved, state)
            self.info_arrays['at_goal'] = state.at_goal
            qpos, dof, body, terms = int(ball.qpos[0]), int(ball.dof[0]), int(ball.body), self.terms
        return GoalData(
            goals=self.goals,
            near=self.goal_reached,
            target_speed=target_speed,
            with_ball=ball is not None,
            qpos=qpos,
            dof=dof,
            body=body,
            terms=terms_data(terms),
            ball=state,
        )

    def _begin_goals(self, env_ids: np.ndarray) -> None:
        """Draws the first goals of episodes, and places the balls."""
        self.goals.reached[env_ids] = self.goals.speed[env_ids] = 0
        self.goals.trace[env_ids] = np.nan
        for i in env_ids.tolist():
            self.begin_goal(i)
        if self.ball:
            self.ball.state.at_goal[env_ids] = False
            self.world.forward(env_ids)

    def begin_goal(self, i: int) -> None:
        """Draws the first goal of an episode, and places the ball."""
        place = self.travel.origin[i, :2]
        if self.ball:
            self.ball.put(i, place, self.clock.steps[i], self._random[i])
        self._draw_goal(i, place)

    def _redraw_goals(self, env_ids: np.ndarray) -> None:
        """Places balls and draws goals again, where they have expired or were reached."""
        places = self.body.measurement.root[:, :2]
        if self.ball:
            wanted = env_ids[self.ball.state.wanted[env_ids]]
            for i in wanted.tolist():
                self.ball.put(i, places[i], self.clock.steps[i], self._random[i])
            self.world.forward(wanted)
        for i in env_ids[self.goals.wanted[env_ids]].tolist():
            self._draw_goal(i, places[i])

    def _draw_goal(self, i: int, place: np.ndarray) -> None:
        random, distance = self._random[i], self.goal_distance
        if self.ball:
            away = random_displacement(random, *(distance or GOAL_AWAY))
            goal = np.append(self.ball.place[i, :2] + away, 0.0)
        elif distance is None:
            goal = self.arena.goal(i, random, place, self.RULE)
        else:
            x, y = place + random_displacement(random, *distance)
            ground = self.arena.grounds[i]  # also beyond the window
            assert ground is not None
            height = float(ground.height(x, y, self.arena.mover_centres(i)))
            goal = np.array([x, y, height if math.isfinite(height) else 0.0])
        self.goals.place[i] = goal
        lasts = random.uniform(*GOAL_LASTS)
        self.goals.due[i] = self.clock.steps[i] + round(lasts / CONTROL_TIMESTEP)

    def markers(self, env_id: int) -> list[Marker]:
        """Returns markers of past positions of the centre of mass, and of the goal."""
        places, size, goal = self.goals.trace[env_id], (TRACE_RADIUS,) * 3, self.goal[env_id]
        past = places[np.isfinite(places[:, 0])]
        there = flag(goal)
        if self.ball:
            radius = math.sqrt(self.goal_reached**2 - BALL_RADIUS**2)  # of the ball's centre, above
            there = Marker('cylinder', goal, (radius, 0.005, 0.0), GOAL_COLOUR)
        return [*(Marker('sphere', place, size, TRACE_COLOUR) for place in past), there]
