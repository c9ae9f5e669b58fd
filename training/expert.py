"""Experts that policies imitate: for footstep plans, and for joint targets.

While a policy observes coarse maps of the ground ahead, the experts use privileged information:
heights every 0.125 m on all sides, and velocities of moving boxes. They find a short path to the goal that keeps
a distance from all ground that is not level, and plan footsteps along it (learning by cheating, Chen
et al. 2019, arXiv:1912.12294). They are no baselines.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse import csgraph

from trl_suite import policies
from trl_suite.motion import quaternion
from trl_suite.tasks.common.footstep_plan import PLAN_SIZE
from trl_suite.tasks.navigation import scripted
from trl_suite.tasks.navigation.direct import DirectNavigation
from trl_suite.tasks.navigation.hierarchical import (
    CONTROLLER,
    STEP_LENGTH,
    HierarchicalNavigation,
    plan_action_map,
)
from trl_suite.tasks.navigation.scripted import CAUTIOUS
from trl_suite.tasks.rewards import wrapped
from trl_suite.vector import VectorEnvironment

REACH = 5.0  # m; half the map's side
FINE, COARSE = 0.125, 2  # height spacing, m; node spacing, heights
LEVEL = 0.12  # m; largest height difference to the goal of level ground
DISTANCE = 1.2  # m; distance from obstacles below which a path costs more
ROOM = 0.4  # m; distance from obstacles below which a walker does not fit
PRICE, WALL = 8.0, 60.0  # largest extra cost per m near an obstacle; extra cost per m without room
DETOUR = 1.02  # a straight line may cost this many times as much as the path that it replaces
AHEAD = 4.0  # step lengths; distance of the next point on a trail
# The same where every goal on the trail is followed by the next one, and the share of the goal's
# distance from the centre line by which the point is shifted.
PAST, SHIFT = 3.0, 0.5
PACE = 1.0  # m/s; assumed walking speed among moving boxes
BEND, CLOSE = 0.35, 0.4  # rad, m; small steps for sharper turns or closer obstacles
DRIBBLING = 'PD_Biped3D_HLC_Soccer-v0'
LOOKS = 33  # points on a straight line at which the cost is sampled
BEYOND = 1.5  # assumed cost per m outside the map

Planner = Callable[[np.ndarray, np.ndarray], np.ndarray]

wrap = wrapped.__wrapped__  # compiled, it takes no arrays


class Map:
    """A square grid of nodes around the walker, with edges between neighbours."""

    def __init__(self) -> None:
        axis = np.arange(-REACH, REACH + FINE / 2, FINE)
        self.fine = np.stack(np.meshgrid(axis, axis, indexing='ij'), -1)  # (k, k, 2) m
        self.places = self.fine[::COARSE, ::COARSE].reshape(-1, 2)
        side = len(axis[::COARSE])
        self.shape = side, side
        number = np.arange(side * side).reshape(side, side)
        pairs = []
        for i, j in ((1, 0), (0, 1), (1, 1), (1, -1)):
            a = number[: side - i, max(0, -j) : side - max(0, j)]
            b = number[i:, max(0, j) : side + min(0, j)]
            pairs += [(a.ravel(), b.ravel())]
        self.a, self.b = (np.concatenate(part) for part in zip(*pairs, strict=True))
        self.length = np.linalg.norm(self.places[self.a] - self.places[self.b], axis=1)
        self.middle = number[side // 2, side // 2]
        self.rim = np.unique(np.concatenate([number[0], number[-1], number[:, 0], number[:, -1]]))

    def aim(self, cost: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """Returns the farthest node of the cheapest path that a straight line can reach, (2,) m.

        Grid paths turn by multiples of 45 degrees; a straight line to a far node avoids these
        turns.

        Args:
          cost: cost of the nodes, per m.
          goal: goal of the path, relative to the centre, (2,) m; if it is outside the map, the
            cost of the last part is estimated.
        """
        n = len(self.places)
        if np.abs(goal).max() < REACH:
            into = np.array([np.linalg.norm(self.places - goal, axis=1).argmin()])
        else:
            into = self.rim
        last = BEYOND * np.linalg.norm(self.places[into] - goal, axis=1) + 1e-3
        price = 0.5 * (cost[self.a] + cost[self.b]) * self.length
        ends = np.append(self.a, into), np.append(self.b, np.full(len(into), n))
        graph = sparse.coo_array((np.append(price, last), ends), shape=(n + 1, n + 1))
        left, before = csgraph.dijkstra(
            graph.tocsr(), directed=False, indices=n, return_predecessors=True
        )
        at, way = self.middle, []
        while at != n:
            at = before[at]
            way.append(at)
        there = np.concatenate([self.places, [goal]])[way]
        share = np.linspace(0, 1, LOOKS)
        seen = (there[:, None] * share[:, None] + REACH) / (COARSE * FINE)
        met = ndimage.map_coordinates(
            cost.reshape(self.shape), np.moveaxis(seen, -1, 0), order=1, cval=BEYOND
        )
        straight = met.mean(1) * np.linalg.norm(there, axis=1)
        best = straight <= DETOUR * (left[self.middle] - left[way])
        return there[np.flatnonzero(best)[-1] if best.any() else 0]


def on_trail(
    trail: Any, place: np.ndarray, goal: np.ndarray, ahead: float, *, beyond: bool = False
) -> np.ndarray:
    """Returns the point of a trail `ahead` m closer to a goal, relative to `place`, (2,) m.

    The point is on the centre line.
    If the goal is nearer than `ahead`, the point is the one nearest to the goal. With `beyond` it is
    always `ahead` m further along the trail, and is shifted sideways with a goal that is still ahead.
    """
    length = np.linalg.norm(trail.end - trail.start, axis=1)
    way = (trail.end - trail.start) / length[:, None]
    begin = np.append(0.0, np.cumsum(length))

    def nearest(point: np.ndarray) -> float:
        along = np.clip(((point - trail.start) * way).sum(1), 0, length)
        gaps = np.linalg.norm(trail.start + along[:, None] * way - point, axis=1)
        return begin[gaps.argmin()] + along[gaps.argmin()]

    here, there = nearest(place), nearest(goal)
    on = here + (ahead if beyond else np.clip(there - here, -ahead, ahead))
    corners = np.concatenate([trail.start, trail.end[-1:]])

    def centre(along: float) -> np.ndarray:
        return np.array([np.interp(along, begin, corner) for corner in corners.T])

    if beyond and there > here:
        return centre(on) - place + SHIFT * (goal - centre(there))
    return centre(on) - place


def planner(task: Any, step_length: float, action_map: Any, *, beyond: bool = False) -> Planner:
    """Makes an expert that plans footsteps for a task with goals.

    Args:
      task: a task of a 3D walker with goals, on a `SpatialArena`.
      step_length: step length of a plan, m.
      action_map: map of plans to actions.
      beyond: whether to walk past the next goal on a trail, since the one after it is farther on.

    Returns:
      A function from simulations (k,) and their stance feet (k,) to actions (k, 5).
    """
    map_, arena = Map(), task.arena
    moves = arena.surroundings.capacity.movers > 0

    def level(env_id: int, place: np.ndarray) -> np.ndarray:
        """Returns the distance of every node from ground that is not level, m."""
        x, y = np.moveaxis(place + map_.fine, -1, 0).reshape(2, 1, -1)
        height = arena.height(x, y, np.array([env_id])).reshape(map_.fine.shape[:2])
        free = np.abs(height - task.goal[env_id, 2]) < LEVEL
        if free.all():
            return np.full(len(map_.places), REACH)
        return FINE * ndimage.distance_transform_edt(free)[::COARSE, ::COARSE].ravel()

    def apart(env_id: int, place: np.ndarray) -> np.ndarray:
        """Returns the distance of every node from moving boxes at the time of arrival there, m."""
        s = arena.surroundings.arrays
        speed = s.mover_direction[env_id] * s.mover_speed[env_id]
        velocity = speed[:, None] * s.mover_axis[env_id]
        centre = arena.surroundings.centres()[env_id] - place
        near = np.abs(centre).max(1) < 2 * REACH
        seconds = np.linalg.norm(map_.places, axis=1) / PACE
        then = centre[near] + seconds[:, None, None] * velocity[near]
        gap = np.abs(map_.places[:, None] - then) - s.mover_half_size[env_id][near]
        return np.linalg.norm(np.maximum(gap, 0), axis=2).min(1, initial=REACH)

    def plan(env_ids: np.ndarray, stance: np.ndarray) -> np.ndarray:
        found = task.body.measure()
        root, heading = found.root[env_ids, :2], found.heading[env_ids]
        off, length = np.empty_like(root), np.ones(len(root))
        for k, (env_id, place) in enumerate(zip(env_ids.tolist(), root, strict=True)):
            goal, trail = task.goal[env_id, :2], arena.grounds[env_id].layout.trail
            if trail is not None:
                ahead = step_length * (PAST if beyond else AHEAD)
                off[k] = on_trail(trail, place, goal, ahead, beyond=beyond)
                continue
            free = apart(env_id, place) if moves else level(env_id, place)
            cost = 1 + PRICE * np.maximum(0, 1 - free / DISTANCE) ** 2 + WALL * (free <= ROOM)
            off[k] = map_.aim(cost, goal - place)
            bend = wrap(np.arctan2(off[k, 1], off[k, 0]) - heading[k])
            careful = abs(bend) > BEND or free[map_.middle] < CLOSE
            length[k] = CAUTIOUS if careful else 1.0
        way = wrap(np.arctan2(off[:, 1], off[:, 0]) - heading)
        footsteps = scripted.steps(way, step_length * length, stance, step_length, len(action_map))
        return np.clip(action_map.action(footsteps), -1, 1)

    return plan


def expert(environments: VectorEnvironment) -> Callable[[np.ndarray], np.ndarray]:
    """Makes an expert policy, like the functions in `named_policies.BASELINES`.

    Raises:
      ValueError: the actions of the task are not footstep plans, or the task has a ball.
    """
    task = environments.task
    if not isinstance(task, HierarchicalNavigation) or task.ball or task.interface != 'plan':
        raise ValueError(
            f'the expert does not support the task {type(task).__name__}; expected: a high-level task '
            "with the interface 'plan' and without a ball"
        )
    plan = planner(task, task.step_length, task.action_map)
    return lambda observation: plan(task.world.all_ids, task.plan.stance)


def joint_expert(environments: VectorEnvironment) -> Callable[[np.ndarray], np.ndarray]:
    """Makes an expert for tasks without hierarchy: planned footsteps, and the controller that tracks them.

    At every switch of stance, footsteps are planned by the expert with a map, or with a ball by the
    shipped policy for dribbling; the shipped footstep controller then gives the joint targets. A
    policy without hierarchy that imitates it has one network and no plan: what is a fixed place in
    the world for its teacher, it has to infer from pose, phase, map and goal. The expert has a state,
    the current plans: it expects every observation of an episode in turn.

    Raises:
      ValueError: the task is not navigation without hierarchy.
    """
    task, blocks, n = environments.task, environments.blocks, environments.num_envs
    if not isinstance(task, DirectNavigation):
        raise ValueError(
            f'the joint expert does not support the task {type(task).__name__}; expected: navigation '
            'without hierarchy'
        )
    controller = policies.reference(CONTROLLER)
    with contextlib.closing(VectorEnvironment(CONTROLLER, 1)) as tracking:
        targets, observed = tracking.task.action_map, tracking.blocks
    footsteps = plan_action_map(STEP_LENGTH)
    dribble = policies.reference(DRIBBLING) if task.ball else None
    plan = planner(task, STEP_LENGTH, footsteps, beyond=True)
    everyone = np.arange(n)
    stance = np.full(n, -1)
    landing = np.zeros((n, 2, 3))  # of the swing foot, then of the stance foot
    heading = np.zeros(n)

    def plan_again(observation: np.ndarray, env_ids: np.ndarray) -> None:
        found = task.body.measurement
        if dribble is None:
            action = plan(env_ids, stance[env_ids])
        else:
            seen = [observation[env_ids, blocks[name]] for name in blocks if name != 'phase']
            action = dribble(np.concatenate(seen, axis=1))
        planned = footsteps.control(action)
        root, yaw = found.root[env_ids], found.heading[env_ids]
        for which in range(2):
            place = root[:, :2] + quaternion.rotate_xy(planned[:, 2 * which : 2 * which + 2], yaw)
            landing[env_ids, which, :2] = place
            height = task.arena.height(place[:, :1], place[:, 1:], env_ids)
            landing[env_ids, which, 2] = height[:, 0]
        heading[env_ids] = yaw + planned[:, 4]

    def policy(observation: np.ndarray) -> np.ndarray:
        found = task.body.measure()
        before = stance.copy()
        stance[:] = task.phase >= 0.5
        begun = (stance != before) | (task.clock.steps == 0)
        if begun.any():
            plan_again(observation, np.flatnonzero(begun))
        parts = {name: observation[:, part] for name, part in blocks.items()}
        parts |= {'contact': found.contact, 'plan': np.zeros((n, PLAN_SIZE))}
        for which in range(2):
            foot = stance if which else 1 - stance
            away = landing[:, which, :2] - found.feet[everyone, foot, :2]
            slot = 6 * which + 3 * foot
            ahead, left = quaternion.rotate_xy(away, -found.heading).T
            parts['plan'][everyone, slot], parts['plan'][everyone, slot + 1] = ahead, left
            parts['plan'][everyone, slot + 2] = landing[:, which, 2] - found.under
        parts['plan'][:, -1] = wrap(heading - found.heading)
        action = controller(np.concatenate([parts[name] for name in observed], axis=1))
        return np.clip(task.action_map.action(targets.control(action)), -1, 1)

    return policy
