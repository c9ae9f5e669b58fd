"""Three-dimensional walks and steps: feet and pelvis prescribed, joints by leg kinematics.

A step is defined by the landing position of the swing foot relative to the stance foot, forward and
outwards with respect to the heading at the start, and by the change of heading towards the swing
side. A clip is a step that follows another one: it starts in right stance when both feet are on the
ground and ends when the left foot lands. Pose and rates with both feet on the ground depend only on
the step that ends there, so steps of any length, width and turn can be chained continuously; left
steps are mirrored right ones.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import figure3d
import numpy as np
from run import quintic
from scipy import interpolate

from trl_suite import motion

STEP = 0.5  # s
REFERENCE = 0.65  # m, the step length to which the parameters of `SHAPES` refer
ROTATION, TOE_OUT = 0.10, 0.08  # rad: pelvis turned, feet turned out
COUNTER = 1.0  # counter-turn of the torso per pelvis's
CLEARANCE = 0.12  # m, by which the swing foot passes the stance foot
SPARE = 0.0025  # m, largest error of the stance foot; if the leg is shorter, the pelvis sinks
PASSES = 4  # in which it does
RATE = 120  # frames per second of a walk
STEP_RATE = 60  # frames per second of a library
FINE = 2.0**30  # poses are rounded to 1 / FINE where there are two of each step, for smaller files


@dataclasses.dataclass(frozen=True)
class Step:
    """A step: forward m, outwards m, change of heading rad; whether the walker stands after it."""

    length: float
    width: float
    turn: float = 0.0
    stand: bool = False


# Shape parameters of a step from a least-squares fit (mocap/README.md describes the criteria).
# Both feet down: kap, speed forward, in steps per step time; c, sideways, m/s per m of width; xoff,
# pelvis ahead of the middle of the feet, m; phl, pht, knee flexion of lead and trail leg, rad; vzn,
# speed upwards, m/s. Mid-stance: sm, share of the step; phm, knee flexion; vm, speed upwards; azs,
# share of the vertical acceleration of a sine. Foot: ths, rhs, th1, r1, pitch and its rate at
# landing and take-off, rad, rad/s; sff, sho, sto, flat, heel off and toe off, shares of the step;
# tto, tmid, pitch at sto and smid; lift, m; lsk, its skew; p, hurry in mid-swing, 1 is least.
NAMES = (
    *('kap', 'c', 'xoff', 'phl', 'pht', 'phm', 'vzn', 'vm', 'sm', 'azs', 'ths', 'rhs'),
    *('sff', 'sho', 'th1', 'r1', 'sto', 'tto', 'smid', 'tmid', 'lift', 'lsk', 'p'),
)
_ROWS = {
    'biped3d_mocap': (
        *(1.142, 0.966, 0.043, 0.212, 0.266, 0.400, 0.075, 0.034, 0.573, 0.446, 0.272, -6.0),
        *(0.249, 0.733, -0.304, -5.0, 0.2, -1.012, 0.770, 0.177, 0.10, 0.184, 1.466),
    ),
    'biped3d': (
        *(1.131, 1.133, 0.041, 0.242, 0.255, 0.417, 0.095, 0.018, 0.569, 0.351, 0.296, -6.0),
        *(0.272, 0.725, -0.328, -5.0, 0.2, -1.059, 0.747, 0.080, 0.10, 0.179, 1.559),
    ),
    'biped3d_full_mocap': (
        *(1.124, 1.014, 0.042, 0.249, 0.263, 0.400, 0.076, 0.032, 0.568, 0.475, 0.276, -6.0),
        *(0.253, 0.740, -0.299, -5.0, 0.2, -1.003, 0.771, 0.183, 0.10, 0.182, 1.501),
    ),
}
# Pitch of pelvis and torso, drop of the pelvis on the swing side, lean of the torso to the right, rad;
# detour of the swing foot, pelvis left of the middle of the feet, m.
_POSTURE = {
    'lean': -0.05,
    'torso': -0.02,
    'list': 0.07,
    'tilt': 0.0,
    'aside': 0.0,
    'ahead': 0.0,
    'yoff': 0.0,
}
SHAPES: Mapping[str, Mapping[str, float]] = {
    name: dict(zip(NAMES, row, strict=True)) | _POSTURE for name, row in _ROWS.items()
}
_STRAIGHT = {
    'phl': 0.10,
    'pht': 0.12,
    'phm': 0.10,
    'tto': -0.4,
    'tmid': 0.3,
    'lift': 0.08,
    'aside': 0.28,
    'list': 0.0,
}
# What the steps of a style have instead.
STYLES: Mapping[str, Mapping[str, float]] = {
    'high_knees': {'lift': 0.25, 'lsk': -0.3, 'ahead': 0.15},
    'straight_legs': _STRAIGHT,
    'one_straight_leg': {},
    'sideways_lean': {'tilt': 0.35, 'yoff': 0.04},
    'forward_lean': {'lean': -0.20, 'torso': -0.45, 'xoff': -0.03},
    'in_place': {'xoff': 0.0},
    'stand': {},
}
# What the left leg has instead in styles where it moves differently.
LEFT: Mapping[str, Mapping[str, float]] = {'one_straight_leg': _STRAIGHT}


def bump(u: np.ndarray) -> np.ndarray:
    """Returns a curve from 0 to 1 and back to 0."""
    return (4 * u * (1 - u)) ** 3


def late_bump(u: np.ndarray) -> np.ndarray:
    """Returns the same curve with its maximum at 0.7."""
    return (u / 0.7) ** 7 * ((1 - u) / 0.3) ** 3


@dataclasses.dataclass(frozen=True)
class Node:
    """Root pose and rates with both feet on the ground, determined by the step that ends there."""

    xy: np.ndarray
    velocity: np.ndarray
    size: float  # of the step, 1 for the reference length
    z: float
    rise: float  # m/s
    lift: float  # m/s2


def node(
    made: figure3d.Figure,
    p: Mapping[str, float],
    behind: Mapping[str, float],
    trail: np.ndarray,
    lead: np.ndarray,
    heading: float,
    side: int,
    stand: bool,
) -> Node:
    """Returns the node with `lead` (2,) in front; side 1 if that is the left foot, else -1.

    `p` is the shape of its leg, `behind` that of the other. To stand, all rates are 0 and the feet flat.
    """
    toe, heel, sole = figure3d.FOOT
    e = np.array([np.cos(heading), np.sin(heading)])
    n = side * np.array([-e[1], e[0]])
    forward, outward = (lead - trail) @ e, (lead - trail) @ n
    size = 0.0 if stand else float(np.clip(forward / REFERENCE, 0.15, 1.3))
    xy = (trail + lead) / 2 + p['xoff'] * e + side * p['yoff'] * n
    velocity = p['kap'] * forward / STEP * e + p['c'] * np.clip(outward, 0, 0.3) * n
    velocity = velocity * (not stand)
    # The lead hip is turned forward; the root is as high as the shorter leg lets it.
    leg, bent = sum(made.leg), max(p['phm'], behind['phm'])
    turn = figure3d.yaw(np.array(heading - side * ROTATION * size)) @ figure3d.pitch(
        np.array(p['lean'])
    )
    heights = [sole + leg * np.cos(bent / 2) - 0.005]
    for foot, bend, tilt, corner, lateral in (
        (lead, p['phl'], p['ths'], heel, side),
        (trail, behind['pht'], p['th1'], toe, -side),
    ):
        hip = turn @ made.joint('left_hip' if lateral > 0 else 'right_hip')
        shift = figure3d.rolled(np.array(tilt * size), corner)
        gap = xy + hip[:2] - (foot + shift[0] * e)
        upright = np.sqrt((leg * np.cos(bend / 2)) ** 2 - gap @ gap)
        heights.append(float(sole + shift[1] + upright - hip[2]))
    z = min(heights)
    swing = max(sole + leg * np.cos(bent / 2) - z, 0.004) / 2 * (2 * np.pi / STEP) ** 2
    return Node(xy, velocity, size, z, p['vzn'] * size, p['azs'] * swing * (not stand))


def step(
    made: figure3d.Figure,
    p: Mapping[str, float],
    previous: Step,
    this: Step,
    u: np.ndarray,
    left: Mapping[str, float] | None = None,
) -> figure3d.Bodies:
    """Returns a step in right stance at shares `u` of its duration, (n,).

    The stance foot is at the origin; the heading is along x at the start. `left` is the shape of the left
    leg, if it is another.
    """
    left = left or p
    u = u * (not (previous.stand and this.stand))
    right = np.zeros(2)
    cos, sin = np.cos(previous.turn), np.sin(previous.turn)
    back = np.array([previous.length, -previous.width])
    trail = -np.array([cos * back[0] - sin * back[1], sin * back[0] + cos * back[1]])
    land = np.array([this.length, this.width])
    start = node(made, p, left, trail, right, 0.0, -1, previous.stand)
    end = node(made, left, p, right, land, this.turn, 1, this.stand)
    size = (start.size + end.size) / 2

    # Pelvis and torso.
    top = figure3d.FOOT[2] + sum(made.leg) * np.cos(p['phm'] / 2)
    fall = -p['azs'] * (2 * top - start.z - end.z) / 4 * (2 * np.pi / STEP) ** 2
    sm, vm = p['sm'], p['vm'] * size
    first = (start.z, start.rise, start.lift, top, vm, fall, sm * STEP)
    second = (top, vm, fall, end.z, end.rise, end.lift, (1 - sm) * STEP)
    z = np.where(u < sm, quintic(u / sm, *first), quintic((u - sm) / (1 - sm), *second))
    x, y = (
        quintic(u, start.xy[i], start.velocity[i], 0, end.xy[i], end.velocity[i], 0, STEP)
        for i in (0, 1)
    )
    root = np.stack([x, y, z], axis=-1)
    heading = quintic(u, 0, -previous.turn / STEP, 0, this.turn, this.turn / STEP, 0, STEP)
    turn = quintic(u, ROTATION * start.size, 0, 0, -ROTATION * end.size, 0, 0, STEP)
    pelvis = (
        figure3d.yaw(heading + turn)
        @ figure3d.pitch(0 * u + p['lean'])
        @ figure3d.roll(-left['list'] * bump(u))
    )
    torso = figure3d.yaw(heading - COUNTER * turn) @ figure3d.pitch(0 * u + p['torso'])
    torso = torso @ figure3d.roll(0 * u + p['tilt'])

    feet = {'right': _stance(p, start, end, u), 'left': _swing(left, start, end, trail, land, u)}
    yaws = {
        'right': 0 * u - TOE_OUT,
        'left': TOE_OUT + previous.turn + (this.turn - previous.turn) * _travel(p, u),
    }
    joints = {'torso': figure3d.between(pelvis, torso)}
    ankles = {}
    for side, (path, _, shift) in feet.items():
        ankles[side] = path.copy()
        ankles[side][:, 0] += shift[:, 0] * np.cos(yaws[side])
        ankles[side][:, 1] += shift[:, 0] * np.sin(yaws[side])
        ankles[side][:, 2] += shift[:, 1]
    for _ in range(PASSES):
        reach = []
        for side, (_, tilt, _) in feet.items():
            hip = root + figure3d.apply(pelvis, made.joint(f'{side}_hip'))
            hinge = 0.6 * yaws[side] + 0.4 * (heading + turn)
            thigh, knee, wanted = figure3d.leg(made.leg, hip, ankles[side], hinge)
            foot = figure3d.yaw(yaws[side]) @ figure3d.pitch(tilt)
            joints[f'{side}_hip'] = figure3d.between(pelvis, thigh)
            joints[f'{side}_knee'] = knee
            joints[f'{side}_ankle'] = figure3d.between(thigh @ figure3d.pitch(knee), foot)
            reach.append(wanted)
        found = figure3d.Bodies(root, pelvis, dict(joints), np.stack(reach, axis=-1))
        short = sum(made.leg) * np.max(reach[0] - figure3d.soft_reach(reach[0]))
        if short <= SPARE:
            break
        root = root - np.outer((short - SPARE) * late_bump(u), (0, 0, 1))
    return found


def _stance(p, start: Node, end: Node, u):
    """Returns flat position (n, 3), pitch (n,) and rolling shift (n, 2) of the stance foot."""
    toe, heel, sole = figure3d.FOOT
    sff, sho = p['sff'], p['sho']
    landing = quintic(u / sff, p['ths'] * start.size, p['rhs'] * start.size, 0, 0, 0, 0, sff * STEP)
    rolling = (u - sho) / (1 - sho)
    leaving = quintic(
        rolling, 0, 0, 0, p['th1'] * end.size, p['r1'] * end.size, 0, (1 - sho) * STEP
    )
    tilt = np.where(u < sff, landing, np.where(u > sho, leaving, 0))
    shift = np.where((u < 0.5)[:, None], figure3d.rolled(tilt, heel), figure3d.rolled(tilt, toe))
    return np.broadcast_to((0.0, 0.0, sole), (len(u), 3)), tilt, shift


def _travel(p, u):
    """Returns the share of the path covered by the swing foot, with the lift before and after."""
    w = np.clip((u - p['sto'] - 0.03) / (1 - p['sto'] - 0.07), 0, 1)
    return (p['p'] - 1) * figure3d.smooth(w) + (2 - p['p']) * (3 * w**2 - 2 * w**3)


def _swing(p, start: Node, end: Node, trail, land, u):
    """Returns path (n, 3), pitch (n,) and rolling shift (n, 2) of the swing foot."""
    toe, heel, sole = figure3d.FOOT
    size = (start.size + end.size) / 2
    tilt = interpolate.make_interp_spline(
        np.array([0, p['sto'], p['smid'], 1]) * STEP,
        [p['th1'] * start.size, p['tto'] * start.size, p['tmid'] * size, p['ths'] * end.size],
        k=5,
        bc_type=(
            [(1, p['r1'] * start.size), (2, 0.0)],
            [(1, p['rhs'] * end.size), (2, 0.0)],
        ),
    )(u * STEP)
    tau = np.clip((u - p['sto']) / (1 - p['sto']), 0, 1)
    to_heel = figure3d.smooth(tau)[:, None]
    shift = to_heel * figure3d.rolled(tilt, heel) + (1 - to_heel) * figure3d.rolled(tilt, toe)
    path = trail + _travel(p, u)[:, None] * (land - trail)
    slope = (land[1] - trail[1]) / (land[0] - trail[0]) if land[0] > trail[0] else 0.0
    passing = trail[1] - trail[0] * slope
    path[:, 1] += max(0.0, CLEARANCE - passing) * bump(tau)
    path[:, 1] += p['aside'] * bump(tau)
    path[:, 0] += p['ahead'] * late_bump(tau)
    up = p['lift'] * (0.5 + 0.5 * min(size, 1)) * bump(tau) * (1 + p['lsk'] * (1 - 2 * tau))
    return np.column_stack([path, sole + up]), tilt, shift


def walk(name: str, character: str, this: Step, shape: str = '') -> motion.Clip:
    """Returns a looping walk: a step, and its mirror image, straight on."""
    made, p = figure3d.figure(character), SHAPES[shape or character]
    frames = round(RATE * STEP) + 1
    half = made.poses(step(made, p, this, this, np.linspace(0, 1, frames)))
    half[:, :2] -= half[0, 0], this.width / 2
    other = made.layout.mirror.pose(half[1:])
    other[:, 0] += half[-1, 0]
    poses = np.concatenate([half, other])
    poses[-1, 1:] = poses[0, 1:]  # the same numbers, not merely the same to rounding
    speed, arms = this.length / STEP, ' with arms' if 'right_shoulder' in made.layout.joints else ''
    return motion.Clip(
        name,
        np.linspace(0, 2 * STEP, 2 * frames - 1),
        poses,
        'free',
        made.layout.joints,
        made.layout.sizes,
        True,
        f'walk at {speed:g} m/s{arms}',
    )


def library(name: str, shape: str = '', style: str = '') -> motion.FootstepLibrary:
    """Returns the step library of a character, or of one of its styles.

    The steps are straight, wide and turning, all after `USUAL`, except those of `OWN`.
    """
    made, usual = figure3d.figure(name), SHAPES[shape or name]
    right = usual | STYLES.get(style, {})
    left = usual | LEFT[style] if style in LEFT else right
    reflected = {name: -right[name] for name in ('tilt', 'yoff')}
    pairs = OWN.get(style, [(USUAL, this) for this in LIBRARY])
    u = np.linspace(0, 1, round(STEP_RATE * STEP) + 1)
    poses, labels, features, others = [], [], [], []
    for before, this in pairs:
        bodies = step(made, right, before, this, u, left)
        poses.append(made.poses(bodies))
        labels.append((this.length, this.width, this.turn))
        features.append(figure3d.features(made, bodies, this.turn))
        bodies = step(made, left | reflected, before, this, u, right | reflected)
        others.append(made.poses(bodies))
    same = np.array_equal(poses, others)
    return motion.FootstepLibrary(
        name=f'{name}_{style}' if style else name,
        times=STEP * u,
        poses=np.array(poses) if same else np.round(np.array(poses) * FINE) / FINE,
        left_poses=None if same else np.round(np.array(others) * FINE) / FINE,
        joints=made.layout.joints,
        sizes=made.layout.sizes,
        labels=np.array(labels),
        previous=np.array([(before.length, before.width, before.turn) for before, _ in pairs]),
        features=np.array(features),
        description=f'{len(labels)} walking steps of {STEP:g} s',
    )


USUAL = Step(0.5, 0.15)  # the step before every step of a library
LIBRARY = (
    *(Step(length, 0.15) for length in (0.2, 0.35, 0.5, 0.6, 0.7)),
    *(Step(length, width) for length in (0.35, 0.55) for width in (0.10, 0.22, 0.30)),
    *(
        Step(length, 0.15, turn)
        for length in (0.3, 0.5)
        for turn in (-0.8, -0.6, -0.4, -0.2, 0.2, 0.4, 0.6, 0.8)
    ),
)
IN_PLACE = (
    *(Step(length, 0.15) for length in (0.0, 0.05, 0.1)),
    *(Step(0.0, width) for width in (0.12, 0.22)),
    *(Step(0.0, 0.15, turn) for turn in (-0.6, -0.4, -0.2, 0.2, 0.4, 0.6, 0.8)),
)
STAND = Step(0.0, 0.15, stand=True)
# The steps of some styles, each after another one. To stand, the swing foot closes up and stays there.
OWN: Mapping[str, Sequence[tuple[Step, Step]]] = {
    'in_place': [(IN_PLACE[0], this) for this in IN_PLACE],
    'stand': [
        *((USUAL, this) for this in (*LIBRARY, STAND)),
        *((STAND, this) for this in (*LIBRARY[:5], STAND)),
        *((STAND, Step(0.0, 0.15, turn)) for turn in (-0.6, -0.4, 0.4, 0.8)),
        *((STAND, Step(0.3, 0.15, turn)) for turn in (-0.8, -0.4, 0.4, 0.8)),
    ],
}


def character(library: str) -> str:
    """Returns the character of a step library by its name."""
    for style in STYLES:
        library = library.removesuffix(f'_{style}')
    return library


def clips() -> list[motion.Clip]:
    """Returns the clips of this recipe."""
    return [
        walk('biped3d_walk', 'biped3d', Step(0.60, 0.15)),
        walk('biped3d_mocap_walk', 'biped3d_mocap', Step(0.65, 0.15)),
        walk('biped3d_full_walk', 'biped3d_full_mocap', Step(0.65, 0.15)),
    ]


def libraries() -> list[motion.FootstepLibrary]:
    """Returns the step libraries of this recipe; both bodies have the same legs."""
    return [
        library('biped3d_mocap'),
        library('biped3d_full_mocap', 'biped3d_mocap'),
        *(library('biped3d_mocap', style=style) for style in STYLES),
    ]
