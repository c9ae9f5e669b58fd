"""Footstep plans, drawn at the start of an episode, and at each landing."""

from __future__ import annotations

from typing import Any

import numpy as np

from trl_suite.bodies.body import Body, Measurement
from trl_suite.motion import quaternion
from trl_suite.tasks.common.footstep_plan import SIDE, FootstepPlan
from trl_suite.tasks.common.plans import ROOT_TURN_LIMIT, Plans
from trl_suite.tasks.common.tracking_rules import Clock
from trl_suite.tasks.footsteps.rules import FootstepState

NEAR_GOAL = 0.1  # m; a nearer goal does not change the planned heading
GOAL_REACHED = 1.0  # m; a nearer goal is redrawn


class Planner:
    """Draws the footstep plans of all simulations.

    It writes landing places and headings to the plan. To the state of the task it writes sizes of
    steps, goals, and until when landing errors do not count after a sharp turn.
    """

    def __init__(
        self,
        plans: Plans,
        figure: Body,
        plan: FootstepPlan,
        state: FootstepState,
        clock: Clock,
        random: list[np.random.Generator],
        *,
        goals: bool,
        grace_steps: int,
    ) -> None:
        """Keeps what it draws from and writes to.

        Args:
          plans: how plans are drawn.
          figure: the body, for heights of landing places, and its arena, which draws goals.
          plan: the plan of each simulation, written here.
          state: the state of the task, written here.
          clock: the clocks.
          random: the random generator of each simulation; a list that the task updates.
          goals: whether plans lead to goals.
          grace_steps: control steps after a sharp turn in which landing errors do not count.
        """
        self._plans, self._figure, self._clock, self._random = plans, figure, clock, random
        self._arena: Any = figure.arena
        self._sideways = figure.character.spec.spatial  # whether steps have a width
        self._plan, self._state = plan, state
        self._goals, self._grace_steps = goals, grace_steps

    def begin(self, env_ids: np.ndarray, origins: np.ndarray, measurement: Measurement) -> None:
        """Draws the first plans of episodes, and their first goals.

        Args:
          env_ids: indices of simulations, (m,), whose stance feet are known.
          origins: start positions x, y (m) and headings (rad), (m, 3).
          measurement: measurement of the characters.
        """
        plan, state = self._plan, self._state
        aside, sizes = np.zeros(len(env_ids)), np.zeros((len(env_ids), 2, 2))
        for k, i in enumerate(env_ids.tolist()):
            self._redraw_size(i, always=True)
            aside[k] = state.width[i]
            if self._goals:
                state.goal[i] = self._arena.goal(i, self._random[i], origins[k, :2], 'near')
            sizes[k] = self._next_size(i), self._next_size(i)
        places, angles = origins[:, :2], origins[:, 2]
        plan.heading[env_ids] = angles
        stance = plan.stance[env_ids]
        anchors = measurement.feet[env_ids, stance, :2]
        if self._goals:
            self._head_for_goals(env_ids, measurement.root[env_ids, :2])
        else:
            # The feet land on both sides of a line through the start, at half a width from it.
            line = quaternion.rotate_xy(anchors - places, -angles)
            line[:, 1] = 0.5 * SIDE[stance] * aside
            anchors = places + quaternion.rotate_xy(line, angles)
        for which, foot in enumerate((1 - stance, stance)):
            anchors = self._lay(env_ids, which, foot, anchors, sizes[:, which])

    def replan(self, env_ids: np.ndarray, measurement: Measurement) -> None:
        """Draws the next plans of some simulations at a switch of stance.

        Args:
          env_ids: indices of simulations, (m,).
          measurement: measurement of the characters.
        """
        plans, plan, count = self._plans, self._plan, len(env_ids)
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
            if self._goals:
                root, goal = measurement.root[i, :2], self._state.goal
                if np.hypot(*(root - goal[i, :2])) < GOAL_REACHED:
                    goal[i] = self._arena.goal(i, random, root, 'near')
            elif plans.sharp and random.uniform() < plans.sharp:
                turns[k] = random.uniform(-np.pi, np.pi)
                self._state.excused[i] = self._clock.steps[i] + self._grace_steps
            elif plans.turn:
                turns[k] = random.normal(0, plans.turn)
            sizes[k, 1] = self._next_size(i)
        stance = plan.stance[env_ids]
        on = ~by_root
        if on.any():
            going = env_ids[on]
            if self._goals:
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
        plans, random = self._plans, self._random[i]
        if always or random.uniform() < plans.change:
            self._state.length[i] = random.uniform(*plans.length)
            if self._sideways:
                self._state.width[i] = random.uniform(*plans.width)

    def _next_size(self, i: int) -> tuple[float, float]:
        """Returns length and width of the next step, m; redraws them with probability `change`."""
        self._redraw_size(i)
        return float(self._state.length[i]), float(self._state.width[i])

    def _head_for_goals(self, env_ids: np.ndarray, places: np.ndarray) -> None:
        """Sets planned headings from places (m, 2) to the goals, except within NEAR_GOAL."""
        displacement = self._state.goal[env_ids, :2] - places
        headings = np.arctan2(displacement[:, 1], displacement[:, 0])
        far = np.hypot(displacement[:, 0], displacement[:, 1]) > NEAR_GOAL
        self._plan.heading[env_ids[far]] = headings[far]

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
        places = places + quaternion.rotate_xy(steps, self._plan.heading[env_ids])
        self._plan.landing[env_ids, which, :2] = places
        self._plan.landing[env_ids, which, 2] = self._figure.heights(env_ids, places)
        return places
