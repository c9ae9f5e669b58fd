"""Going from goal to goal without hierarchy: joints are driven 30 times a second, by one policy.

Source: the 'Hard' environments of the original, and its imitation scenario with a goal, which they
were meant to have.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

from trl_suite import errors
from trl_suite.arenas import SpatialTerrain
from trl_suite.characters import Character
from trl_suite.engine import World
from trl_suite.motion import Clip, Steps, quaternion
from trl_suite.tasks import ball, rewards
from trl_suite.tasks.figure3d import polar
from trl_suite.tasks.footsteps import GOAL_COLOUR, Footsteps
from trl_suite.tasks.high_level import GOAL_LASTS, flag
from trl_suite.tasks.imitation3d import SpatialImitation
from trl_suite.tasks.reflection3d import Reflection
from trl_suite.tasks.task import Marker, consecutive
from trl_suite.tasks.trace import Trace
from trl_suite.tasks.tracking3d import CONTROL_TIMESTEP, SUBSTEPS, Tracking

REWARDS = ('goal', 'original')
GOAL_REACHED = 0.5  # m; of the root, on the ground
NEAR = 3.0  # m from the goal, where neither speed nor heading counts any longer
HIDDEN_LENGTH = 0.4  # m; of the steps of the plan that the original's reward is about


class Journey(SpatialImitation):
    """A spatial character imitates a clip on its way from goal to goal.

    The reward is that of imitation, but that the clip's velocity is turned towards the goal, and
    heading for the goal and nearness are rewarded too (`rewards.JOURNEY_TERMS`).

    Observation blocks, in this order: terrain, pose, velocity, phase as in `SpatialImitation`, and
      goal: bearing of the goal, rad to the left of the heading, and its distance, m.
    """

    TERMS = rewards.JOURNEY_TERMS

    def __init__(
        self,
        character: Character,
        arena: SpatialTerrain,
        clip: Clip,
        *,
        actuation_model: str = 'position',
        terrain_map: bool = True,
        goal_reached: float = GOAL_REACHED,
        substeps: int = SUBSTEPS,
        centre: str = 'clip',
        half_range: float | None = None,
        start_phase: float | Sequence[Sequence[float]] | None = None,
        blend: float = 0.0,
    ) -> None:
        """Composes the task.

        Args:
          character: a spatial character without actuators; it is attached to the arena.
          arena: where it moves.
          clip: a looping clip for this character, with a free root.
          actuation_model: one of `trl_suite.actuation.ACTUATIONS`.
          terrain_map: observe the heights around.
          goal_reached: m; nearer, a goal is drawn anew.
          substeps, centre, half_range, start_phase, blend: as for `SpatialImitation`.

        Raises:
          ValueError: options out of range, or a clip that does not fit the character.
        """
        if not 0 < goal_reached < np.inf:
            raise ValueError(
                f'goal_reached is {goal_reached}; expected a positive number of metres'
            )
        self._goal_reached = goal_reached
        self._furnish(arena)
        super().__init__(
            character, arena, clip, actuation_model=actuation_model, terrain_map=terrain_map,
            substeps=substeps, centre=centre, half_range=half_range, start_phase=start_phase,
            blend=blend,
        )  # fmt: skip

    def _furnish(self, arena: SpatialTerrain) -> None:
        """Adds what is there beside the ground."""

    def bind(self, world: World) -> None:
        super().bind(world)
        n = world.n
        terms = np.array(list(rewards.JOURNEY_TERMS.values()))
        self._term_weights, self._term_scales = terms[None, :, 0], -terms[None, :, 1]
        self.goal = np.zeros((n, 3))  # m
        self._due = np.zeros(n, int)  # control step of the episode at which it is drawn anew
        self.goals_reached = np.zeros(n, int)  # in the episode
        self._speed = np.zeros(n)  # m/s towards where it goes
        self.trace = Trace(n)  # of the centre of mass
        self._places = self.trace.places
        self._every = np.arange(n)

    # Episodes.

    def _start(
        self, rows: np.ndarray, random_states: Sequence[np.random.RandomState]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        spawns = self._begin_grounds(rows, random_states)
        times = self._start_cycles[rows] * self.period
        poses, rates = self.clip.state(times)
        poses[:, :2] = 0.0
        return poses, rates, spawns

    def _begun_on_ground(self, rows: np.ndarray) -> None:
        self.goals_reached[rows] = 0
        self._speed[rows] = 0.0
        self.trace.begin(rows)
        for row in rows.tolist():
            self._draw_goal(row, self._origin[row, :2])

    def _draw_goal(self, row: int, place: np.ndarray) -> None:
        self.goal[row] = self._goal_drawn(row, place)
        lasts = self._random[row].uniform(*GOAL_LASTS)
        self._due[row] = self._count[row] + round(lasts / CONTROL_TIMESTEP)

    def _goal_drawn(self, row: int, place: np.ndarray) -> np.ndarray:
        """Returns a goal for a walker at a place, (3,) m."""
        return self.arena.goal(row, self._random[row], place, 'step')

    # Steps.

    def _step(self, found: SimpleNamespace) -> None:
        self.trace.follow(self._every, self._count, found.com)
        place = found.root[:, :2]
        reached = self._arrived(found) & ~self.diverged
        self.goals_reached += reached
        for row in np.flatnonzero(self._moves_on(reached)).tolist():
            self._draw_goal(row, place[row])

    def _arrived(self, found: SimpleNamespace) -> np.ndarray:
        """Which rows have what they were to bring about, (n,) bool."""
        way = self.goal[:, :2] - found.root[:, :2]
        return (way * way).sum(1) < self._goal_reached**2

    def _moves_on(self, reached: np.ndarray) -> np.ndarray:
        """Which rows get another goal, (n,) bool."""
        return (reached | (self._count >= self._due)) & ~self.diverged

    def _aim(self) -> np.ndarray:
        """Where to go, (n, 3) m."""
        return self.goal

    def _compare(self, found: SimpleNamespace) -> None:
        way = (self._aim() - found.root)[:, :2]
        squared = (way * way).sum(1)
        distance = np.sqrt(squared)
        x, y = way.T.copy()
        direction = np.arctan2(y, x)
        reference = self.reference.features(self.phase)
        self._reference_now = reference
        velocity = reference[:, self.reference.columns['com_velocity']]
        velocity[:, :2] = quaternion.turned(velocity[:, :2], direction)
        errors = np.empty((len(way), len(rewards.JOURNEY_TERMS)))
        errors[:, :5] = self._errors(found, reference)
        off = rewards.wrap(direction - found.heading)
        near = distance < NEAR
        errors[near, 3] = 0.0  # of the centre of mass
        off[near] = 0.0
        errors[:, 5] = 0.0
        errors[:, 6] = squared / NEAR**2
        terms = self.reward_terms[:, : errors.shape[1]]
        terms[...] = rewards.exponentials(errors, self._term_weights, self._term_scales)
        terms[:, 5] *= rewards.heading(off)
        along = (found.com_velocity[:, :2] * way).sum(1)
        self._speed[:] = along / np.maximum(distance, 1e-9)

    def _write_goal(self, found: SimpleNamespace) -> None:
        goal = self._observation[:, self._full['goal']]
        goal[...] = polar((self.goal - found.root)[:, None, :2], found)

    def infos(self) -> dict[str, Any]:
        """As for imitation; and goals reached in the episode, and speed towards the goal, m/s."""
        return {
            **super().infos(),
            'goals_reached': self.goals_reached.copy(),
            'speed': self._speed.copy(),
        }

    _distance = Tracking._distance
    reference_pose = None  # type: ignore[assignment]  # it is nowhere in particular

    def markers(self, row: int) -> list[Marker]:
        """The way of the centre of mass, and the goal."""
        return [*self.trace.markers(row), flag(self.goal[row])]

    _KEPT: tuple[str, ...] = ('goal', '_due', 'goals_reached', '_speed', '_places')


BALL_TERMS = {
    name: (weight / 2, scale)
    for name, (weight, scale) in {**rewards.JOURNEY_TERMS, **ball.SOCCER_TERMS}.items()
}


class BallJourney(Journey):
    """A spatial character imitates a clip on its way to a ball, and dribbles it to a goal.

    Half of the reward is that of a journey to the ball, half that of `trl_suite.tasks.soccer`.

    Observation blocks, in this order: pose, velocity, phase as in `SpatialImitation`, and
      goal: bearing and distance of the goal as seen from the ball, rad and m.
      ball: as in `trl_suite.tasks.soccer`.
    """

    TERMS = BALL_TERMS

    def _furnish(self, arena: SpatialTerrain) -> None:
        self.ball = ball.Ball(arena)

    def _goal_blocks(self) -> dict[str, int]:
        return {'goal': 2, 'ball': 9}

    def bind(self, world: World) -> None:
        super().bind(world)
        self.ball.bind(world)
        n = world.n
        self._ball_due = np.zeros(n, int)  # control step at which it is put elsewhere
        self._ball_from, self._from = np.zeros((2, n, 3))  # m; ball and walker a step ago
        self.at_goal = np.zeros(n, bool)  # whether the ball is there

    def _begun_on_ground(self, rows: np.ndarray) -> None:
        self.at_goal[rows] = False
        for row in rows.tolist():
            self._put_ball(row, self._origin[row, :2])
        super()._begun_on_ground(rows)
        self.world.forward(rows)  # balls have been put down
        self._remember(rows, self.figure.measure())

    def _put_ball(self, row: int, place: np.ndarray) -> None:
        lasts = self.ball.put(row, place, self._random[row])
        self._ball_due[row] = self._count[row] + round(lasts / CONTROL_TIMESTEP)

    def _goal_drawn(self, row: int, place: np.ndarray) -> np.ndarray:
        return self.ball.goal(row, self._random[row])

    def _remember(self, rows: np.ndarray | slice, found: SimpleNamespace) -> None:
        self._ball_from[rows] = self.ball.place[rows]
        self._from[rows] = found.com[rows]

    def _step(self, found: SimpleNamespace) -> None:
        terms, _, self.at_goal[:] = ball.terms(
            self._from, found.com - self._from, self._ball_from, self.ball.place, self.goal,
            CONTROL_TIMESTEP, at_goal=self._goal_reached,
        )  # fmt: skip
        self.reward_terms[:, len(rewards.JOURNEY_TERMS) :] = terms / 2
        due = np.flatnonzero((self._count >= self._ball_due) & ~self.diverged)
        for row in due.tolist():
            self._put_ball(row, found.root[row, :2])
        if len(due):
            self.world.forward(due)
        super()._step(found)
        self._remember(slice(None), found)

    def _arrived(self, found: SimpleNamespace) -> np.ndarray:
        return self.at_goal

    def _moves_on(self, reached: np.ndarray) -> np.ndarray:
        return (self._count >= self._due) & ~self.diverged  # reaching it does not end it

    def _aim(self) -> np.ndarray:
        return self.ball.place

    def _compare(self, found: SimpleNamespace) -> None:
        super()._compare(found)
        self.reward_terms[:, : len(rewards.JOURNEY_TERMS)] /= 2

    def _write_goal(self, found: SimpleNamespace) -> None:
        goal = self._observation[:, self._full['goal']]
        goal[...] = polar((self.goal - self.ball.place)[:, None, :2], found)
        self.ball.write(found, self._observation[:, self._full['ball']])

    def _extra_mirror(self, name: str) -> Reflection:
        if name == 'ball':
            return np.arange(len(ball.MIRRORED)), np.array(ball.MIRRORED)
        return super()._extra_mirror(name)

    def infos(self) -> dict[str, Any]:
        """As for a journey, with `speed` towards the ball; and whether that is at the goal.

        `goals_reached` counts the steps that end with the ball at the goal.
        """
        return {**super().infos(), 'at_goal': self.at_goal.copy()}

    def markers(self, row: int) -> list[Marker]:
        """The way of the centre of mass, and the goal as a disc on the ground."""
        disc = Marker('cylinder', self.goal[row], (self._goal_reached, 0.005, 0.0), GOAL_COLOUR)
        return [*self.trace.markers(row), disc]

    _KEPT = (*Journey._KEPT, '_ball_due', '_ball_from', '_from', 'at_goal')


class HiddenSteps(Footsteps):
    """What the original's 'Hard' environments are: they show a goal and reward something else.

    The reward is that of following footsteps 0.4 m long, of which nothing is observed; the goal stays
    where it is. In the original that plan begins at the world's origin, mostly far away; here at the
    start.

    Observation blocks are those of `Journey`.
    """

    def __init__(
        self, character: Character, arena: SpatialTerrain, steps: Steps, **options: Any
    ) -> None:
        """Composes the task; options are those of `Footsteps` but for plans, goal and mirrored."""
        plans = {'length': (HIDDEN_LENGTH,) * 2}
        super().__init__(character, arena, steps, plans=plans, **options)
        names = [name for name in self._full if name not in ('contact', 'plan')]
        self.blocks = consecutive({
            name: self._full[name].stop - self._full[name].start for name in names
        })  # fmt: skip
        self._shown = np.concatenate([np.r_[self._full[name]] for name in names])
        full = self.mirror
        assert full is not None
        place = np.zeros(len(full.observation_sign), int)
        place[self._shown] = np.arange(len(self._shown))
        self.mirror = dataclasses.replace(
            full,
            observation_index=place[full.observation_index[self._shown]],
            observation_sign=full.observation_sign[self._shown],
        )

    def _extra_blocks(self) -> dict[str, int]:
        return {**super()._extra_blocks(), 'goal': 2}

    def _extra_mirror(self, name: str) -> Reflection:
        if name == 'goal':
            return np.arange(2), np.array([-1.0, 1.0])
        return super()._extra_mirror(name)

    def bind(self, world: World) -> None:
        super().bind(world)
        self.observation = np.zeros((world.n, len(self._shown)))

    def _begun_on_ground(self, rows: np.ndarray) -> None:
        super()._begun_on_ground(rows)
        for row in rows.tolist():
            self.goal[row] = self.arena.goal(row, self._random[row], self._origin[row, :2], 'step')

    def _write_extras(self, found: SimpleNamespace) -> None:
        super()._write_extras(found)
        goal = self._observation[:, self._full['goal']]
        goal[...] = polar((self.goal - found.root)[:, None, :2], found)

    def _publish(self) -> None:
        self._observation.take(self._shown, 1, self.observation, 'clip')

    reference_pose = None  # type: ignore[assignment]

    def markers(self, row: int) -> list[Marker]:
        """The goal, and the plan that nobody sees."""
        return [*super().markers(row), flag(self.goal[row])]


def journey(
    character: Character,
    arena: SpatialTerrain,
    clip: Clip,
    steps: Steps | None,
    *,
    reward: str = 'goal',
    actuation_model: str = 'position',
    goal_reached: float | None = None,
    terrain_map: bool = True,
    substeps: int = SUBSTEPS,
    centre: str = 'clip',
    half_range: float | None = None,
    start_phase: float | Sequence[Sequence[float]] | None = None,
    blend: float = 0.0,
) -> Journey | HiddenSteps:
    """Composes what one of the rewards is for.

    Args:
      reward: 'goal', see `Journey`; or 'original', see `HiddenSteps`, whose goal stays.
      goal_reached: m, 0.5 by default; only for 'goal'.
      steps: only for 'original'.
      character, arena, clip, and the other options: as for the classes.

    Raises:
      ValueError: options out of range, or that do not fit each other.
    """
    options: dict[str, Any] = {
        'actuation_model': actuation_model, 'terrain_map': terrain_map, 'substeps': substeps,
        'centre': centre, 'half_range': half_range, 'start_phase': start_phase, 'blend': blend,
    }  # fmt: skip
    if reward not in REWARDS:
        raise ValueError(errors.unknown('reward', reward, REWARDS))
    if reward == 'goal':
        reached = GOAL_REACHED if goal_reached is None else goal_reached
        return Journey(character, arena, clip, goal_reached=reached, **options)
    if goal_reached is not None:
        raise ValueError("goal_reached is an option of the reward 'goal', not of 'original'")
    if steps is None:
        raise ValueError("the reward 'original' needs a library of steps")
    return HiddenSteps(character, arena, steps, **options)
