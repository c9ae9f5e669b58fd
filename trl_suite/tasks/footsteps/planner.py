"""Footstep plans, drawn at the start of an episode and at each landing: options, and the planner."""

from __future__ import annotations

import dataclasses

import numpy as np

from trl_suite.bodies.body import Measurement
from trl_suite.motion import quaternion
from trl_suite.tasks.common.footstep_plan import SIDE, Planned
from trl_suite.tasks.footsteps.rules import FootstepState
from trl_suite.tasks.tracking import TrackingTask
from trl_suite.util.options import Config, Range, option

# Meanings of options of all tasks that follow footstep plans.
MAX_LANDING_ERROR = (
    'distance between a foot and its landing place above which landing ends the episode; by default there '
    'is no limit'
)
FOOTSTEP_SCALE = 'factor of the squared landing error in the reward; larger values reward accuracy'
ROOT_TURN_LIMIT = 1.2  # rad; largest turn of a plan relative to the root
NEAR_GOAL = 0.1  # m; a nearer goal does not change the planned heading
GOAL_REACHED = 1.0  # m; a nearer goal is redrawn


@dataclasses.dataclass(frozen=True, kw_only=True)
class StraightPlans(Config):
    """Options for drawing plans in the plane."""

    length: Range = option(Range(0.4, 0.4), 'length of a step', unit='m', at_least=0)
    change: float = option(
        0.1, 'probability that the length of a step is redrawn', at_least=0, at_most=1
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Plans(Config):
    """Options for drawing plans; a plan has the next landing places of both feet and a heading.

    At every switch of stance, the second landing place of the old plan becomes the first of the new
    one. The new second place is displaced from it by the length of a step along the planned
    heading, and by its width to the side of the foot.
    """

    length: Range = option(Range(0.5, 0.5), 'length of a step', unit='m', at_least=0)
    width: Range = option(
        Range(0.15, 0.15), 'distance between the feet to the side', unit='m', at_least=0
    )
    change: float = option(
        0.1, 'probability that length and width of a step are redrawn', at_least=0, at_most=1
    )
    turn: float = option(
        0.25,
        'standard deviation of the change of heading from one step to the next',
        unit='rad',
        at_least=0,
    )
    sharp: float = option(
        0.1, 'probability of a sharp turn instead, drawn from [-pi, pi)', at_least=0, at_most=1
    )
    from_root: float = option(
        0.0,
        'probability that a plan is relative to position and heading of the root, as the plans of a '
        'high-level controller are',
        at_least=0,
        at_most=1,
    )
    root_length: Range = option(Range(0.2, 0.7), 'length of its steps', unit='m', at_least=0)
    root_width: Range = option(Range(0.08, 0.28), 'width of its steps', unit='m', at_least=0)
    root_turn: float = option(
        0.3,
        f'standard deviation of its turn from the current heading; clipped to +-{ROOT_TURN_LIMIT}',
        unit='rad',
        at_least=0,
    )


class PlanTask(Planned, TrackingTask):
    """A body that tracks footsteps; plans are drawn at the start of an episode and at each landing.

    Landing places and headings are written to the plan; sizes of steps, goals, and until when landing
    errors do not count after a sharp turn, to the state.

    Attributes:
      state: state in addition to the plan.
      goal_given: whether plans lead to goals.
    """

    state: FootstepState
    goal_given = False
    _grace_steps = 0  # control steps after a sharp turn in which landing errors do not count
    _drawn_plans: Plans  # how plans are drawn; for planar characters without what they have not

    def _begin_plans(self, env_ids: np.ndarray, measurement: Measurement) -> None:
        """Draws the first plans of episodes, and their first goals.

        Args:
          env_ids: indices of simulations, (m,), whose stance feet are known.
          measurement: measurement of the characters.
        """
        plan, state, origins = self.plan, self.state, self.travel.origin[env_ids]
        aside, sizes = np.zeros(len(env_ids)), np.zeros((len(env_ids), 2, 2))
        for k, i in enumerate(env_ids.tolist()):
            self._redraw_size(i, always=True)
            aside[k] = state.width[i]
            if self.goal_given:
                state.goal[i] = self.arena.goal(i, self._random[i], origins[k, :2], 'near')
            sizes[k] = self._next_size(i), self._next_size(i)
        places, angles = origins[:, :2], origins[:, 2]
        plan.heading[env_ids] = angles
        stance = plan.stance[env_ids]
        anchors = measurement.feet[env_ids, stance, :2]
        if self.goal_given:
            self._head_for_goals(env_ids, measurement.root[env_ids, :2])
        else:
            # The feet land on both sides of a line through the start, at half a width from it.
            line = quaternion.rotate_xy(anchors - places, -angles)
            line[:, 1] = 0.5 * SIDE[stance] * aside
            anchors = places + quaternion.rotate_xy(line, angles)
        for which, foot in enumerate((1 - stance, stance)):
            anchors = self._lay(env_ids, which, foot, anchors, sizes[:, which])

    def _replan(self, env_ids: np.ndarray, measurement: Measurement) -> None:
        """Draws the next plans of some simulations at a switch of stance.

        Args:
          env_ids: indices of simulations, (m,).
          measurement: measurement of the characters.
        """
        plans, plan, count = self._drawn_plans, self.plan, len(env_ids)
        by_root, turns, sizes = np.zeros(count, bool), np.zeros(count), np.zeros((count, 2, 2))
        for k, i in enumerate(env_ids.tolist()):
            random = self._random[i]
            if plans.from_root and random.uniform() < plans.from_root:
                by_root[k] = True
                turns[k] = random.normal(0, plans.root_turn)
                for which in (0, 1):
                    ahead = random.uniform(*plans.root_length)
                    sizes[k, which] = ahead, random.uniform(*plans.root_width)
                continue
            if self.goal_given:
                root, goal = measurement.root[i, :2], self.state.goal
                if np.hypot(*(root - goal[i, :2])) < GOAL_REACHED:
                    goal[i] = self.arena.goal(i, random, root, 'near')
            elif plans.sharp and random.uniform() < plans.sharp:
                turns[k] = random.uniform(-np.pi, np.pi)
                self.state.excused[i] = self.clock.steps[i] + self._grace_steps
            elif plans.turn:
                turns[k] = random.normal(0, plans.turn)
            sizes[k, 1] = self._next_size(i)
        stance = plan.stance[env_ids]
        on = ~by_root
        if on.any():
            going = env_ids[on]
            if self.goal_given:
                self._head_for_goals(going, plan.landing[going, :, :2].mean(1))
            plan.heading[going] += turns[on]
            plan.landing[going, 0] = plan.landing[going, 1]
            self._lay(going, 1, stance[on], plan.landing[going, 0, :2], sizes[on, 1])
        if by_root.any():
            going, foot = env_ids[by_root], stance[by_root]
            off = np.clip(turns[by_root], -ROOT_TURN_LIMIT, ROOT_TURN_LIMIT)
            plan.heading[going] = measurement.heading[going] + off
            places = measurement.feet[going, foot, :2]
            for which, feet in enumerate((1 - foot, foot)):
                places = self._lay(going, which, feet, places, sizes[by_root, which])

    def _redraw_size(self, i: int, always: bool = False) -> None:
        """Redraws length and width of steps, always or with probability `change`."""
        plans, random = self._drawn_plans, self._random[i]
        if always or random.uniform() < plans.change:
            self.state.length[i] = random.uniform(*plans.length)
            if self._spatial:
                self.state.width[i] = random.uniform(*plans.width)

    def _next_size(self, i: int) -> tuple[float, float]:
        """Returns length and width of the next step, m; redraws them with probability `change`."""
        self._redraw_size(i)
        return float(self.state.length[i]), float(self.state.width[i])

    def _head_for_goals(self, env_ids: np.ndarray, places: np.ndarray) -> None:
        """Sets planned headings from places (m, 2) to the goals, except within NEAR_GOAL."""
        displacement = self.state.goal[env_ids, :2] - places
        headings = np.arctan2(displacement[:, 1], displacement[:, 0])
        far = np.hypot(displacement[:, 0], displacement[:, 1]) > NEAR_GOAL
        self.plan.heading[env_ids[far]] = headings[far]

    def _lay(
        self,
        env_ids: np.ndarray,
        which: int,
        feet: np.ndarray,
        places: np.ndarray,
        sizes: np.ndarray,
    ) -> np.ndarray:
        """Writes one landing place to each plan: a step from the position of the other foot.

        Args:
          env_ids: indices of simulations, (m,).
          which: which of the plan's two landing places, 0 or 1.
          feet: the feet that step, (m,).
          places: positions of the other feet, (m, 2) m.
          sizes: lengths and widths of the steps, (m, 2) m.

        Returns:
          The landing places, (m, 2) m.
        """
        steps = sizes.copy()
        steps[:, 1] *= SIDE[feet]
        places = places + quaternion.rotate_xy(steps, self.plan.heading[env_ids])
        self.plan.landing[env_ids, which, :2] = places
        self.plan.landing[env_ids, which, 2] = self.figure.heights(env_ids, places)
        return places
