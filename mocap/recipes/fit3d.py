"""Fits the parameters of a 3D run by least squares: python mocap/recipes/fit3d.py [name ...].

The residuals are those of `fit.py`, in three dimensions: joint curves like textbook running, feet
clear of the ground, only gravity in flight, and in stance a force that passes through the foot.
"""

from __future__ import annotations

import dataclasses
import functools
import sys
from collections.abc import Mapping

import figure
import figure3d
import fit
import numpy as np
import run
import run3d

# A first run to start from, with the foot slow to leave and meet the ground (rise 3).
START = run.Run(
    'biped3d_mocap_run',
    0.6,
    1.15 / 0.3,
    run3d.shape(
        stance=(0.2794, 0.1833, 0.5885, 0.12, -4.0, -0.5, -12.0),
        swing=(0.2906, -1.4059, 0.7133, -0.35, 3.0588, 8.1408),
        path=(0.2277, -0.0485, 3.0, 3.0, 0.8527, 0.22),
        pelvis=(-0.1468, 0.0017, -0.03, -0.015, -0.015),
        space=(0.16, 0.4518, 0.08, -0.196, 0.0088, 0.4924, 1.6512, -0.05),
    ),
)
_SPACE = {name: START.shape[name] for name in run3d.SPACE}
_PLANAR = run.RUNS['biped2d_run']  # its legs are those of biped3d
STARTS = {
    'biped3d_mocap_run': dataclasses.replace(START, shape={**START.shape, 'rise': 2.0}),
    'biped3d_full_run': dataclasses.replace(
        START, character='biped3d_full_mocap', shape={**START.shape, 'rise': 2.0}
    ),
    'biped3d_run': dataclasses.replace(
        _PLANAR, character='biped3d', shape={**_PLANAR.shape, **_SPACE}
    ),
}
BOUNDS: Mapping[str, Mapping[str, tuple[float, float]]] = {
    name: {
        **fit.BOUNDS,
        **limits,
        'z': (0.6, 1.0),
        'rot': (0.05, 0.16),
        'rph': (-1.0, 1.0),
        'list': (0.03, 0.08),
        'lph': (-1.0, 1.0),
        'sway': (0.0, 0.03),
        'sph': (-1.0, 1.0),
        'tyaw': (0.5, 1.65),
    }
    for name, limits in {
        'biped3d_mocap_run': {'ds': (0.28, 0.36), 'lean': (-0.15, 0.1)},
        'biped3d_full_run': {'ds': (0.28, 0.36), 'lean': (-0.15, 0.1)},
        'biped3d_run': fit.NARROWER['biped2d'],
    }.items()
}


@dataclasses.dataclass(frozen=True)
class Dynamics:
    """Force over weight, moment about the centre of mass in N m, that centre in m, each (n, 3)."""

    force: np.ndarray
    moment: np.ndarray
    centre: np.ndarray


@functools.cache
def inertias(character: str) -> np.ndarray:
    """Returns the inertia of every link about its centre of mass, in its frame, (links, 3, 3)."""
    m = figure3d.model(character)
    found = []
    for link in ('root', *figure3d.JOINTS[character]):
        body = m.body(link).id
        frame = figure3d.matrices(m.body_iquat[body][None])[0]
        found.append(frame @ np.diag(m.body_inertia[body]) @ frame.T)
    return np.array(found)


def dynamics(made: run.Run, bodies: figure3d.Bodies) -> Dynamics:
    """Returns what acts on a body over a cycle, evenly sampled."""
    body = figure3d.figure(made.character)
    position, rotation = body.forward(bodies)
    dt = made.period / len(position)
    drift = np.array([made.speed * made.period, 0, 0])

    def rate(values, jump):
        after = np.concatenate([values[1:], values[:1] + jump])
        before = np.concatenate([values[-1:] - jump, values[:-1]])
        return (after - before) / (2 * dt)

    com = position + figure3d.apply(rotation, body.com)
    share = body.mass / body.mass.sum()
    centre = np.einsum('l,nlk->nk', share, com)
    arm, way = com - centre[:, None], rate(com, drift) - rate(centre, drift)[:, None]
    turn = np.roll(rotation, -1, 0) @ np.swapaxes(np.roll(rotation, 1, 0), -1, -2)
    axis = np.stack([turn[..., 2, 1], turn[..., 0, 2], turn[..., 1, 0]], -1)
    axis -= np.stack([turn[..., 1, 2], turn[..., 2, 0], turn[..., 0, 1]], -1)
    sine = np.linalg.norm(axis / 2, axis=-1, keepdims=True)
    omega = axis / 2 * np.arcsin(np.minimum(sine, 1)) / np.maximum(sine, 1e-12) / (2 * dt)
    inertia = rotation @ inertias(made.character) @ np.swapaxes(rotation, -1, -2)
    spin = np.einsum('l,nlk->nk', body.mass, np.cross(arm, way))
    spin += np.einsum('nlij,nlj->ni', inertia, omega)
    closed = np.concatenate([centre[-1:] - drift, centre, centre[:1] + drift])
    acceleration = np.diff(closed, 2, axis=0) / dt**2
    return Dynamics(acceleration / run.GRAVITY + [0, 0, 1], rate(spin, 0), centre)


