"""Three-dimensional runs: feet and centre of mass as in `run.py`, and a pelvis that turns.

The feet move on two lines and turn out slightly; the pelvis turns, drops and sways with the legs,
and the torso turns against it. The free parameters are in `RUNS`, as fitted by `fit3d.py`.
"""

from __future__ import annotations

import dataclasses

import figure3d
import numpy as np
import run

from trl_suite import motion

PASSES = 8  # fixed-point passes that place the pelvis under the prescribed centre of mass
LINE = 0.075  # m, lateral distance of the feet from the middle
TOE_OUT = 0.06  # rad
# Parameters besides those of `run.Run`. rot, list, sway: amplitudes of the pelvis's yaw and roll,
# rad, and of its lateral displacement, m; rph, lph, sph: their phases; tyaw: turn of the torso in
# the world per turn of the pelvis the other way; tlean: its mean pitch there, rad; it nods with the
# pelvis.
SPACE = ('rot', 'rph', 'list', 'lph', 'sway', 'sph', 'tyaw', 'tlean')


def shape(space: tuple[float, ...], **groups: tuple[float, ...]) -> dict[str, float]:
    """Returns parameters by name from tuples in the order of `SPACE` and `run.SHAPE`."""
    return {**run.shape(**groups), **dict(zip(SPACE, space, strict=True))}


def bodies(made: run.Run, phase: np.ndarray, passes: int = PASSES) -> figure3d.Bodies:
    """Returns a run at given phases, (n,); the right foot lands at every whole phase."""
    body, p = figure3d.figure(made.character), made.shape
    cycle = 2 * np.pi * phase
    nod = sum(p[f'pc{k}'] * np.cos(k * cycle) + p[f'ps{k}'] * np.sin(k * cycle) for k in (2, 4))
    turn = p['rot'] * np.cos(cycle + p['rph'])
    drop = -p['list'] * np.sin(cycle + p['lph'])
    sway = -p['sway'] * np.sin(cycle + p['sph'])
    hips = figure3d.yaw(turn) @ figure3d.pitch(p['lean'] + nod) @ figure3d.roll(drop)
    torso = figure3d.yaw(-p['tyaw'] * turn) @ figure3d.pitch(p['tlean'] + nod)
    joints: dict[str, np.ndarray] = {'torso': figure3d.between(hips, torso)}
    centre = run.centre_of_mass(made, phase)
    root = np.stack([centre[:, 0], sway, centre[:, 1]], axis=-1)
    feet = {}
    for side, later, sign in (('right', 0.0, -1), ('left', 0.5, 1)):
        facing = np.full_like(phase, sign * TOE_OUT)
        ankle, tilt = foot(made, phase + later, facing)
        ankle += -later * made.speed * made.period, sign * LINE, 0
        feet[side] = ankle, facing, figure3d.yaw(facing) @ figure3d.pitch(tilt)
    for _ in range(passes + 1):
        reach = []
        for side, (ankle, facing, sole) in feet.items():
            hip = root + figure3d.apply(hips, body.joint(f'{side}_hip'))
            thigh, knee, wanted = figure3d.leg(body.leg, hip, ankle, 0.5 * (facing + turn))
            joints[f'{side}_hip'] = figure3d.between(hips, thigh)
            joints[f'{side}_knee'] = knee
            joints[f'{side}_ankle'] = figure3d.between(thigh @ figure3d.pitch(knee), sole)
            reach.append(wanted)
        found = figure3d.Bodies(root, hips, joints, np.stack(reach, axis=-1))
        root = root + (centre - body.centre(found)[:, ::2]) @ [[1, 0, 0], [0, 0, 1]]
    return dataclasses.replace(found, root=root)


