"""How what walkers in three dimensions observe and do looks in a mirror, the x-z plane.

A reflection of k columns is an index and a sign, both (k,): `x[index] * sign`; see
`trl_suite.policies.mirror`.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from trl_suite.actuation.action_map import ActionMap, AngleAxisMap
from trl_suite.characters import Character
from trl_suite.policies.mirror import blocks, exchanged
from trl_suite.terrain.spatial.surroundings import SAMPLES

Reflection = tuple[np.ndarray, np.ndarray]
# Signs of a vector, of a quaternion, and of what turns about the axes of a vector.
VECTOR, QUATERNION, SPIN = (1.0, -1.0, 1.0), (1.0, -1.0, 1.0, -1.0), (-1.0, 1.0, -1.0)
ANGLE_AXIS = (1.0, -1.0, -1.0, 1.0)  # angle; forward, up, right
POSE = (*VECTOR, *QUATERNION)  # of what the block of the pose has for each link


def body(character: Character) -> dict[str, Reflection]:
    """The blocks of the body and of the map around it."""
    spec = character.spec
    names = list(spec.links)
    pairs = [(names.index(a), names.index(b)) for a, b in spec.mirror]
    links = exchanged(len(names), pairs)
    grid = np.arange(SAMPLES**2).reshape(SAMPLES, SAMPLES)[::-1]  # lines from the left
    index, sign = blocks(links, POSE)
    return {
        'terrain': (grid.ravel(), np.ones(grid.size)),
        'pose': (np.append(0, 1 + index), np.append(1.0, sign)),
        'velocity': blocks(links, (*VECTOR, *SPIN)),
    }


def phase(bins: int) -> Reflection:
    """The block of a phase and of the `bins` that tell which part of the cycle it is in."""
    return np.append(0, 1 + np.roll(np.arange(bins), bins // 2)), np.ones(1 + bins)


def actions(character: Character, action_map: ActionMap) -> Reflection:
    """What joints are told."""
    spec = character.spec
    joints = list(spec.joints)
    ball = ANGLE_AXIS if isinstance(action_map, AngleAxisMap) else SPIN
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
    return index, np.array(signs)


def joined(layout: Mapping[str, slice], parts: Mapping[str, Reflection]) -> Reflection:
    """An observation, from its layout and the reflection of each of its blocks."""
    index = np.concatenate([part.start + parts[name][0] for name, part in layout.items()])
    return index, np.concatenate([parts[name][1] for name in layout])