def residuals(guess: run.Run, physics: float) -> np.ndarray:
    """Returns the residuals; `physics` is the weight of the inverse dynamics."""
    p = guess.shape
    phase = (np.arange(fit.SAMPLES) + 0.5) / fit.SAMPLES
    bodies = run3d.bodies(guess, phase, passes=2)
    leg = np.stack(
        [
            figure3d.angles(bodies.joints['right_hip'])[:, 0],
            bodies.joints['right_knee'],
            figure3d.angles(bodies.joints['right_ankle'])[:, 0],
        ],
        axis=1,
    )
    toe, heel, sole = figure3d.FOOT
    path, pitch, tau = run.foot(guess, figure3d.FOOT, phase)
    ends = np.stack([path + figure.rotate(np.array([x, -sole]), pitch) for x in (toe, heel)], 1)
    swinging = ~np.isnan(tau)
    share = np.minimum(phase / p['ds'], 1)

    out = []
    add = out.append
    add((leg - fit.textbook(phase, raptor=False)) * (0.4, 0.4, 0.25))
    wrapped = np.concatenate([leg[-1:], leg, leg[:1]])
    add(1e-4 * np.diff(wrapped, 2, axis=0) / (guess.period / fit.SAMPLES) ** 2)
    add(8 * np.maximum(0, leg[:, 1] + 0.12))
    add(80 * np.maximum(0, bodies.reach - 0.997))
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

    found = dynamics(guess, bodies)
    mass = figure3d.figure(guess.character).mass.sum()
    step = phase % 0.5
    stance = step < p['ds']
    add(physics * 0.5 * np.where(stance[:, None], 0, found.force))
    add(physics * 0.06 * np.where(stance[:, None], 0, found.moment) / mass)
    # Where the ground force must act: on the planted foot, between its low corners.
    side = np.where(phase < 0.5, -1, 1)
    flat, pitch = run3d.foot(guess, step, run3d.TOE_OUT * side)
    x = np.stack(
        [flat[:, 0] + figure.rotate(np.array([c, -sole]), pitch)[:, 0] for c in (heel, toe)], 1
    )
    x += np.where(phase < 0.5, 0, guess.speed * guess.period / 2)[:, None]
    height = np.stack(
        [flat[:, 2] + figure.rotate(np.array([c, -sole]), pitch)[:, 1] for c in (heel, toe)], 1
    )
    low = height < fit.LOW
    first = np.where(low, x, np.inf).min(axis=1)
    last = np.where(low, x, -np.inf).max(axis=1)
    push = np.maximum(found.force[:, 2], 0.1)
    weight = mass * run.GRAVITY
    lever = found.centre[:, 2:] * found.force[:, :2]
    zmp_x = found.centre[:, 0] - (found.moment[:, 1] / weight + lever[:, 0]) / push
    zmp_y = found.centre[:, 1] + (found.moment[:, 0] / weight - lever[:, 1]) / push
    load = np.where(stance & low.any(axis=1), np.minimum(push, 1), 0)
    with np.errstate(invalid='ignore'):
        beyond = np.maximum(0, np.maximum(first - zmp_x, zmp_x - last))
    beside = np.maximum(0, np.abs(zmp_y - side * run3d.LINE) - 0.045)
    add(physics * 0.5 * np.where(load > 0, beyond, 0) * load)
    add(physics * 0.5 * beside * load)
    slip = np.maximum(0, np.hypot(*found.force[:, :2].T) / push - 0.5)
    add(physics * 0.2 * np.where(stance & (found.force[:, 2] > 0.2), slip, 0))
    return np.concatenate([np.ravel(part) for part in out])


def main(names: list[str]) -> None:
    for name in names or STARTS:
        found, cost = fit.fit(STARTS[name], BOUNDS[name], residuals)
        print(f'{name}: {found.character}, {found.speed} m/s, {found.period} s, cost {cost:.3f}')
        for group, keys in {**run.SHAPE, 'space': run3d.SPACE}.items():
            if keys[0] in found.shape:
                row = ', '.join(f'{round(found.shape[key], 4)}' for key in keys)
                print(f'    {group}=({row}),', flush=True)


if __name__ == '__main__':
    main(sys.argv[1:])
