"""Fits the parameters of a run by least squares: python mocap/recipes/fit.py biped2d_run.

The residuals measure deviations from textbook joint curves, feet below the ground, and inverse
dynamics that are not feasible: only gravity acts in flight, and in stance the ground force passes
through the foot. Weights were found by trial. The result depends on the start: each run starts from
a slower or coarser one in `STARTS` and reaches its speed in stages.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable, Mapping

import figure
import numpy as np
import run
from scipy import interpolate, optimize
from walk import series

SAMPLES = 60
LOW = 0.003  # m; a corner lower than this carries force

# Normative curves of running: percent of the cycle from landing to degrees, flexion positive.
HIP = {0: 38, 10: 34, 20: 18, 37: -9, 50: 10, 65: 42, 78: 52, 90: 45}
KNEE = {0: -15, 14: -42, 26: -32, 37: -16, 50: -62, 65: -104, 72: -98, 82: -62, 92: -20}
ANKLE = {0: 5, 17: 22, 28: 8, 38: -21, 50: -6, 65: 7, 85: 5}
# Weak reference of the raptor: Fourier series of the run of its gait state machine, rad.
RAPTOR = (
    (0.0365, 0.4445, -0.9995, -0.0007, -0.1801, -0.0886, 0.0428, -0.0270, 0.0487),
    (-1.4468, 0.0747, 1.4903, 0.1043, -0.2070, -0.0212, -0.0474, 0.1016, 0.0068),
    (1.4287, 0.5229, -0.4540, -0.0848, 0.3891, 0.0473, 0.0520, -0.0905, -0.0088),
    (-0.4813, -0.2009, -0.0551, -0.1590, -0.1590, -0.0197, -0.1670, 0.0325, -0.0635),
)

# Earlier runs to start from, with the foot slow to leave and meet the ground (rise 3).
STARTS = {
    'biped2d_run': run.Run(
        'biped2d',
        0.62,
        3.4,
        run.shape(
            stance=(0.2917, 0.1544, 0.6258, 0.12, -4.0, -0.5, -12.0),
            swing=(0.2014, -1.2809, 0.7076, -0.35, 4.1257, 9.6333),
            path=(0.2029, -0.0786, 3.0, 3.0, 0.7893, 0.22),
            pelvis=(-0.0601, 0.0082, -0.03, -0.0087, -0.015),
        ),
    ),
    'raptor_run_066': run.Run(
        'raptor',
        0.66,
        4.05,
        run.shape(
            stance=(0.2084, 0.2777, 0.5457, 0.15, -1.0, -0.301, -12.0834),
            swing=(0.3976, -1.6904, 0.8491, 0.2295, 4.7544, 10.03),
            path=(0.1837, -0.1464, 3.0, 8.7445, 0.4411, 0.1863),
            pelvis=(0.0314, -0.0343, 0.05, -0.0054, 0.0133),
            metatarsus=(1.1986, 0.9807, 0.1291, -1.1591, -0.0808),
        ),
    ),
    'raptor_run_050': run.Run(
        'raptor',
        0.5,
        3.95,
        run.shape(
            stance=(0.25, 0.3653, 0.4758, 0.1443, -1.0, -0.3002, -12.7737),
            swing=(0.2717, -1.4474, 0.7683, 0.0913, 2.0462, 5.3748),
            path=(0.1906, -0.1316, 3.0, 4.9387, 0.4752, 0.1201),
            pelvis=(0.0072, -0.0105, 0.0398, -0.0043, 0.0094),
            metatarsus=(1.0267, 0.8279, 0.0988, -1.0763, 0.136),
        ),
    ),
}
# Speed m/s and period s of the stages to each clip; the last is the clip's.
PACES = {
    'biped2d_run': ((3.8, 0.5), (4.2, 0.5), (4.656, 0.5)),
    'raptor_run_050': ((3.95, 0.5),),
    'raptor_run_066': ((4.05, 0.66),),
}
# A quicker touch-down and take-off than the starts': the foot does not scuff.
QUICKER = {
    'biped2d_run': {'rise': 2.0},
    'raptor_run_050': {'rise': 2.0, 'lift': 0.14},
    'raptor_run_066': {'rise': 2.0, 'lift': 0.14},
}
NARROWER = {  # chosen by hand: shorter stances and more lean have lower costs, but harder landings
    'biped2d': {'ds': (0.26, 0.36), 'lean': (-0.14, 0.1)},
    'raptor': {'ds': (0.21, 0.36)},
}

BOUNDS = {
    'ds': (0.18, 0.36),
    'ff': (0.15, 0.45),
    'ho': (0.45, 0.75),
    'th0': (-0.15, 0.15),
    'tto': (-0.9, -0.3),
    'rto': (-16, -5),
    'sa': (0.15, 0.4),
    'ta': (-1.9, -0.6),
    'sb': (0.6, 0.85),
    'tb': (-0.5, 0.3),
    'qa': (0, 14),
    'qb': (0, 14),
    'lift': (0.08, 0.35),
    'lsk': (-0.5, 0.5),
    'ax': (0, 9),
    'z': (0.4, 0.85),
    'lean': (-0.2, 0.1),
    'pc2': (-0.05, 0.05),
    'ps2': (-0.05, 0.05),
    'pc4': (-0.015, 0.015),
    'ps4': (-0.015, 0.015),
    'xl': (0.08, 0.34),
    'b0': (0.2, 1.4),
    'b1': (0.0, 1.2),
    'b2': (-0.8, 0.8),
    'b3': (-1.5, 0.0),
    'b4': (-0.6, 0.8),
}


def textbook(phase: np.ndarray, raptor: bool) -> np.ndarray:
    """Returns the target curves of the right leg's joints, rad, (n, joints)."""
    if raptor:
        return np.stack([series(joint, phase) for joint in RAPTOR], axis=1)
    return np.radians(
        np.stack(
            [
                interpolate.CubicSpline(
                    [*(k / 100 for k in keys), 1], [*keys.values(), keys[0]], bc_type='periodic'
                )(phase)
                for keys in (HIP, KNEE, ANKLE)
            ],
            axis=1,
        )
    )


