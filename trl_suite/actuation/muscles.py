"""Musculotendon units of three characters, as data.

Source: the muscle lists of the original's character files. Its muscle environments load the
hand-tuned ones, `PLAIN`; 'Learning locomotion skills using DeepRL: does the choice of action space
matter?' (Peng, van de Panne 2017) evaluates those optimised for a motion. Two names that the
original uses twice (the last tail units of dog and raptor) have the spanned joint added here.

Muscle(name, optimal fibre length m, tendon slack length m, peak force N, pennation factor, arms);
Arm(joint, moment arm m, rest angle rad, angle of the largest arm rad or None for a constant arm).
The sign of an arm is the sign of the torque of the contracting muscle.
"""

from __future__ import annotations

from typing import NamedTuple

PLAIN = 'plain'


class Arm(NamedTuple):
    """The moment arm of a muscle at one joint."""

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

_BIPED_WALK_LEG = (
    Muscle('right_GLU', 0.103921, 0.136132, 1063.54, 0.5, (Arm('right_hip', -0.060654, 0.438387),)),
    Muscle('right_HFL', 0.143612, 0.080773, 2086.28, 0.5, (Arm('right_hip', 0.062296, 0.346302),)),
    Muscle('right_VAS', 0.074511, 0.208687, 5940.77, 0.7, (Arm('right_knee', 0.045198, -1.08183, -0.552362),)),
    Muscle('right_SOL', 0.071519, 0.245616, 4115.28, 0.5, (Arm('right_ankle', -0.055327, 0.155117, -0.249141),)),
    Muscle('right_TA', 0.051597, 0.256242, 927.727, 0.7, (Arm('right_ankle', 0.066248, -0.233678, 0.45893),)),
    Muscle('right_HAM', 0.098864, 0.310653, 3221.14, 0.7, (Arm('right_hip', -0.075565, 0.617614), Arm('right_knee', -0.050685, -0.324651, -0.052258),)),
    Muscle('right_RF', 0.050677, 0.305952, 1083.01, 0.7, (Arm('right_hip', 0.071671, -0.224264), Arm('right_knee', 0.069311, -0.619113, -0.522706),)),
    Muscle('right_GAS', 0.01, 0.387439, 1450.79, 0.7, (Arm('right_knee', -0.057873, 0.191636, -0.590381), Arm('right_ankle', -0.098579, 0.130406, -0.071663),)),
)
_BIPED_RUN_LEG = (
    Muscle('right_GLU', 0.14532, 0.127926, 2157.21, 0.5, (Arm('right_hip', -0.06043, 1.73281),)),
    Muscle('right_HFL', 0.104393, 0.139809, 1987.92, 0.5, (Arm('right_hip', 0.076658, 0.664151),)),
    Muscle('right_VAS', 0.093804, 0.233378, 6371.33, 0.7, (Arm('right_knee', 0.030467, -1.0669, -1.02439),)),
    Muscle('right_SOL', 0.045674, 0.24116, 4523.96, 0.5, (Arm('right_ankle', -0.076631, 0.071444, -0.024811),)),
    Muscle('right_TA', 0.063, 0.22144, 739.251, 0.7, (Arm('right_ankle', 0.02968, -0.372069, 0.557552),)),
    Muscle('right_HAM', 0.093908, 0.31468, 2947.49, 0.7, (Arm('right_hip', -0.062476, 0.931905), Arm('right_knee', -0.04278, -0.574646, -0.565187),)),
    Muscle('right_RF', 0.111647, 0.329084, 1060.36, 0.7, (Arm('right_hip', 0.098237, 0.161858), Arm('right_knee', 0.091117, -1.26444, -1.26491),)),
    Muscle('right_GAS', 0.020818, 0.355393, 1576.52, 0.7, (Arm('right_knee', -0.07141, -0.546995, 0.057873), Arm('right_ankle', -0.037298, 0.188545, 0.096561),)),
)

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

