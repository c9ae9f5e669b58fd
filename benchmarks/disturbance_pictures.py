"""Draws what each option of worlds and sensors does, for docs/realism.md.

    python benchmarks/disturbance_pictures.py [NAMES ...] [--output docs/pictures/realism]

Writes `worlds.png`, `sensors.png`, `push.png` and `randomized.png`; with names only these. Needs `pip install 'trl_suite[video]'` and a
shipped policy of each environment.
"""

from __future__ import annotations

import argparse
import pathlib
from typing import Any

import matplotlib

matplotlib.use('Agg')
import matplotlib.pyplot as plt
import numpy as np

from trl_suite import policies, rendering, suite
from trl_suite.util import errors, files, resources
from trl_suite.util.program import begin_script

WALK, GROUND, PUSHED = 'PD_Biped2D_Flat-v0', 'PD_Biped2D_Gaps_Terrain-v0', 'PD_Biped3D_Imitate-v0'
STEPS = 150
WORLDS: dict[str, tuple[Any, ...]] = {
    'friction': (0.4, 0.2, 0.1), 'mass': (0.7, 1.3, 1.6),
    'link_mass': ((0.8, 1.2), (0.5, 1.5), (0.2, 1.8)), 'inertia': (0.5, 2.0, 4.0),
    'com_offset': (0.03, 0.06, 0.12), 'damping': (2.0, 4.0, 8.0), 'gravity': (5.0, 13.0, 16.0),
    'slope': (-0.15, 0.1, 0.2),
}  # fmt: skip
UNITS = {'com_offset': ' m', 'gravity': ' m/s²', 'slope': ' rad'}
SENSORS: dict[str, dict[str, Any]] = {
    'noise: 0.06 m': {'noise': {'terrain': 0.06}},
    'bias: 0.1 m': {'bias': {'terrain': 0.1}},
    'terrain_dropout: 0.2': {'terrain_dropout': 0.2},
    'delay: 12 steps': {'delay': {'terrain': 12}},
}


def roll(id_: str, steps: int, **options: Any) -> tuple[Any, list[float], list[float]]:
    """Runs the shipped policy; returns the environment, times and root positions of the episode."""
    environment, policy = suite.make(id_, {'random': 4, **options}), policies.reference(id_)
    time_step, times, places = environment.reset(), [0.0], [0.0]
    while len(times) <= steps and not time_step.last():
        time_step = environment.step(policy(time_step.observation))
        times.append(environment.physics.time())
        places.append(environment.info['distance'])
    return environment, times, places


def draw_worlds(path: pathlib.Path) -> None:
    """Distance over time of a walk under constant values of each property, and of one with pushes."""
    figure, axes = plt.subplots(3, 3, figsize=(10, 8), sharex=True, layout='constrained')
    _, times, plain = roll(WALK, STEPS)
    for axis, (name, values) in zip(axes.flat, WORLDS.items(), strict=False):
        axis.plot(times, plain, color='black', label='none')
        for value in values:
            _, moments, places = roll(WALK, STEPS, randomize={name: value})
            label = ' to '.join(f'{each:g}' for each in np.ravel(value)) + UNITS.get(name, '')
            (line,) = axis.plot(moments, places, label=label)
            if len(places) <= STEPS:  # a fall
                axis.plot(moments[-1], places[-1], 'x', color=line.get_color())
        axis.set_title(name)
        axis.legend(fontsize=7)
    axis = axes.flat[len(WORLDS)]
    axis.plot(times, plain, color='black', label='none')
    for speed in (0.5, 1.0, 1.5):
        push = {'speed': speed, 'duration': 0.2, 'interval': 1.0, 'direction': np.pi}
        _, moments, places = roll(WALK, STEPS, randomize={'push': push})
        (line,) = axis.plot(moments, places, label=f'-{speed:g} m/s')
        if len(places) <= STEPS:
            axis.plot(moments[-1], places[-1], 'x', color=line.get_color())
    for start in np.arange(1.0, times[-1], 1.2):
        axis.axvspan(start, start + 0.2, color='0.9')
    axis.set_title('push (grey)')
    axis.legend(fontsize=7)
    for axis in axes[-1]:
        axis.set_xlabel('time (s)')
    for axis in axes[:, 0]:
        axis.set_ylabel('distance (m)')
    with files.replacing(path) as part:
        figure.savefig(part, dpi=90)