def dynamics(made: run.Build, poses: np.ndarray, period: float, speed: float):
    """Returns force / weight (n, 2), moment about the centre of mass (n,) N m, and that centre."""
    dt = period / len(poses)
    body = made.figure
    drift = np.array([speed * period, 0])

    def rate(values, jump=0.0):
        after = np.concatenate([values[1:], values[:1] + jump])
        before = np.concatenate([values[-1:] - jump, values[:-1]])
        return (after - before) / (2 * dt)

    com, pitch = body.forward(poses)
    centre = np.einsum('l,nlk->nk', body.mass, com) / body.mass.sum()
    arm, swing = com - centre[:, None], rate(com, drift) - rate(centre, drift)[:, None]
    spin = (arm[..., 0] * swing[..., 1] - arm[..., 1] * swing[..., 0]) @ body.mass
    spin += rate(pitch) @ body.inertia
    closed = np.concatenate([centre[-1:] - drift, centre, centre[:1] + drift])
    acceleration = np.diff(closed, 2, axis=0) / dt**2
    return acceleration / run.GRAVITY + [0, 1], rate(spin), centre


def residuals(guess: run.Run, physics: float) -> np.ndarray:
    """Returns the residuals; `physics` is the weight of the inverse dynamics."""
    made, p = run.build(guess.character), guess.shape
    raptor = 'toe' in made.leg
    phase = (np.arange(SAMPLES) + 0.5) / SAMPLES
    poses = run.poses(guess, phase, passes=2)
    first = 3 + made.joints.index(f'right_{made.leg[0]}')
    leg = poses[:, first : first + len(made.leg)]
    _, wanted = run.leg_angles(guess, made, poses[:, :2], poses[:, 2], phase)
    path, pitch, tau = run.foot(guess, made.foot, phase)
    toe, heel, height = made.foot
    ends = np.stack([path + figure.rotate(np.array([x, -height]), pitch) for x in (toe, heel)], 1)
    swinging = ~np.isnan(tau)
    share = np.minimum(phase / p['ds'], 1)

    out = []
    add = out.append
    weights = (0.15,) * 4 if raptor else (0.4, 0.4, 0.25)
    add((leg - textbook(phase, raptor)) * weights)
    wrapped = np.concatenate([leg[-1:], leg, leg[:1]])
    dt = guess.period / SAMPLES
    add((8e-5 if raptor else 1e-4) * np.diff(wrapped, 2, axis=0) / dt**2)
    add(8 * np.maximum(0, leg[:, 1] + (0.15 if raptor else 0.12)))
    add(80 * np.maximum(0, wanted - (0.99 if raptor else 0.997)))
    if raptor:
        add(8 * np.maximum(0, 0.2 - leg[:, 2]))
        add(7 * np.maximum(0, np.abs(leg[:, [0, 3]]) - 1.45))
        add(8 * np.maximum(0, -2.85 - leg[:, 1]))
    landing = ~swinging & (share < p['ff'])
    leaving = ~swinging & (share > p['ho'])
    add(6 * np.where(landing, np.minimum(np.sign(p['th0']) * pitch, 0), 0))
    add(6 * np.where(leaving, np.maximum(pitch, 0), 0))
    clear = 0.03 * np.sin(np.pi * np.nan_to_num(tau))[:, None]
    add(40 * np.where(swinging[:, None], np.maximum(0, clear - ends[..., 1]), 0))
    add(60 * np.minimum(0, ends[..., 1]))
    forward = np.gradient(ends[..., 0], phase * guess.period, axis=0)
    near = np.clip(1 - ends[..., 1] / 0.008, 0, 1) * swinging[:, None]
    add(0.2 * near * forward)

    force, moment, centre = dynamics(made, poses, guess.period, guess.speed)
    step = phase % 0.5
    stance = step < p['ds']
    weight = made.figure.mass.sum() * run.GRAVITY
    add(physics * 0.5 * np.where(stance[:, None], 0, force))
    add(physics * 0.06 * np.where(stance, 0, moment) / made.figure.mass.sum())
    # Where the ground force must act: on the planted foot, between its low corners.
    path, pitch, _ = run.foot(guess, made.foot, step)
    corners = np.stack(
        [path + figure.rotate(np.array([x, -height]), pitch) for x in (heel, toe)], 1
    )
    shift = np.where(phase < 0.5, 0, guess.speed * guess.period / 2)
    x = corners[..., 0] + shift[:, None]
    low = corners[..., 1] < LOW
    left = np.where(low, x, np.inf).min(axis=1)
    right = np.where(low, x, -np.inf).max(axis=1)
    push = np.maximum(force[:, 1], 0.1)
    zmp = centre[:, 0] + (moment / weight - centre[:, 1] * force[:, 0]) / push
    beyond = np.where(low.any(axis=1), np.maximum(0, np.maximum(left - zmp, zmp - right)), 0)
    add(physics * 0.5 * np.where(stance, beyond * np.minimum(push, 1), 0))
    slip = np.maximum(0, np.abs(force[:, 0]) / push - 0.5)
    add(physics * 0.2 * np.where(stance & (force[:, 1] > 0.2), slip, 0))
    return np.concatenate([np.ravel(part) for part in out])


