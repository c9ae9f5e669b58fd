"""Reflection of the actions of 3D walkers in the x-z plane."""

from __future__ import annotations

import numpy as np

from trl_suite.actuation.action_map import ActionMap
from trl_suite.bodies.blocks import SPIN, Reflection
from trl_suite.characters import Character

ANGLE_AXIS = (1.0, -1.0, -1.0, 1.0)  # angle; forward, up, right


def action_reflection(character: Character, action_map: ActionMap) -> Reflection:
    """Returns the reflection of actions, i.e. joint targets or torques."""
    spec = character.spec
    joints = list(spec.joints)
    ball = ANGLE_AXIS if action_map.has_axes else SPIN
    starts: list[int] = []
    signs: list[float] = []
    for spherical in character.spherical.tolist():
        starts.append(len(signs))
        signs += ball if spherical else (1.0,)
    index = np.arange(len(signs))
    for a, b in spec.mirror:
        i, j = (starts[joints.index(name)] for name in (a, b))
        width = len(ball) if character.spherical[joints.index(a)] else 1
        index[i : i + width] = np.arange(j, j + width)
        index[j : j + width] = np.arange(i, i + width)
    return Reflection(index, np.array(signs))