def draw_sensors(path: pathlib.Path) -> None:
    """The observed ground at one moment, exact and with each option of sensors."""
    figure, axes = plt.subplots(1, 4, figsize=(12, 2.6), sharey=True, layout='constrained')
    for axis, (title, options) in zip(axes, SENSORS.items(), strict=True):
        environment = suite.make(
            GROUND, {'random': 4, 'sensors': options}, {'flat_observation': True}
        )
        policy = policies.reference(GROUND)
        environment.reset()
        for _ in range(70):  # actions from the exact observation: the same walk in each panel
            clean = environment.info['clean_observation'] if environment.info else None
            time_step = environment.step(policy({'observations': clean}))
        part = environment.blocks['terrain']
        x = np.linspace(-0.5, 3.0, part.stop - part.start)
        axis.plot(x, environment.info['clean_observation'][part], color='black', label='exact')
        axis.plot(x, time_step.observation['observations'][part], '.', label='observed')
        axis.set_title(title)
        axis.set_xlabel('position ahead (m)')
    axes[0].set_ylabel('height (m)')
    axes[0].legend()
    with files.replacing(path) as part:
        figure.savefig(part, dpi=90)


def draw_push(path: pathlib.Path) -> None:
    """A film strip of a walker that is pushed from the right."""
    push = {'force': 100, 'duration': 0.3, 'interval': 0.8, 'direction': np.pi / 2, 'body': 'torso'}
    environment = suite.make(PUSHED, {'random': 4, 'randomize': {'push': push}})
    policy, time_step, frames = policies.reference(PUSHED), environment.reset(), []
    for k in range(57):
        time_step = environment.step(policy(time_step.observation))
        if k >= 20 and k % 6 == 2:
            frames.append(rendering.frame(environment, 240, 180, 'back'))
    rendering.film_strip(frames, path, len(frames))


def draw_randomized(path: pathlib.Path) -> None:
    """Learning curves of the policies that were trained in randomized worlds."""
    ids = policies.available('randomized')
    figure, axes = plt.subplots(
        2, -(-len(ids) // 2), figsize=(11, 4.6), squeeze=False, layout='constrained'
    )
    for axis in axes.flat[len(ids) :]:
        axis.remove()
    for axis, id_ in zip(axes.flat, ids, strict=False):
        entry = files.read_json(resources.directory('trained') / 'randomized' / f'{id_}.json')
        curve = [[point['samples'], point['normalized_return']] for point in entry['curve']]
        samples, returns = np.transpose(curve)
        axis.plot(samples / 1e6, returns, '.-')
        axis.plot(entry['shipped_at'] / 1e6, np.max(returns), 'o', fillstyle='none')
        preset = entry['settings']['evaluated_with']['randomize']
        before = entry['before'][preset]['return'] / suite.find(id_).step_limit
        axis.axhline(before, color='grey', linestyle=':')
        axis.set_title(f'{id_}, {preset}', fontsize=7)
        axis.set_xlim(0)
    for axis in axes[-1]:
        axis.set_xlabel('samples (M)')
    for axis in axes[:, 0]:
        axis.set_ylabel('return with the preset')
    with files.replacing(path) as part:
        figure.savefig(part, dpi=90)


PICTURES = {
    'worlds': draw_worlds, 'sensors': draw_sensors, 'push': draw_push, 'randomized': draw_randomized,
}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('names', nargs='*', default=list(PICTURES), help='pictures')
    parser.add_argument(
        '--output', type=pathlib.Path, default=pathlib.Path('docs/pictures/realism')
    )
    arguments = parser.parse_args()
    errors.check_known('picture', PICTURES, *arguments.names)
    arguments.output.mkdir(parents=True, exist_ok=True)
    for name in arguments.names:
        PICTURES[name](arguments.output / f'{name}.png')
        print(arguments.output / f'{name}.png', flush=True)


if __name__ == '__main__':
    begin_script()
    main()
