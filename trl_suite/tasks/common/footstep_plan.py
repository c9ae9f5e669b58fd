"""A plan of two footsteps and a heading: state, switches of stance, observation."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from trl_suite.bodies.blocks import Block, Noise, Reflection
from trl_suite.bodies.body import Measurement, ahead_and_left
from trl_suite.bodies.state import FLAG, REAL, WHOLE
from trl_suite.characters import CharacterSpec
from trl_suite.motion import FootstepLibrary
from trl_suite.motion.layout import VECTOR
from trl_suite.tasks.rewards import wrapped
from trl_suite.tasks.task import Marker
from trl_suite.util.compiled import compiled

RIGHT, LEFT = 0, 1  # of the end effectors, in link order
SIDE = np.array([-1.0, 1.0])  # sign of y of each foot
PLAN_SIZE = 13
TYPICAL_POSES = 31  # poses of a step; their mean is action 0 of position control
CONTACT = Block(
    'contact',
    2,
    '1',
    'whether the right and the left foot touch the ground',
    Noise((0.002, 0.01, 0.05), kind='flags'),
    Reflection(np.array([1, 0]), np.ones(2)),
    kept_meaning='whether the stance and the swing foot touch the ground',
)
# Of a reflected plan, the landing places of the two feet are exchanged. Mirrored observations keep the
# heading, the first landing place from the left foot, and the second from the right foot.
PLAN = Block(
    'plan',
    PLAN_SIZE,
    'm, rad',
    'x, y, and z above the ground under the root: of the first landing place from the right foot (0 in '
    'right stance) and from the left foot (0 in left stance), of the second from the right foot (0 in left '
    'stance) and from the left foot (0 in right stance); then the planned heading relative to the current '
    'one, positive to the left',
    Noise((0.003, 0.01, 0.02)),
    Reflection(
        np.append(np.arange(12).reshape(2, 2, 3)[:, ::-1].ravel(), 12),
        np.append(np.tile(VECTOR, 4), -1.0),
    ),
    kept=(12, 3, 4, 5, 6, 7, 8),
    kept_meaning='planned heading relative to the current one, positive to the swing side; then x, y, and z '
    'above the ground under the root: of the first landing place from the swing foot, of the second from '
    'the stance foot',
)
SOLE, SOLE_AHEAD = (
    (0.0885, 0.045, 0.004),
    0.052,
)  # m; half sizes of markers, distance from the ankle
# By the foot that lands.
SWING_COLOUR, STANCE_COLOUR = (0.95, 0.55, 0.1, 0.9), (0.15, 0.45, 0.9, 0.9)


class FootstepPlan(NamedTuple):
    """The plan of each simulation.

    Attributes:
      stance: stance foot, `RIGHT` or `LEFT`, (n,).
      landing: landing place of the swing foot, then of the stance foot, (n, 2, 3) m.
      heading: planned heading, (n,) rad.
      landing_error: horizontal distance of the last foot that landed from its landing place, (n,)
        m; 0 before the first landing.
      heading_error: magnitude of the heading error at that time, (n,) rad.
      landed: whether a foot landed in the last step, by the clock; it may still be in the air, (n,).
    """

    stance: np.ndarray = WHOLE
    landing: np.ndarray = np.zeros((2, 3))
    heading: np.ndarray = REAL
    landing_error: np.ndarray = REAL
    heading_error: np.ndarray = REAL
    landed: np.ndarray = FLAG


@compiled
def update_stance(i: int, phase: float, measurement: Measurement, plan: FootstepPlan) -> bool:
    """Switches the stance foot if the phase is in the other half, and writes the landing errors.

    Returns:
      Whether it switched.
    """
    stance = 1 if phase >= 0.5 else 0
    if stance == plan.stance[i]:
        return False
    plan.stance[i] = stance  # the foot that has just landed, by the clock
    x = measurement.feet[i, stance, 0] - plan.landing[i, 0, 0]
    y = measurement.feet[i, stance, 1] - plan.landing[i, 0, 1]
    plan.landing_error[i] = math.hypot(x, y)
    plan.heading_error[i] = abs(wrapped(plan.heading[i] - measurement.heading[i]))
    return True


@compiled
def observe_plan(
    i: int, columns: Any, measurement: Measurement, plan: FootstepPlan, observation: np.ndarray
) -> None:
    """Writes the blocks `CONTACT` and `PLAN`."""
    column = columns.plan
    for foot in range(2):
        observation[i, columns.contact + foot] = measurement.contact[i, foot]
    for k in range(PLAN_SIZE - 1):
        observation[i, column + k] = 0.0
    for which in range(2):
        foot = plan.stance[i] if which else 1 - plan.stance[i]
        ahead, left = ahead_and_left(
            i,
            plan.landing[i, which, 0] - measurement.feet[i, foot, 0],
            plan.landing[i, which, 1] - measurement.feet[i, foot, 1],
            measurement,
        )
        slot = column + 6 * which + 3 * foot
        observation[i, slot], observation[i, slot + 1] = ahead, left
        observation[i, slot + 2] = plan.landing[i, which, 2] - measurement.under[i]
    off = wrapped(plan.heading[i] - measurement.heading[i])
    observation[i, column + PLAN_SIZE - 1] = off


def plan_markers(env_id: int, root: np.ndarray, plan: FootstepPlan) -> list[Marker]:
    """Returns markers of the landing places, and of the planned heading at `root` (3,) m."""
    yaw = float(plan.heading[env_id])
    ahead = SOLE_AHEAD * np.array([np.cos(yaw), np.sin(yaw), 0.0])
    colours = SWING_COLOUR, STANCE_COLOUR
    soles = [
        Marker('box', place + ahead + (0, 0, SOLE[2]), SOLE, colour, yaw)
        for place, colour in zip(plan.landing[env_id], colours, strict=True)
    ]
    return [*soles, Marker('arrow', root, (0.012, 0.012, 0.5), SWING_COLOUR, yaw)]


def check_two_feet(spec: CharacterSpec) -> None:
    """Checks that a character has two feet, the right one first.

    Raises:
      ValueError: the character does not have two end effectors, or they are a left and a right link.
    """
    if len(spec.end_effectors) != 2:
        raise ValueError(f'character {spec.name!r} does not have two end effectors as feet')
    if spec.end_effectors[::-1] in spec.mirror:
        raise ValueError(
            f'character {spec.name!r} has {", ".join(spec.end_effectors)} as end effectors; expected the right '
            'foot first'
        )


# The single step from which episodes start.


def straight_step(steps: FootstepLibrary, length: float) -> int:
    """Returns the straight step of a library that can follow itself; of several, the nearest to `length`, m."""
    straight = np.abs(steps.labels[:, 2]) + np.abs(steps.labels - steps.previous).sum(1)
    return int(np.lexsort((np.abs(steps.labels[:, 0] - length), straight))[0])


def pose_of_step(
    steps: FootstepLibrary, step: int, phase: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns poses with x = y = 0, and rates, at phases (m,) of a step and its mirror image."""
    times = 2 * phase % 1 * steps.duration
    poses, rates = (part(step, times, phase >= 0.5) for part in (steps.pose, steps.velocity))
    poses[:, :2] = 0.0
    return poses, rates


def typical_poses(steps: FootstepLibrary, step: int) -> np.ndarray:
    """Returns poses of a step whose mean is action 0, (k, columns of a pose)."""
    return steps.pose(step, np.linspace(0, steps.duration, TYPICAL_POSES))
