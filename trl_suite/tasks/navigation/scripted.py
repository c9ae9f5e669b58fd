"""Hand-written policies for the high-level tasks: a baseline, and an example of what a plan is.

They step towards the goal, turn by little at a time, and go around what the map shows; towards a
ball they go in such a way that it is between them and the goal.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from trl_suite.tasks.components.footstep_plan import SIDE
from trl_suite.tasks.composed import Composed
from trl_suite.tasks.navigation.hierarchical import HierarchicalNavigation
from trl_suite.tasks.navigation.hierarchical_rules import PLAN_NAMES
from trl_suite.terrain.spatial.windows import AHEAD, ASIDE, SAMPLES

LENGTH, SHORT = 1.3, 1.0  # of a step, and of one in a turn or near the goal; in step lengths
CAUTIOUS = 0.5  # the same of one with something close ahead
ROOM = 2.0  # m; what is close
WIDTH = 0.15  # m; between the feet
# The longer the steps the smaller these are: times the step length,
ANKLE = 0.1  # m m; how far ahead of the root's middle the foot stands that has just landed
TURN = 0.6  # rad m; the most that a plan turns
SHARP = 0.8  # rad; turns from here on are made with short steps
NEAR = 1.0  # m; where steps become short
CANDIDATES = np.linspace(-1.4, 1.4, 29)  # rad; ways that are looked along
LOOK = np.arange(0.4, 3.0, 0.3)  # m; how far
CLEARANCE = 0.45  # m; to both sides of a way
STEP_HEIGHT = 0.15  # m; what is taken for level
MOVING = 0.1  # m/s; what is taken for standing
BEHIND_BALL, ALIGNED = 0.7, 0.5  # m, rad


def scripted(environments: Any) -> Callable[[np.ndarray], np.ndarray]:
    """Makes a policy for a high-level task.

    Args:
      environments: a `VectorEnvironment`, or an `Environment`.

    Returns:
      A function from observations, (n, k) with all blocks side by side, to actions (n, 5).

    Raises:
      ValueError: another task.
    """
    task = environments.task
    if isinstance(task, Composed):
        task = task.task
    if not isinstance(task, HierarchicalNavigation):
        raise ValueError(
            f'the task {type(task).__name__} has no scripted policy; goal navigation and soccer have'
        )
    if task.interface != 'plan':
        raise ValueError(
            f"the scripted policy plans footsteps: it needs the interface 'plan', not {task.interface!r}"
        )
    blocks = environments.blocks

    def policy(observation: np.ndarray) -> np.ndarray:
        parts = {name: observation[:, part] for name, part in blocks.items()}
        bearing, distance = towards_ball(parts) if task.ball else parts['goal'].T
        way, room = free_way(parts, bearing, distance)
        length = task.step_length * lengths(way, distance, room)
        plan = steps(way, length, task.stance, task.step_length)
        return np.clip(task.action_map.action(plan), -1, 1)

    return policy


def towards_ball(parts: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Bearing and distance of the place from which a ball is best walked into."""
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


def free_way(
    parts: dict[str, np.ndarray], bearing: np.ndarray, distance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The bearing nearest to that of the goal on which the maps show nothing, (n,) rad; or next to
    nothing: then also how far away that is, (n,) m.
    """
    n = len(bearing)
    blocked = np.zeros((n, SAMPLES, SAMPLES), bool)  # lines from the left, along them ahead
    if 'terrain' in parts:
        blocked |= np.abs(parts['terrain'].reshape(n, SAMPLES, SAMPLES)) > STEP_HEIGHT
    if 'surface' in parts:
        moving = np.abs(parts['surface'].reshape(n, 2, SAMPLES, SAMPLES)).max(1)
        blocked |= moving > MOVING
    if not blocked.any():
        return bearing, np.full(n, np.inf)
    ways = np.clip(CANDIDATES[None] + np.clip(bearing, -1.4, 1.4)[:, None], -np.pi, np.pi)
    along, cost, room = LOOK, np.zeros(ways.shape), np.full(ways.shape, np.inf)
    for aside in (-CLEARANCE, 0.0, CLEARANCE):
        x = along * np.cos(ways)[..., None] - aside * np.sin(ways)[..., None]
        y = along * np.sin(ways)[..., None] + aside * np.cos(ways)[..., None]
        column = np.round((x - AHEAD[0]) / (AHEAD[1] - AHEAD[0]) * (SAMPLES - 1)).astype(int)
        line = np.round((ASIDE - y) / (2 * ASIDE) * (SAMPLES - 1)).astype(int)
        column, line = np.clip(column, 0, SAMPLES - 1), np.clip(line, 0, SAMPLES - 1)
        hit = blocked[np.arange(n)[:, None, None], line, column]
        hit &= along < np.maximum(distance, along[0])[:, None, None]
        first = np.where(hit.any(2), along[hit.argmax(2)], np.inf)
        cost += 1.0 / first
        room = np.minimum(room, first)
    cost += 0.15 * np.abs(ways - bearing[:, None])
    best = np.arange(n), cost.argmin(1)
    return ways[best], room[best]


def lengths(way: np.ndarray, distance: np.ndarray, room: np.ndarray) -> np.ndarray:
    """Lengths (n,) of steps along a bearing (n,), so far and with so much room; in step lengths."""
    short = (distance < NEAR) | (np.abs(way) > SHARP)
    return np.where(room < ROOM, CAUTIOUS, np.where(short, SHORT, LENGTH))


def steps(
    way: np.ndarray, length: np.ndarray, stance: np.ndarray, step_length: float
) -> np.ndarray:
    """Plans (n, 5) in physical units: steps along bearings (n,) rad, so long (n,) m."""
    turn = np.clip(way, -TURN / step_length, TURN / step_length)
    side = SIDE[1 - stance] * WIDTH / 2  # of the foot that swings
    forward, left = direction(turn), direction(turn + np.pi / 2)
    ankle = ANKLE / step_length
    plan = np.zeros((len(way), len(PLAN_NAMES)))
    plan[:, :2] = (ankle + length)[:, None] * forward + side[:, None] * left
    plan[:, 2:4] = (ankle + 2 * length)[:, None] * forward - side[:, None] * left
    plan[:, 4] = turn
    return plan
