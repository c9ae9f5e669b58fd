"""Footstep plans, drawn at the start of an episode and at each landing: options, and the planner."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from trl_suite.motion import quaternion
from trl_suite.tasks.common.footstep_plan import SIDE, FootstepPlan
from trl_suite.tasks.footsteps.rules import FootstepState
from trl_suite.tasks.tracking import TrackingTask
from trl_suite.util.options import Config, Range, option, within

# Meanings of options of all tasks that follow footstep plans.
MAX_LANDING_ERROR = (
    'distance between a foot and its landing place above which landing ends the episode; by default there '
    'is no limit'
)
FOOTSTEP_SCALE = 'factor of the squared landing error in the reward; larger values reward accuracy'
ROOT_TURN_LIMIT = 1.2  # rad; largest turn of a plan relative to the root
NEAR_GOAL = 0.1  # m; a nearer goal does not change the planned heading
GOAL_REACHED = 1.0  # m; a nearer goal is redrawn
FAR = 10.0  # m; largest length and width of a step
LONGEST_STAY = 10_000  # footsteps


@dataclasses.dataclass(frozen=True, kw_only=True)
class StraightPlans(Config):
    """Options for drawing plans in the plane."""

    length: Range = option(Range(0.4, 0.4), 'length of a step', **within(0, FAR, 'm'))
    change: float = option(
        0.1, 'probability that the length of a step is redrawn', at_least=0, at_most=1
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Plans(Config):
    """Options for drawing plans; a plan has the next landing places of both feet and a heading.

    At every switch of stance, the second landing place of the old plan becomes the first of the new
    one. The new second place is displaced from it by the length of a step along the planned
    heading, and by its width to the side of the foot. With `react`, both follow the foot that landed.
    """

    length: Range = option(Range(0.5, 0.5), 'length of a step', **within(0, FAR, 'm'))
    width: Range = option(
        Range(0.15, 0.15), 'distance between the feet to the side', **within(0, FAR, 'm')
    )
    change: float = option(
        0.1, 'probability that length and width of a step are redrawn', at_least=0, at_most=1
    )
    turn: float = option(
        0.25,
        'standard deviation of the change of heading from one step to the next, without goals',
        **within(0, 2 * math.pi, 'rad'),
    )
    sharp: float = option(
        0.1,
        'probability of a sharp turn instead, drawn from [-pi, pi), without goals',
        at_least=0,
        at_most=1,
    )
    from_root: float = option(
        0.0,
        'probability that a plan is drawn anew, from the stance foot and with the heading of the root, '
        'independent of earlier plans, as those of a high-level controller are',
        at_least=0,
        at_most=1,
    )
    root_length: Range = option(Range(0.2, 0.7), 'length of its steps', **within(0, FAR, 'm'))
    root_width: Range = option(Range(0.08, 0.28), 'width of its steps', **within(0, FAR, 'm'))
    root_turn: float = option(
        0.3,
        f'standard deviation of its turn from the current heading; clipped to +-{ROOT_TURN_LIMIT}',
        **within(0, 2 * math.pi, 'rad'),
    )
    stop: float = option(
        0.0,
        'probability that the walker is to stop at a landing: the swing foot lands beside the stance foot, '
        "and both stay; for standing, combine with style='stand'",
        at_least=0,
        at_most=1,
    )
    stay: Range = option(
        Range(4, 40),
        'number of plans, one for each footstep, with which it then stays: with the first the swing foot '
        'lands beside the stance foot, and after the last the next foot first steps in place',
        **within(1, LONGEST_STAY, 'footsteps'),
    )
    react: float = option(
        0.0,
        'share of the landing error by which a plan moves with the walker at each landing, however large the '
        'error: 0, landing places stand still in the world; 1, they are relative to where the foot landed',
        at_least=0,
        at_most=1,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if any(limit % 1 for limit in self.stay):
            low, high = self.stay
            raise ValueError(
                f'stay is ({low:g}, {high:g}); expected whole numbers of footsteps, such as '
                f'({math.ceil(low)}, {math.ceil(high)})'
            )


class PlanTask(TrackingTask):
    """A body that tracks footsteps; plans are drawn at the start of an episode and at each landing.

    Landing places and headings are written to the plan; sizes of steps, goals, and until when landing
    errors do not count after a sharp turn, to the state.

    Attributes:
      plan: plans of the simulations.
      state: state in addition to the plans.
      goal_given: whether plans lead to goals.
    """

    plan: FootstepPlan
    state: FootstepState
    goal_given = False
    _grace_steps = 0  # control steps after a sharp turn in which landing errors do not count
    _drawn_plans: Plans  # how plans are drawn; planar ones have no width and no turns

    def _begin_plan(self, i: int) -> None:
        """Draws the first plan of an episode, and its first goal; the stance foot is known."""
        plan, state, random = self.plan, self.state, self._random[i]
        place, angle = self.travel.origin[i, :2], self.travel.origin[i, 2]
        feet, stance = self.body.measurement.feet[i, :, :2], plan.stance[i]
        self._redraw_size(i, always=True)
        aside = state.width[i]
        if self.goal_given:
            state.goal[i] = self.arena.goal(i, random, place, 'near')
        sizes = self._next_size(i), self._next_size(i)
        plan.heading[i] = angle
        if self.goal_given:
            self._head_for_goal(i, self.body.measurement.root[i, :2])
            self._lay_both(i, feet[stance], sizes)
            return
        # The feet land on both sides of a line through the start, at half a width from it.
        line = quaternion.rotate_xy(feet[stance] - place, -angle)
        line[1] = 0.5 * SIDE[stance] * aside
        self._lay_both(i, place + quaternion.rotate_xy(line, angle), sizes)

    def _replan(self, i: int) -> None:
        """Draws the next plan of a simulation at a switch of stance."""
        plans, plan, state, random = self._drawn_plans, self.plan, self.state, self._random[i]
        measurement, stance, turn = self.body.measurement, plan.stance[i], 0.0
        if plans.stop and not state.staying[i] and random.uniform() < plans.stop:
            state.staying[i] = round(random.uniform(*plans.stay))
        if state.staying[i]:
            state.staying[i] -= 1
            beside = 0.0, state.width[i]
            self._lay_both(i, measurement.feet[i, stance, :2], (beside, beside))
            return
        if plans.from_root and random.uniform() < plans.from_root:
            turn = np.clip(random.normal(0, plans.root_turn), -ROOT_TURN_LIMIT, ROOT_TURN_LIMIT)
            ranges = plans.root_length, plans.root_width
            first, second = ([random.uniform(*each) for each in ranges] for _ in range(2))
            plan.heading[i] = measurement.heading[i] + turn
            self._lay_both(i, measurement.feet[i, stance, :2], (first, second))
            return
        if plans.react:
            error = measurement.feet[i, stance, :2] - plan.landing[i, 0, :2]
            plan.landing[i, :, :2] += plans.react * error
            plan.landing[i, 1, 2] = self.body.heights(np.array([i]), plan.landing[i, 1:, :2])[0]
        if self.goal_given:
            root, goal = measurement.root[i, :2], state.goal
            if np.hypot(*(root - goal[i, :2])) < GOAL_REACHED:
                goal[i] = self.arena.goal(i, random, root, 'near')
        elif plans.sharp and random.uniform() < plans.sharp:
            turn = random.uniform(-np.pi, np.pi)
            state.excused[i] = self.clock.steps[i] + self._grace_steps
        elif plans.turn:
            turn = random.normal(0, plans.turn)
        size = self._next_size(i)
        if self.goal_given:
            self._head_for_goal(i, plan.landing[i, :, :2].mean(0))
        plan.heading[i] += turn
        plan.landing[i, 0] = plan.landing[i, 1]
        self._lay(i, 1, stance, plan.landing[i, 0, :2], size)

    def _redraw_size(self, i: int, always: bool = False) -> None:
        """Redraws length and width of steps, always or with probability `change`."""
        plans, random = self._drawn_plans, self._random[i]
        if always or random.uniform() < plans.change:
            self.state.length[i] = random.uniform(*plans.length)
            if self._spatial:  # only then steps have a width
                self.state.width[i] = random.uniform(*plans.width)

    def _next_size(self, i: int) -> tuple[float, float]:
        """Returns length and width of the next step, m; redraws them with probability `change`."""
        self._redraw_size(i)
        return float(self.state.length[i]), float(self.state.width[i])

    def _head_for_goal(self, i: int, place: np.ndarray) -> None:
        """Sets the planned heading from a place (2,) to the goal, except within NEAR_GOAL."""
        x, y = self.state.goal[i, :2] - place
        if np.hypot(x, y) > NEAR_GOAL:
            self.plan.heading[i] = np.arctan2(y, x)

    def _lay_both(self, i: int, place: np.ndarray, sizes: Sequence[Sequence[float]]) -> None:
        """Writes both landing places to a plan, from the position (2,) of the stance foot."""
        stance = self.plan.stance[i]
        for which, foot in enumerate((1 - stance, stance)):
            place = self._lay(i, which, foot, place, sizes[which])

    def _lay(
        self, i: int, which: int, foot: int, place: np.ndarray, size: Sequence[float]
    ) -> np.ndarray:
        """Writes one landing place to a plan: a step from the position of the other foot.

        Args:
          i: index of the simulation.
          which: which of the plan's two landing places, 0 or 1.
          foot: the foot that steps.
          place: position of the other foot, (2,) m.
          size: length and width of the step, m.

        Returns:
          The landing place, (2,) m.
        """
        step = np.array([size[0], size[1] * SIDE[foot]])
        place = place + quaternion.rotate_xy(step, self.plan.heading[i])
        self.plan.landing[i, which, :2] = place
        self.plan.landing[i, which, 2] = self.body.heights(np.array([i]), place[None])[0]
        return place
