"""Runs of the bipeds and the raptor: feet and centre of mass prescribed, joints by leg kinematics.

In stance a foot rolls over heel and toe of a fixed foothold, so it can neither slide nor sink; the
centre of mass falls freely in flight; both repeat exactly. About twenty free parameters per clip
are in `RUNS`, as fitted by `fit.py`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import figure
import numpy as np
from scipy import interpolate

from trl_suite.motion.clip import Clip

GRAVITY = 9.81  # m/s2
PASSES = 8  # fixed-point passes that place the pelvis under the prescribed centre of mass


@dataclasses.dataclass(frozen=True)
class Build:
    """The data of a character that the generator needs.

    Attributes:
      figure: its tree and masses.
      joints: names in link order.
      leg: names of a leg's joints without the side, hip to foot.
      foot: x of toe corner, x of heel corner, height of the last joint above the sole, m.
      soft: reach, as a share of thigh + shank, where the knee starts to resist straightening,
        and the share it never exceeds.
      still: angles of joints that do not move, rad.
      mirrored: joints with a + b cos(2 pi phase) on the right and a - b cos on the left.
    """

    figure: figure.Figure
    joints: tuple[str, ...]
    leg: tuple[str, ...]
    foot: tuple[float, float, float]
    soft: tuple[float, float]
    still: Mapping[str, float]
    mirrored: Mapping[str, tuple[float, float]]


@dataclasses.dataclass(frozen=True)
class Run:
    """One clip: the character, period and speed, and shape parameters.

    Attributes:
      character: name of its file in xml/.
      period: of the full cycle, s.
      speed: mean, m/s.
      shape: parameters by name. Times are shares of the cycle (ds: stance), of the stance (ff, ho:
        foot flat, heel off) or of the swing (sa, sb). th0, tto, ta, tb: foot pitch at landing,
        take-off, sa and sb, rad; r0, rto: its rates, rad/s. qa, qb: accelerations with which the
        swing starts and ends, strides per swing time squared; lift: m, lsk: its skew, rise: its
        power (the lower, the quicker the foot leaves and meets the ground). ax: braking and
        push-off, m/s2; z: height of the centre of mass at landing, m; xl: foothold ahead of it, m.
        lean, pc2 ... ps4: pelvis pitch, mean and harmonics, rad. b0 ... b4: metatarsus pitch of the
        raptor at 0, ds/2, ds, and a third and two thirds of the swing, rad.
    """

    character: str
    period: float
    speed: float
    shape: Mapping[str, float]


BIPED_LEG = ('hip', 'knee', 'ankle')
RAPTOR_LEG = ('hip', 'knee', 'ankle', 'toe')
BIPED = tuple(f'{side}_{joint}' for side in ('right', 'left') for joint in BIPED_LEG)
BIPED_FULL = (*BIPED, 'right_shoulder', 'right_forearm', 'left_shoulder', 'left_forearm', 'neck')
RAPTOR_STILL = {  # the working posture of the character's position control
    'spine0': 0.16682,
    'spine1': 0.03457,
    'spine2': 0.11743,
    'spine3': 0.11914,
    'head': 0.75355,
    'tail0': 0.09288,
    'tail1': 0.04206,
    'tail2': 0.12818,
    'tail3': 0.01178,
    'tail4': 0.24638,
}
RAPTOR = (
    *RAPTOR_STILL,
    *(f'{side}_{joint}' for side in ('right', 'left') for joint in RAPTOR_LEG),
)


def build(character: str) -> Build:
    """Returns the data of a character that the generator needs."""
    biped_foot, biped_soft = (0.1403, -0.0367, 0.0474), (0.99, 0.9996)
    if character == 'biped2d':
        joints, leg, still, mirrored = BIPED, BIPED_LEG, {}, {}
    elif character == 'biped2d_full':
        joints, leg, still = BIPED_FULL, BIPED_LEG, {'neck': 0.15}
        mirrored = {'shoulder': (-0.10, -0.60), 'forearm': (1.2, -0.25)}
    else:
        return Build(
            figure.figure(character, RAPTOR),
            RAPTOR,
            RAPTOR_LEG,
            (0.09, -0.03, 0.055),
            (0.985, 0.9995),
            RAPTOR_STILL,
            {},
        )
    return Build(
        figure.figure(character, joints), joints, leg, biped_foot, biped_soft, still, mirrored
    )


def quintic(u, p0, v0, a0, p1, v1, a1, duration=1.0):
    """Returns the quintic over u in [0, 1] with given end positions, velocities, accelerations."""
    v0, v1 = v0 * duration, v1 * duration
    a0, a1 = a0 * duration**2, a1 * duration**2
    gap = p1 - p0 - v0 - a0 / 2
    slope = v1 - v0 - a0
    bend = a1 - a0
    c3 = 10 * gap - 4 * slope + bend / 2
    c4 = -15 * gap + 7 * slope - bend
    c5 = 6 * gap - 3 * slope + bend / 2
    return p0 + u * (v0 + u * (a0 / 2 + u * (c3 + u * (c4 + u * c5))))


def centre_of_mass(run: Run, phase: np.ndarray) -> np.ndarray:
    """Returns the prescribed path of the centre of mass, (n, 2): driven in stance, then falling."""
    p = run.shape
    step, stance = run.period / 2, p['ds'] * run.period
    steps, t = np.divmod(phase * run.period, step)
    strength = GRAVITY * step * np.pi / (2 * stance)  # so that a step leaves no vertical impulse
    s = np.minimum(t, stance)
    z = p['z'] - GRAVITY * (step - stance) / 2 * t - GRAVITY * t**2 / 2
    z += strength * (stance * s / np.pi - (stance / np.pi) ** 2 * np.sin(np.pi * s / stance))
    z += strength * 2 * stance / np.pi * (t - s)

    def brake(t):
        w = 2 * np.pi / stance
        return -p['ax'] / w * (t - np.sin(w * t) / w)

    x = run.speed * t + brake(s) - brake(stance) * t / step
    return np.stack([x + steps * run.speed * step, z], axis=1)


def foot(run: Run, foot_box: tuple[float, float, float], phase: np.ndarray):
    """Returns path (n, 2) of the foot's joint, its pitch (n,), and its swing time in [0, 1].

    The right foot lands at every whole phase. Swing time is NaN in stance.
    """
    p = run.shape
    toe, heel, height = foot_box
    cycles, f = np.divmod(phase, 1)
    stance = p['ds'] * run.period
    share = np.minimum(f / p['ds'], 1)  # of the stance
    tau = np.where(f >= p['ds'], (f - p['ds']) / (1 - p['ds']), np.nan)
    swinging = ~np.isnan(tau)
    w = np.nan_to_num(tau)

    landing = quintic(share / p['ff'], p['th0'], p['r0'], 0, 0, 0, 0, p['ff'] * stance)
    rolling = (share - p['ho']) / (1 - p['ho'])
    leaving = quintic(rolling, 0, 0, 0, p['tto'], p['rto'], 0, (1 - p['ho']) * stance)
    swing_time = (1 - p['ds']) * run.period
    swinging_pitch = interpolate.make_interp_spline(
        np.array([0, p['sa'], p['sb'], 1]) * swing_time,
        [p['tto'], p['ta'], p['tb'], p['th0']],
        k=5,
        bc_type=([(1, p['rto']), (2, 0.0)], [(1, p['r0']), (2, 0.0)]),
    )(w * swing_time)
    flat_or_leaving = np.where(share > p['ho'], leaving, 0)
    pitch = np.where(share < p['ff'], landing, flat_or_leaving)
    pitch = np.where(swinging, swinging_pitch, pitch)

    # The pivot moves back from toe to heel while the foot is in the air.
    to_heel = w**3 * (10 - 15 * w + 6 * w**2)
    to_heel = np.where(swinging, to_heel, share < p['ff'])[:, None]
    shift = [
        figure.rotate(np.array([-corner, height]), pitch) - np.array([-corner, height])
        for corner in (heel, toe)
    ]
    path = to_heel * shift[0] + (1 - to_heel) * shift[1]
    travel = quintic(np.clip((w - 0.03) / 0.955, 0, 1), 0, 0, p['qa'], 1, 0, -p['qb'])
    path[:, 0] += p['xl'] + (travel + cycles) * run.speed * run.period
    path[:, 1] += height
    path[:, 1] += p['lift'] * (4 * w * (1 - w)) ** p['rise'] * (1 + p['lsk'] * (1 - 2 * w))
    return path, pitch, tau


def leg_angles(run: Run, make: Build, hip: np.ndarray, pelvis: np.ndarray, phase: np.ndarray):
    """Returns the joint angles (n, joints) of the right leg and its required reach (n,)."""
    p, names = run.shape, make.leg
    path, pitch, _ = foot(run, make.foot, phase)
    links = [make.figure.length(f'right_{name}') for name in names]
    thigh, shank = links[1], links[2]
    last = pitch  # world pitch of the segment below the shank
    if 'toe' in names:
        metatarsus = interpolate.CubicSpline(
            [0, p['ds'] / 2, p['ds'], *(p['ds'] + np.array([0.33, 0.66]) * (1 - p['ds'])), 1],
            [*(p[f'b{i}'] for i in range(5)), p['b0']],
            bc_type='periodic',
        )
        last = metatarsus(phase % 1)
        path = path - figure.rotate(np.array([0, -links[3]]), last)
    reach = path - hip
    wanted = np.linalg.norm(reach, axis=1) / (thigh + shank)
    soft, end = make.soft
    bent = soft + (end - soft) * np.tanh((wanted - soft) / (end - soft))
    d = np.where(wanted > soft, bent, wanted) * (thigh + shank)
    d = np.maximum(d, 1.02 * abs(thigh - shank))  # a fit may ask for a leg folded on itself
    knee = np.arccos(np.clip((thigh**2 + shank**2 - d**2) / (2 * thigh * shank), -1, 1)) - np.pi
    above = np.arccos(np.clip((thigh**2 + d**2 - shank**2) / (2 * thigh * d), -1, 1))
    thigh_pitch = np.arctan2(reach[:, 0], -reach[:, 1]) + above
    angles = [thigh_pitch - pelvis, knee, last - thigh_pitch - knee]
    if 'toe' in names:
        angles.append(pitch - last)
    return np.stack(angles, axis=1), wanted


def poses(run: Run, phase: np.ndarray, passes: int = PASSES) -> np.ndarray:
    """Returns the poses of a run at given phases, (n, 3 + joints)."""
    make, p = build(run.character), run.shape
    centre = centre_of_mass(run, phase)
    result = np.zeros((len(phase), 3 + len(make.joints)))
    result[:, :2] = centre
    result[:, 2] = p['lean'] + sum(
        p[f'pc{k}'] * np.cos(2 * np.pi * k * phase) + p[f'ps{k}'] * np.sin(2 * np.pi * k * phase)
        for k in (2, 4)
    )
    for name, angle in make.still.items():
        result[:, 3 + make.joints.index(name)] = angle
    for name, (mean, swing) in make.mirrored.items():
        swing = swing * np.cos(2 * np.pi * phase)
        result[:, 3 + make.joints.index(f'right_{name}')] = mean + swing
        result[:, 3 + make.joints.index(f'left_{name}')] = mean - swing
    half = np.array([run.speed * run.period / 2, 0])
    for _ in range(passes + 1):
        for side, later, back in (('right', 0.0, 0.0), ('left', 0.5, 1.0)):
            hip = result[:, :2] + back * half
            angles, _ = leg_angles(run, make, hip, result[:, 2], phase + later)
            first = 3 + make.joints.index(f'{side}_{make.leg[0]}')
            result[:, first : first + len(make.leg)] = angles
        result[:, :2] += centre - make.figure.centre(result)
    return result


SHAPE = {
    'stance': ('ds', 'ff', 'ho', 'th0', 'r0', 'tto', 'rto'),
    'swing': ('sa', 'ta', 'sb', 'tb', 'qa', 'qb'),
    'path': ('lift', 'lsk', 'rise', 'ax', 'z', 'xl'),
    'pelvis': ('lean', 'pc2', 'ps2', 'pc4', 'ps4'),
    'metatarsus': ('b0', 'b1', 'b2', 'b3', 'b4'),
}


def shape(**groups: tuple[float, ...]) -> dict[str, float]:
    """Returns parameters by name from tuples in the order of `SHAPE`."""
    return {
        name: value
        for group, values in groups.items()
        for name, value in zip(SHAPE[group], values, strict=True)
    }


RUNS = {
    'biped2d_run': Run(
        'biped2d',
        0.5,
        4.656,
        shape(
            stance=(0.26, 0.3081, 0.45, 0.15, -4.0, -0.6981, -16.0),
            swing=(0.1606, -1.3018, 0.6651, -0.5, 4.8866, 8.3628),
            path=(0.1868, -0.0987, 2.0, 1.8035, 0.8069, 0.1705),
            pelvis=(-0.14, 0.0024, -0.0335, 0.0019, -0.015),
        ),
    ),
    'raptor_run_050': Run(
        'raptor',
        0.5,
        3.95,
        shape(
            stance=(0.2515, 0.3214, 0.5583, 0.1288, -1.0, -0.3, -13.5575),
            swing=(0.4, -1.3129, 0.8062, 0.2682, 2.3426, 3.9231),
            path=(0.1484, -0.3634, 2.0, 7.9859, 0.4655, 0.0987),
            pelvis=(0.0386, 0.0186, 0.0496, -0.0058, 0.0123),
            metatarsus=(0.9764, 0.7932, 0.0325, -1.0103, 0.2653),
        ),
    ),
    'raptor_run_066': Run(
        'raptor',
        0.66,
        4.05,
        shape(
            stance=(0.21, 0.4085, 0.5179, 0.15, -1.0, -0.3, -10.8537),
            swing=(0.4, -1.5841, 0.85, 0.2106, 5.1561, 10.2316),
            path=(0.1501, -0.3032, 2.0, 9.0, 0.4309, 0.1775),
            pelvis=(0.0101, -0.0347, 0.05, -0.0038, 0.0098),
            metatarsus=(1.2914, 1.058, 0.098, -1.1418, -0.0901),
        ),
    ),
}
RATE = 240  # frames per second


def clip(name: str) -> Clip:
    """Returns a run of the table."""
    run = RUNS[name]
    phase = np.linspace(0, 1, round(RATE * run.period) + 1)
    table = poses(run, phase)
    table[:, 0] -= table[0, 0]
    table[-1, 1:] = table[0, 1:]
    joints = build(run.character).joints
    return Clip(
        name,
        run.period * phase,
        table,
        'planar',
        joints,
        (1,) * len(joints),
        True,
        f'run at {run.speed:g} m/s, two steps in {run.period:g} s',
    )


def clips() -> list[Clip]:
    """Returns the clips of this recipe."""
    return [clip(name) for name in RUNS]
