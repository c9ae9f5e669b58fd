"""Actions that are plans of footsteps: their map to physical units, and their reflection."""

from __future__ import annotations

import numpy as np

from trl_suite.actuation.action_map import ActionMap
from trl_suite.bodies.blocks import Block, layout, reflected, signs
from trl_suite.bodies.spatial import LINK_POSE
from trl_suite.characters import Character
from trl_suite.policies.mirror import Mirror

INTERFACES = ('plan', 'frame')
# A plan: x and y of both landing places, m, and turn of the heading, rad. PLAN_OFFSET is the plan
# at action 0, in step lengths; PLAN_SCALE is the change per unit action, in m and rad.
PLAN_NAMES: tuple[str, ...] = ('first_x', 'first_y', 'second_x', 'second_y', 'turn')
PLAN_SIGNS = (1.0, -1.0, 1.0, -1.0, -1.0)  # of the mirrored plan
PLAN_OFFSET = np.array([1.0, 0.0, 2.0, 0.0, 0.0])
STEP_LENGTH = 0.5  # m
PLAN_SCALE = np.array([1.0, 1.0, 2.0, 2.0, np.pi])


def plan_action_map(step_length: float, joint_map: ActionMap | None = None) -> ActionMap:
    """Returns the map from actions to plans.

    Args:
      step_length: step length of the plan at action 0, m.
      joint_map: the map of actions to joint targets, with the interface 'frame': these actions
        follow those of the plan, and are passed on as they are.
    """
    names, offset, scale = PLAN_NAMES, step_length * PLAN_OFFSET, PLAN_SCALE
    if joint_map is not None:
        names = (*names, *joint_map.names)
        offset = np.concatenate([offset, np.zeros(len(joint_map))])
        scale = np.concatenate([scale, np.ones(len(joint_map))])
    return ActionMap(names, 'footstep plan', 'm (turn: rad)', offset, scale)


def planning_mirror(character: Character, blocks: tuple[Block, ...]) -> Mirror:
    """Returns the reflection of observations with these blocks, and of plans.

    Args:
      character: the character, which has pairs of right and left links.
      blocks: the observation blocks.
    """
    links = list(character.spec.links)
    feet = [links.index(name) for name in character.spec.end_effectors]
    right, left = layout(blocks)['pose'].start + 1 + LINK_POSE * np.array(feet)
    return Mirror(*reflected(blocks), *signs(PLAN_SIGNS), feet=(right, left))
