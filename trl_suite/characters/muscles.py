"""Musculotendon units of three characters, as rows of data.

Source: the hand-set muscle lists of the original's character files (its muscle environments load
these, not the lists optimised for one motion). Two names that the original uses twice (the last
tail units of dog and raptor) are told apart here by the joint that they span.

Muscle(name, optimal fibre length m, tendon slack length m, peak force N, pennation factor, arms);
Arm(joint, moment arm m, rest angle rad, angle of the largest arm rad or None for a constant arm).
The sign of an arm is the sign of the torque that the muscle's pull makes.
"""

from __future__ import annotations

from typing import NamedTuple


class Arm(NamedTuple):
    """How a muscle spans one joint."""

    joint: str
    arm: float
    rest: float
    peak: float | None = None


class Muscle(NamedTuple):
    """One musculotendon unit."""

    name: str
    l_opt: float
    l_slack: float
    f_max: float
    pennation: float
    arms: tuple[Arm, ...]


def _left(muscle: Muscle) -> Muscle:
    arms = tuple(arm._replace(joint=arm.joint.replace('right_', 'left_')) for arm in muscle.arms)
    return muscle._replace(name=muscle.name.replace('right_', 'left_'), arms=arms)


# fmt: off
_BIPED_LEG = (
    Muscle('right_GLU', 0.103, 0.122, 1500, 0.5, (Arm('right_hip', -0.094, 0.5216),)),
    Muscle('right_HFL', 0.103, 0.094, 2000, 0.5, (Arm('right_hip', 0.094, 0),)),
    Muscle('right_VAS', 0.075, 0.215, 6000, 0.7, (Arm('right_knee', 0.056, -0.9616, -0.2616),)),
    Muscle('right_SOL', 0.037, 0.243, 4000, 0.5, (Arm('right_ankle', -0.047, 0.1708, -0.3492),)),
    Muscle('right_TA', 0.056, 0.225, 800, 0.7, (Arm('right_ankle', 0.037, -0.3492, 0.1708),)),
    Muscle('right_HAM', 0.094, 0.29, 3000, 0.7, (Arm('right_hip', -0.075, 0.4316), Arm('right_knee', -0.047, 0, 0),)),
    Muscle('right_RF', 0.075, 0.281, 1000, 0.7, (Arm('right_hip', 0.094, 0), Arm('right_knee', 0.056, -0.9616, -0.2616),)),
    Muscle('right_GAS', 0.047, 0.374, 1500, 0.7, (Arm('right_knee', -0.047, -0.2616, -0.7016), Arm('right_ankle', -0.047, 0.1708, -0.3492),)),
)

BIPED2D: tuple[Muscle, ...] = (*_BIPED_LEG, *map(_left, _BIPED_LEG))