def fit(
    start: run.Run,
    bounds: Mapping[str, tuple[float, float]],
    residuals: Callable[[run.Run, float], np.ndarray],
    evaluations: int = 25,
) -> tuple[run.Run, float]:
    """Returns the run of the same pace with fitted figures, and the final cost.

    Args:
      start: where the search begins.
      bounds: of those figures that are fitted.
      residuals: of a run, with a weight of its inverse dynamics; see `residuals`.
      evaluations: the most, of each of two stages.
    """
    names = [name for name in bounds if name in start.shape]
    low, high = np.array([bounds[name] for name in names]).T

    def guess(x):
        return dataclasses.replace(start, shape={**start.shape, **dict(zip(names, x, strict=True))})

    x = np.array([start.shape[name] for name in names])
    for physics in (0.3, 1.0):
        result = optimize.least_squares(
            lambda x, physics=physics: residuals(guess(x), physics),
            np.clip(x, low + 1e-6, high - 1e-6),
            bounds=(low, high),
            x_scale=high - low,
            max_nfev=evaluations,
        )
        x = result.x
    return guess(x.tolist()), float(result.cost)


def find(name: str) -> tuple[run.Run, float]:
    """Returns the run of a clip from its start, stage by stage, and its final cost."""
    found, cost = STARTS[name], np.inf
    found = dataclasses.replace(found, shape={**found.shape, **QUICKER[name]})
    bounds = BOUNDS | NARROWER[found.character]
    for speed, period in PACES[name]:
        pace = dataclasses.replace(found, speed=speed, period=period)
        found, cost = fit(pace, bounds, residuals)
    return found, cost


def main(names: list[str]) -> None:
    for name in names or STARTS:
        found, cost = find(name)
        print(f'{name}: {found.character}, {found.speed} m/s, {found.period} s, cost {cost:.3f}')
        for group, keys in run.SHAPE.items():
            if keys[0] in found.shape:
                row = ', '.join(f'{round(found.shape[key], 4)}' for key in keys)
                print(f'    {group}=({row}),', flush=True)


if __name__ == '__main__':
    main(sys.argv[1:])
