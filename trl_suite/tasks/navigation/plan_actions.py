"""Actions that are plans of footsteps: their map to physical units, and their reflection."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from trl_suite.actuation.action_map import ActionMap
from trl_suite.characters import Character
from trl_suite.policies.mirror import Mirror
from trl_suite.tasks.components import reflection as reflection3d

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


def planning_mirror(
    character: Character, blocks: dict[str, slice], signs: Mapping[str, Sequence[float]]
) -> Mirror:
    """Returns the reflection of observations and plans.

    Args:
      character: the character, which has pairs of right and left links.
      blocks: slices of the observation blocks: terrain, surface, pose, velocity and those of
        `signs`.
      signs: signs of the mirrored numbers of further blocks, by name.
    """
    parts = reflection3d.body(character)
    lines, _ = parts['terrain']
    ahead = np.ones(len(lines))
    parts['surface'] = np.append(lines, len(lines) + lines), np.append(ahead, -ahead)
    for name, block_signs in signs.items():
        parts[name] = np.arange(len(block_signs)), np.array(block_signs)
    index, sign = reflection3d.joined(blocks, parts)
    links = list(character.spec.links)
    feet = [links.index(name) for name in character.spec.end_effectors]
    right, left = blocks['pose'].start + 1 + len(reflection3d.POSE) * np.array(feet)
    return Mirror(index, sign, np.arange(len(PLAN_SIGNS)), np.array(PLAN_SIGNS), feet=(right, left))