DOG: tuple[Muscle, ...] = (
    Muscle('spine0_top', 0.04, 0.03, 3000, 0.7, (Arm('spine0', 0.03, 0, 0.1),)),
    Muscle('spine0_bot', 0.04, 0.03, 3000, 0.7, (Arm('spine0', -0.03, 0, -0.1),)),
    Muscle('spine1_top', 0.04, 0.03, 3000, 0.7, (Arm('spine1', 0.03, 0, 0.1),)),
    Muscle('spine1_bot', 0.04, 0.03, 3000, 0.7, (Arm('spine1', -0.03, 0, -0.1),)),
    Muscle('spine2_top', 0.04, 0.03, 3000, 0.7, (Arm('spine2', 0.03, 0, 0.1),)),
    Muscle('spine2_bot', 0.04, 0.03, 3000, 0.7, (Arm('spine2', -0.03, 0, -0.1),)),
    Muscle('spine3_top', 0.04, 0.03, 3000, 0.7, (Arm('spine3', 0.03, 0, 0.1),)),
    Muscle('spine3_bot', 0.04, 0.03, 3000, 0.7, (Arm('spine3', -0.03, 0, -0.1),)),
    Muscle('torso_top', 0.04, 0.03, 3000, 0.7, (Arm('torso', 0.03, 0, 0.1),)),
    Muscle('torso_bot', 0.04, 0.03, 3000, 0.7, (Arm('torso', -0.03, 0, -0.1),)),
    Muscle('neck0_top', 0.05, 0.04, 2000, 0.7, (Arm('neck0', 0.03, 0.68507, 0.78507),)),
    Muscle('neck0_bot', 0.05, 0.04, 2000, 0.7, (Arm('neck0', -0.03, 0.68507, 0.58507),)),
    Muscle('neck1_top', 0.05, 0.04, 2000, 0.7, (Arm('neck1', 0.03, 0.2, 0.3),)),
    Muscle('neck1_bot', 0.05, 0.04, 2000, 0.7, (Arm('neck1', -0.03, 0.2, 0.1),)),
    Muscle('head_top', 0.05, 0.04, 2000, 0.7, (Arm('head', 0.03, 0.20456, 0.30456),)),
    Muscle('head_bot', 0.05, 0.04, 2000, 0.7, (Arm('head', -0.03, 0.20456, 0.10456),)),
    Muscle('tail0_top', 0.02, 0.06, 250, 0.7, (Arm('tail0', -0.03, 0, -0.1),)),
    Muscle('tail0_bot', 0.02, 0.06, 250, 0.7, (Arm('tail0', 0.03, 0, 0.1),)),
    Muscle('tail1_top', 0.01, 0.07, 250, 0.7, (Arm('tail1', -0.02, 0, -0.1),)),
    Muscle('tail1_bot', 0.01, 0.07, 250, 0.7, (Arm('tail1', 0.02, 0, 0.1),)),
    Muscle('tail2_top', 0.01, 0.07, 250, 0.7, (Arm('tail2', -0.02, 0, -0.1),)),
    Muscle('tail2_bot', 0.01, 0.07, 250, 0.7, (Arm('tail2', 0.02, 0, 0.1),)),
    Muscle('tail3_top', 0.01, 0.07, 250, 0.7, (Arm('tail3', -0.02, 0, -0.1),)),
    Muscle('tail3_bot', 0.01, 0.07, 250, 0.7, (Arm('tail3', 0.02, 0, 0.1),)),
    Muscle('front_DEL', 0.08, 0.02, 3000, 0.5, (Arm('shoulder', -0.035, 0.7),)),
    Muscle('front_SUP', 0.08, 0.02, 3000, 0.5, (Arm('shoulder', 0.035, -0.7),)),
    Muscle('front_ANC', 0.07, 0.1, 6000, 0.7, (Arm('elbow', -0.03, 1.5616, 1.3616),)),
    Muscle('front_BRC', 0.1, 0.07, 3000, 0.7, (Arm('elbow', 0.03, 0.2616, 0.9616),)),
    Muscle('front_SOL', 0.08, 0.04, 5000, 0.5, (Arm('wrist', -0.056, 1.2, 0.9),)),
    Muscle('front_TA', 0.075, 0.05, 1500, 0.5, (Arm('wrist', 0.056, 0.9, 1.1),)),
    Muscle('front_BCP', 0.1, 0.25, 3000, 0.7, (Arm('shoulder', 0.06, -0.75), Arm('elbow', 0.04, 0.9, 1.3),)),
    Muscle('front_TCP', 0.1, 0.275, 2000, 0.7, (Arm('shoulder', -0.074, 0.7), Arm('elbow', -0.056, 0.9616, 0.2616),)),
    Muscle('front_toe0', 0.05, 0.04, 1000, 0.7, (Arm('finger', -0.037, 0.0708, -0.4492),)),
    Muscle('front_toe1', 0.05, 0.04, 1000, 0.7, (Arm('finger', 0.037, -0.4492, 0.0708),)),
    Muscle('back_GLU', 0.07, 0.03, 3000, 0.5, (Arm('hip', -0.035, 1),)),
    Muscle('back_HFL', 0.07, 0.02, 3000, 0.5, (Arm('hip', 0.035, -0.25),)),
    Muscle('back_VAS', 0.06, 0.1, 6000, 0.7, (Arm('knee', 0.04, -1.5616, -1.3616),)),
    Muscle('back_SOL', 0.08, 0.04, 5000, 0.5, (Arm('ankle', -0.056, 1.2, 0.9),)),
    Muscle('back_TA', 0.075, 0.05, 1500, 0.5, (Arm('ankle', 0.056, 0.9, 1.1),)),
    Muscle('back_HAM', 0.1, 0.04, 3000, 0.7, (Arm('hip', -0.05, 1), Arm('knee', -0.06, -1.3616, -1.5616),)),
    Muscle('back_RF', 0.075, 0.25, 1000, 0.7, (Arm('hip', 0.074, 0), Arm('knee', 0.056, -0.9616, -0.2616),)),
    Muscle('back_GAS', 0.04, 0.2, 1500, 0.7, (Arm('knee', -0.047, -0.2616, -0.7016), Arm('ankle', -0.047, 0.3708, -0.1492),)),
    Muscle('back_toe0', 0.05, 0.15, 1000, 0.7, (Arm('toe', -0.037, 0.0708, -0.4492),)),
    Muscle('back_toe1', 0.05, 0.15, 1000, 0.7, (Arm('toe', 0.037, -0.4492, 0.0708),)),
)