def foot(made: run.Run, phase: np.ndarray, facing: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns path (n, 3) and pitch (n,) of a right foot that rolls along its yaw, rad (n,)."""
    path, tilt, tau = run.foot(made, figure3d.FOOT, phase)
    flat = phase % 1 < made.shape['ff'] * made.shape['ds']
    to_heel = np.where(np.isnan(tau), flat, figure3d.smooth(np.nan_to_num(tau)))
    toe, heel, _ = figure3d.FOOT
    shift = to_heel * figure3d.rolled(tilt, heel)[:, 0]
    shift += (1 - to_heel) * figure3d.rolled(tilt, toe)[:, 0]
    x = path[:, 0] + shift * (np.cos(facing) - 1)
    return np.stack([x, shift * np.sin(facing), path[:, 1]], axis=-1), tilt


RUNS = {
    'biped3d_run': run.Run(
        'biped3d',
        0.5,
        4.656,
        shape(
            stance=(0.26, 0.3129, 0.45, 0.15, -4.0, -0.6506, -16.0),
            swing=(0.15, -1.2388, 0.6668, -0.5, 4.6791, 8.1981),
            path=(0.1731, -0.0039, 2.0, 2.1063, 0.7096, 0.1804),
            pelvis=(-0.14, 0.0176, -0.039, -0.0008, -0.015),
            space=(0.16, 0.7958, 0.08, 0.1801, 0.0062, 0.898, 1.65, -0.05),
        ),
    ),
    'biped3d_mocap_run': run.Run(
        'biped3d_mocap_run',
        0.6,
        1.15 / 0.3,
        shape(
            stance=(0.28, 0.246, 0.45, 0.15, -4.0, -0.677, -14.5331),
            swing=(0.15, -1.2861, 0.7695, -0.1338, 5.0587, 8.0363),
            path=(0.2032, -0.0999, 2.0, 2.035, 0.8754, 0.19),
            pelvis=(-0.15, 0.0013, -0.045, 0.0138, -0.015),
            space=(0.16, 0.7646, 0.08, -0.0754, 0.0085, 0.5721, 1.6484, -0.05),
        ),
    ),
    'biped3d_full_run': run.Run(
        'biped3d_full_mocap',
        0.6,
        1.15 / 0.3,
        shape(
            stance=(0.28, 0.2468, 0.45, 0.15, -4.0, -0.6716, -15.2062),
            swing=(0.15, -1.3, 0.7485, -0.2168, 5.0427, 7.9488),
            path=(0.2024, -0.0395, 2.0, 2.1449, 0.8226, 0.1831),
            pelvis=(-0.15, 0.0061, -0.0447, 0.0136, -0.015),
            space=(0.16, 0.8071, 0.08, -0.0606, 0.0076, 0.5839, 1.65, -0.05),
        ),
    ),
}
RATE = 240  # frames per second of a clip
STEP_RATE = 120  # frames per second of a library


def clip(name: str) -> motion.Clip:
    """Returns a run of the table."""
    made = RUNS[name]
    body = figure3d.figure(made.character)
    phase = np.linspace(0, 1, round(RATE * made.period) + 1)
    table = body.poses(bodies(made, phase))
    table[:, 0] -= table[0, 0]
    table[-1, 1:] = table[0, 1:]
    arms = ' with arms' if 'right_shoulder' in body.layout.joints else ''
    return motion.Clip(
        name,
        made.period * phase,
        table,
        'free',
        body.layout.joints,
        body.layout.sizes,
        True,
        f'run at {made.speed:.4g} m/s, two steps in {made.period:g} s{arms}',
    )


def clips() -> list[motion.Clip]:
    """Returns the clips of this recipe."""
    return [clip(name) for name in RUNS]


def library() -> motion.FootstepLibrary:
    """Returns the first half of the run in lighter legs as a library of one step."""
    made = RUNS['biped3d_mocap_run']
    body = figure3d.figure(made.character)
    phase = np.linspace(0, 0.5, round(STEP_RATE * made.period / 2) + 1)
    found = bodies(made, phase)
    table = body.poses(found)
    table[:, :2] += -made.shape['xl'], LINE  # the position of the flat stance foot is the origin
    label = (made.speed * made.period / 2, 2 * LINE, 0.0)
    return motion.FootstepLibrary(
        name=made.character,
        times=made.period * phase,
        poses=table[None],
        joints=body.layout.joints,
        sizes=body.layout.sizes,
        labels=np.array([label]),
        previous=np.array([label]),
        features=figure3d.features(body, found, 0.0)[None],
        description=f'a running step of {made.period / 2:g} s',
    )


def libraries() -> list[motion.FootstepLibrary]:
    """Returns the step libraries of this recipe."""
    return [library()]