_DOG_BOUND = {
    muscle.name: muscle
    for muscle in (
        *(
            muscle
            for joint in ('spine0', 'spine1', 'spine2', 'spine3', 'torso')
            for muscle in (
                Muscle(f'{joint}_top', 0.01644, 0.026873, 2988.64, 0.7, (Arm(joint, 0.041256, 0.067316, -0.135806),)),
                Muscle(f'{joint}_bot', 0.04458, 0.046537, 3283.75, 0.7, (Arm(joint, -0.077986, 0.268007, -0.05925),)),
            )
        ),
        Muscle('front_DEL', 0.134135, 0.021751, 2932.8, 0.5, (Arm('shoulder', -0.035632, 0.821207),)),
        Muscle('front_SUP', 0.082006, 0.01, 3048.41, 0.5, (Arm('shoulder', 0.010471, -1.0152),)),
        Muscle('front_ANC', 0.152839, 0.147877, 5955.96, 0.7, (Arm('elbow', -0.046929, 1.86467, 1.87341),)),
        Muscle('front_BRC', 0.116334, 0.051123, 3167.25, 0.7, (Arm('elbow', 0.021148, 0.057267, 0.841644),)),
        Muscle('front_SOL', 0.045963, 0.042878, 5184.61, 0.5, (Arm('wrist', -0.099728, 0.841739, 1.09735),)),
        Muscle('front_TA', 0.035888, 0.071009, 1660.9, 0.5, (Arm('wrist', 0.072488, 0.634158, 0.334093),)),
        Muscle('front_BCP', 0.107799, 0.242149, 3268.47, 0.7, (Arm('shoulder', 0.035236, -0.320519), Arm('elbow', 0.038558, 0.808609, 1.54756),)),
        Muscle('front_TCP', 0.058302, 0.282813, 1981.53, 0.7, (Arm('shoulder', -0.054498, 0.248232), Arm('elbow', -0.047793, 1.43967, 0.402376),)),
        Muscle('back_GLU', 0.113573, 0.054666, 2940.6, 0.5, (Arm('hip', -0.041736, 0.6607),)),
        Muscle('back_HFL', 0.100042, 0.021422, 3498.97, 0.5, (Arm('hip', 0.044381, -0.212431),)),
        Muscle('back_VAS', 0.151225, 0.136977, 5652.54, 0.7, (Arm('knee', 0.036209, -1.38382, -2.17833),)),
        Muscle('back_SOL', 0.064563, 0.030581, 5001.2, 0.5, (Arm('ankle', -0.056605, 1.30063, 1.45806),)),
        Muscle('back_TA', 0.072787, 0.015809, 1670.68, 0.5, (Arm('ankle', 0.028257, 0.938975, 1.30845),)),
        Muscle('back_HAM', 0.078746, 0.052343, 3038.6, 0.7, (Arm('hip', -0.058656, 0.934426), Arm('knee', -0.066383, -1.80857, -2.35584),)),
        Muscle('back_RF', 0.112913, 0.274818, 1266.04, 0.7, (Arm('hip', 0.054702, 0.364479), Arm('knee', 0.072641, -0.690922, -0.089711),)),
        Muscle('back_GAS', 0.073725, 0.190891, 1261.07, 0.7, (Arm('knee', -0.046208, -0.040456, -0.919144), Arm('ankle', -0.038165, 1.47314, -0.286671),)),
    )
}

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

_RAPTOR_RUN_LEG = (
    Muscle('right_GLU', 0.170177, 0.142626, 3323.67, 0.5, (Arm('right_hip', -0.064096, 1.18661),)),
    Muscle('right_HFL', 0.079718, 0.102316, 2804.84, 0.5, (Arm('right_hip', 0.068848, -0.133926),)),
    Muscle('right_VAS', 0.136791, 0.211811, 5692.87, 0.7, (Arm('right_knee', 0.046858, -1.19406, -0.871852),)),
    Muscle('right_SOL', 0.110611, 0.085232, 5445.52, 0.5, (Arm('right_ankle', -0.042543, 1.47134, 1.81221),)),
    Muscle('right_TA', 0.117008, 0.063826, 1763.93, 0.5, (Arm('right_ankle', 0.067546, 1.1873, 1.14023),)),
    Muscle('right_HAM', 0.126348, 0.046637, 2897.9, 0.7, (Arm('right_hip', -0.074226, 0.695569), Arm('right_knee', -0.109796, -0.524312, -2.15471),)),
    Muscle('right_RF', 0.043318, 0.275059, 1053.42, 0.7, (Arm('right_hip', 0.116225, -0.217501), Arm('right_knee', 0.052254, -0.700555, -0.433975),)),
    Muscle('right_GAS', 0.07242, 0.262528, 1783.73, 0.7, (Arm('right_knee', -0.091143, 0.19374, -0.808691), Arm('right_ankle', -0.073004, 0.014619, 1.0005),)),
    Muscle('right_toe0', 0.01, 0.111912, 859.904, 0.7, (Arm('right_toe', -0.054123, -0.267741, -0.804647),)),
    Muscle('right_toe1', 0.059187, 0.119056, 1034.19, 0.7, (Arm('right_toe', 0.048727, -0.980266, -0.345655),)),
)
# fmt: on


def _legs(right: tuple[Muscle, ...]) -> tuple[Muscle, ...]:
    return (*right, *map(_left, right))


_BIPED_SETS = {
    PLAIN: _legs(_BIPED_LEG),
    'walk': _legs(_BIPED_WALK_LEG),
    'run': _legs(_BIPED_RUN_LEG),
}
# For each character PLAIN, then the sets by the motion for which they were optimised. The 12-link
# biped has the same leg muscles (its arms are passive); the goat has those of the dog, whose
# skeleton it shares.
MUSCLES: dict[str, dict[str, tuple[Muscle, ...]]] = {
    'biped2d': _BIPED_SETS,
    'biped2d_full': _BIPED_SETS,
    'dog': {PLAIN: DOG, 'bound': tuple(_DOG_BOUND.get(muscle.name, muscle) for muscle in DOG)},
    'goat': {PLAIN: DOG},
    'raptor': {
        PLAIN: (*_RAPTOR_SPINE, *_legs(_RAPTOR_LEG)),
        'run': (*_RAPTOR_SPINE, *_legs(_RAPTOR_RUN_LEG)),
    },
}