_RAPTOR_SPINE = (
    Muscle('spine0_top', 0.085, 0.1, 2500, 0.7, (Arm('spine0', 0.05, 0.16682, 0.21682),)),
    Muscle('spine0_bot', 0.085, 0.1, 2500, 0.7, (Arm('spine0', -0.05, 0.16682, 0.11682),)),
    Muscle('spine1_top', 0.05, 0.08, 2000, 0.7, (Arm('spine1', 0.05, 0.11743, 0.16743),)),
    Muscle('spine1_bot', 0.05, 0.08, 2000, 0.7, (Arm('spine1', -0.05, 0.11743, 0.06743),)),
    Muscle('spine2_top', 0.04, 0.03, 1000, 0.7, (Arm('spine2', 0.05, 0.11743, 0.16743),)),
    Muscle('spine2_bot', 0.04, 0.03, 1000, 0.7, (Arm('spine2', -0.05, 0.11743, 0.06743),)),
    Muscle('spine3_top', 0.03, 0.03, 1000, 0.7, (Arm('spine3', 0.05, 0.11914, 0.16914),)),
    Muscle('spine3_bot', 0.03, 0.03, 1000, 0.7, (Arm('spine3', -0.05, 0.11914, 0.06914),)),
    Muscle('head_top', 0.03, 0.02, 1000, 0.7, (Arm('head', 0.05, 0.75355, 0.95355),)),
    Muscle('head_bot', 0.03, 0.02, 1000, 0.7, (Arm('head', -0.05, 0.75355, 0.55355),)),
    Muscle('tail0_top', 0.085, 0.1, 2500, 0.7, (Arm('tail0', -0.05, -0.1, -0.2),)),
    Muscle('tail0_bot', 0.085, 0.1, 2500, 0.7, (Arm('tail0', 0.05, -0.1, 0),)),
    Muscle('tail1_top', 0.05, 0.0941, 2000, 0.7, (Arm('tail1', -0.04, -0.1, -0.2),)),
    Muscle('tail1_bot', 0.05, 0.0941, 2000, 0.7, (Arm('tail1', 0.04, -0.1, 0),)),
    Muscle('tail2_top', 0.05, 0.0941, 2000, 0.7, (Arm('tail2', -0.04, -0.1, -0.2),)),
    Muscle('tail2_bot', 0.05, 0.0941, 2000, 0.7, (Arm('tail2', 0.04, -0.1, 0),)),
    Muscle('tail3_top', 0.05, 0.0941, 1500, 0.7, (Arm('tail3', -0.03, -0.1, -0.2),)),
    Muscle('tail3_bot', 0.05, 0.0941, 1500, 0.7, (Arm('tail3', 0.03, -0.1, 0),)),
    Muscle('tail4_top', 0.05, 0.0941, 1500, 0.7, (Arm('tail4', -0.02, -0.1, -0.2),)),
    Muscle('tail4_bot', 0.05, 0.0941, 1500, 0.7, (Arm('tail4', 0.02, -0.1, 0),)),
)
_RAPTOR_LEG = (
    Muscle('right_GLU', 0.103, 0.122, 3000, 0.5, (Arm('right_hip', -0.035, 1),)),
    Muscle('right_HFL', 0.103, 0.094, 3000, 0.5, (Arm('right_hip', 0.07, -0.25),)),
    Muscle('right_VAS', 0.075, 0.215, 6000, 0.7, (Arm('right_knee', 0.056, -0.9616, -0.2616),)),
    Muscle('right_SOL', 0.075, 0.05, 5000, 0.5, (Arm('right_ankle', -0.056, 1.2, 0.9),)),
    Muscle('right_TA', 0.075, 0.05, 1500, 0.5, (Arm('right_ankle', 0.056, 0.9, 1.1),)),
    Muscle('right_HAM', 0.1, 0.05, 3000, 0.7, (Arm('right_hip', -0.08, 0.5), Arm('right_knee', -0.095, -0.9, -1.3),)),
    Muscle('right_RF', 0.075, 0.25, 1000, 0.7, (Arm('right_hip', 0.074, 0), Arm('right_knee', 0.056, -0.9616, -0.2616),)),
    Muscle('right_GAS', 0.047, 0.254, 1500, 0.7, (Arm('right_knee', -0.047, -0.2616, -0.7016), Arm('right_ankle', -0.047, 0.3708, -0.1492),)),
    Muscle('right_toe0', 0.05, 0.1, 1000, 0.7, (Arm('right_toe', -0.037, 0.0708, -0.4492),)),
    Muscle('right_toe1', 0.05, 0.1, 1000, 0.7, (Arm('right_toe', 0.037, -0.4492, 0.0708),)),
)

RAPTOR: tuple[Muscle, ...] = (*_RAPTOR_SPINE, *_RAPTOR_LEG, *map(_left, _RAPTOR_LEG))
# fmt: on

# The 12-link biped carries the same leg muscles (its arms hang passively); the goat is given the
# dog's, whose skeleton it shares.
MUSCLES: dict[str, tuple[Muscle, ...]] = {
    'biped2d': BIPED2D,
    'biped2d_full': BIPED2D,
    'dog': DOG,
    'goat': DOG,
    'raptor': RAPTOR,
}
