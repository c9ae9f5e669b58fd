"""Hand-written policies for the high-level tasks: a baseline, and an example of footstep plans.

They walk towards the goal with limited turns, and around obstacles in the observed maps. With a
ball, they approach it from the side opposite to its goal.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from trl_suite.tasks.common.footstep_plan import SIDE
from trl_suite.tasks.navigation.hierarchical import PLAN_NAMES, HierarchicalNavigation
from trl_suite.terrain.spatial.windows import AHEAD, ASIDE, SAMPLES

# Step length, and that in turns or near the goal, in units of task.step_length.
LENGTH, SHORT = 1.3, 1.0
CAUTIOUS = 0.5  # step length if an obstacle is close, in the same units
ROOM = 2.0  # m; distance at which an obstacle is close
WIDTH = 0.15  # m; distance between the feet to the side
# The next two are divided by the step length:
ANKLE = 0.1  # m^2; distance of the foot that has just landed ahead of the root, times step length
TURN = 0.6  # rad m; largest turn of a plan, times step length
SHARP = 0.8  # rad; larger turns are made with short steps
NEAR = 1.0  # m; steps are short within this distance of the goal
CANDIDATES = np.linspace(-1.4, 1.4, 29)  # rad; candidate bearings, relative to that of the goal
LOOK = np.arange(0.4, 3.0, 0.3)  # m; distances at which the maps are sampled along a bearing
CLEARANCE = 0.45  # m; required free width to both sides
STEP_HEIGHT = 0.15  # m; larger height differences are obstacles
MOVING = 0.1  # m/s; faster ground is an obstacle
BEHIND_BALL, ALIGNED = 0.7, 0.5  # m; rad


def scripted(environments: Any) -> Callable[[np.ndarray], np.ndarray]:
    """Makes a policy for a high-level task.

    Args:
      environments: a `VectorEnvironment`, or an `Environment`.

    Returns:
      A function from observations, (n, k) with all blocks side by side, to actions (n, k).

    Raises:
      ValueError: the task is not a high-level one, or has the interface 'frame'.
    """
    task = environments.task
    if not isinstance(task, HierarchicalNavigation):
        raise ValueError(
            f'the task {type(task).__name__} has no scripted policy; goal_navigation and soccer have one'
        )
    if task.interface != 'plan':
        raise ValueError(
            f"the scripted policy plans footsteps: it needs the interface 'plan', not {task.interface!r}"
        )
    blocks = environments.blocks

    def policy(observation: np.ndarray) -> np.ndarray:
        parts = {name: observation[:, part] for name, part in blocks.items()}
        bearing, distance = towards_ball(parts) if task.ball else parts['goal'].T
        bearing, room = free_bearing(parts, bearing, distance)
        length = task.step_length * lengths(bearing, distance, room)
        size = len(task.action_map)
        plan = steps(bearing, length, task.plan.stance, task.step_length, size)
        return np.clip(task.action_map.action(plan), -1, 1)

    return policy


def towards_ball(parts: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Returns bearing and distance of the target position for dribbling.

    It is behind the ball as seen from the goal, or just beyond the ball once both are aligned.
    """
    ball = parts['ball'][:, 1, None] * direction(parts['ball'][:, 0])
    shot = direction(parts['goal'][:, 0])
    off = np.abs(np.arctan2(*_cross_dot(ball, shot)))
    aim = np.where((off < ALIGNED)[:, None], ball + 0.3 * shot, ball - BEHIND_BALL * shot)
    return np.arctan2(aim[:, 1], aim[:, 0]), np.sqrt((aim**2).sum(1))


def _cross_dot(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], (a * b).sum(1)


def direction(angle: np.ndarray) -> np.ndarray:
    """Unit vectors (n, 2) of angles (n,)."""
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def free_bearing(
    parts: dict[str, np.ndarray], bearing: np.ndarray, distance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the best bearing around obstacles in the observed maps.

    The cost of a bearing grows with its difference from that of the goal and with the proximity of
    obstacles along it.

    Returns:
      Bearings, (n,) rad, and distances of the first obstacle along them, (n,) m; inf if none.
    """
    n = len(bearing)
    blocked = np.zeros((n, SAMPLES, SAMPLES), bool)  # lines from the left, along them ahead
    if 'terrain' in parts:
        blocked |= np.abs(parts['terrain'].reshape(n, SAMPLES, SAMPLES)) > STEP_HEIGHT
    if 'surface' in parts:
        moving = np.abs(parts['surface'].reshape(n, 2, SAMPLES, SAMPLES)).max(1)
        blocked |= moving > MOVING
    free = ~blocked.any((1, 2))
    bearings = np.clip(CANDIDATES[None] + np.clip(bearing, -1.4, 1.4)[:, None], -np.pi, np.pi)
    along, cost, room = LOOK, np.zeros(bearings.shape), np.full(bearings.shape, np.inf)
    for aside in (-CLEARANCE, 0.0, CLEARANCE):
        x = along * np.cos(bearings)[..., None] - aside * np.sin(bearings)[..., None]
        y = along * np.sin(bearings)[..., None] + aside * np.cos(bearings)[..., None]
        column = np.round((x - AHEAD[0]) / (AHEAD[1] - AHEAD[0]) * (SAMPLES - 1)).astype(int)
        line = np.round((ASIDE - y) / (2 * ASIDE) * (SAMPLES - 1)).astype(int)
        column, line = np.clip(column, 0, SAMPLES - 1), np.clip(line, 0, SAMPLES - 1)
        hit = blocked[np.arange(n)[:, None, None], line, column]
        hit &= along < np.maximum(distance, along[0])[:, None, None]
        first = np.where(hit.any(2), along[hit.argmax(2)], np.inf)
        cost += 1.0 / first
        room = np.minimum(room, first)
    cost += 0.15 * np.abs(bearings - bearing[:, None])
    best = np.arange(n), cost.argmin(1)
    return np.where(free, bearing, bearings[best]), room[best]


def lengths(bearing: np.ndarray, distance: np.ndarray, room: np.ndarray) -> np.ndarray:
    """Returns step lengths (n,) in units of task.step_length.

    Args:
      bearing: bearings, (n,) rad.
      distance: distances of the goal, (n,) m.
      room: distances of the first obstacle, (n,) m.
    """
    short = (distance < NEAR) | (np.abs(bearing) > SHARP)
    return np.where(room < ROOM, CAUTIOUS, np.where(short, SHORT, LENGTH))


def steps(
    bearing: np.ndarray,
    length: np.ndarray,
    stance: np.ndarray,
    step_length: float,
    size: int = len(PLAN_NAMES),
) -> np.ndarray:
    """Returns plans (n, size) in physical units: steps of a length (n,) m along bearings (n,) rad.

    Numbers after the plan are 0, which selects the first of several footstep controllers.
    """
    turn = np.clip(bearing, -TURN / step_length, TURN / step_length)
    side = SIDE[1 - stance] * WIDTH / 2  # of the foot that swings
    forward, left = direction(turn), direction(turn + np.pi / 2)
    ankle = ANKLE / step_length
    plan = np.zeros((len(bearing), size))
    plan[:, :2] = (ankle + length)[:, None] * forward + side[:, None] * left
    plan[:, 2:4] = (ankle + 2 * length)[:, None] * forward - side[:, None] * left
    plan[:, 4] = turn
    return plan
