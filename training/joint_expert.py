"""An expert for tasks without hierarchy: planned footsteps, and the controller that tracks them.

At every switch of stance, footsteps are planned by the expert with a map (`expert.py`), or with a
ball by the shipped policy for dribbling; the shipped footstep controller then gives the joint
targets. A policy without hierarchy that imitates it has one network and no plan: what is a fixed
place in the world for its teacher, it has to infer from pose, phase, map and goal.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from expert import planner, wrap

from trl_suite import policies
from trl_suite.motion import quaternion
from trl_suite.tasks.common.footstep_plan import PLAN_SIZE
from trl_suite.tasks.navigation.direct import DirectNavigation
from trl_suite.tasks.navigation.hierarchical_rules import CONTROLLER
from trl_suite.tasks.navigation.plan_actions import STEP_LENGTH, plan_action_map
from trl_suite.vector import VectorEnvironment

DRIBBLING = 'PD_Biped3D_HLC_Soccer-v0'


def joint_expert(environments: VectorEnvironment) -> Callable[[np.ndarray], np.ndarray]:
    """Makes an expert policy, like the functions in `evaluation.BASELINES`.

    It has a state, the current plans: it expects every observation of an episode in turn.

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
    tracking = VectorEnvironment(CONTROLLER, 1)
    targets, observed = tracking.task.action_map, tracking.blocks
    tracking.close()
    footsteps = plan_action_map(STEP_LENGTH)
    dribble = policies.reference(DRIBBLING) if task.ball else None
    plan = planner(task, STEP_LENGTH, footsteps, beyond=True)
    everyone = np.arange(n)
    stance = np.full(n, -1)
    landing = np.zeros((n, 2, 3))  # of the swing foot, then of the stance foot
    heading = np.zeros(n)

    def plan_again(observation: np.ndarray, env_ids: np.ndarray) -> None:
        found = task.figure.measurement
        if dribble is None:
            action = plan(env_ids, stance[env_ids])
        else:
            seen = [observation[env_ids, blocks[name]] for name in blocks if name != 'phase']
            action = np.clip(dribble(np.concatenate(seen, axis=1)), -1, 1)
        planned = footsteps.action_offset + footsteps.action_scale * action
        root, yaw = found.root[env_ids], found.heading[env_ids]
        for which in range(2):
            place = root[:, :2] + quaternion.rotate_xy(planned[:, 2 * which : 2 * which + 2], yaw)
            landing[env_ids, which, :2] = place
            height = task.arena.height(place[:, :1], place[:, 1:], env_ids)
            landing[env_ids, which, 2] = height[:, 0]
        heading[env_ids] = yaw + planned[:, 4]

    def policy(observation: np.ndarray) -> np.ndarray:
        found = task.figure.measure()
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
        angles = targets.action_offset + targets.action_scale * np.clip(action, -1, 1)
        own = task.action_map
        return np.clip((angles - own.action_offset) / own.action_scale, -1, 1)

    return policy
