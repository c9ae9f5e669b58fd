"""Measures what worlds that vary, pushes and sensors cost.

    python benchmarks/disturbances.py [IDS ...] [--num-envs 64] [--steps 8] [--repeats 8]
        [--json docs/data/disturbances.json]

CPU time per step and per reset of one simulation, in microseconds, on one thread: the smallest of
the repeats, because machines are shared. The actions are zeros; the options are measured in turn.
"""

from __future__ import annotations

import argparse
import pathlib
import time

import numpy as np

from trl_suite.util import files, tables
from trl_suite.util.program import begin_script
from trl_suite.vector import VectorEnvironment

IDS = ('PD_Biped2D_Gaps_Terrain-v0', 'PD_Biped3D_Imitate-Hills_Terrain-v0')
OPTIONS = {
    'none': {},
    'friction, damping, gravity, slope': {
        'randomize': {'friction': (0.5, 1), 'damping': (1, 2), 'gravity': (9, 10), 'slope': (0, 0.1)}
    },
    'mass, link_mass, inertia, com_offset': {
        'randomize': {'mass': (1, 2), 'link_mass': (1, 2), 'inertia': (1, 2), 'com_offset': 0.1}
    },
    'push': {'randomize': {'push': {'force': 1.0, 'interval': 0.0}}},
    'noise of all blocks': {'sensors': {'noise': 0.01}},
    'terrain_dropout': {'sensors': {'terrain_dropout': 0.05}},
    'delay of all blocks, 3 steps': {'sensors': {'delay': 3}},
    'both presets `robot`': {'randomize': 'robot', 'sensors': 'robot'},
}  # fmt: skip


def measure(environments: VectorEnvironment, steps: int) -> tuple[float, float]:
    """Returns CPU time of a step and of a reset of one simulation, us."""
    n = environments.num_envs
    action = np.zeros((n, len(environments.action_map)))
    begin = time.thread_time()
    environments.reset()
    reset = time.thread_time() - begin
    begin = time.thread_time()
    for _ in range(steps):
        environments.step(action)
    return 1e6 * (time.thread_time() - begin) / (n * steps), 1e6 * reset / n


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('ids', nargs='*', default=IDS)
    parser.add_argument('--num-envs', type=int, default=64)
    parser.add_argument('--steps', type=int, default=8, help='so few that no episode ends')
    parser.add_argument('--repeats', type=int, default=8)
    parser.add_argument('--json', type=pathlib.Path, help='also write the figures to this file')
    arguments = parser.parse_args()
    figures: dict[str, dict[str, dict[str, float]]] = {}
    for id_ in arguments.ids:
        made = {
            name: VectorEnvironment(id_, arguments.num_envs, 1, 0, task_kwargs=options)
            for name, options in OPTIONS.items()
        }
        found = {name: np.full(2, np.inf) for name in made}
        for _ in range(1 + arguments.repeats):  # the first one compiles
            for name, environments in made.items():
                found[name] = np.minimum(found[name], measure(environments, arguments.steps))
        figures[id_] = {
            name: {'step': round(step, 1), 'reset': round(reset, 1)}
            for name, (step, reset) in found.items()
        }
        cells = [(name, f'{step:.1f}', f'{reset:.0f}') for name, (step, reset) in found.items()]
        print(id_, tables.table(('options', 'step (us)', 'reset (us)'), cells), sep='\n')
    if arguments.json is not None:
        files.write_json(figures, arguments.json)


if __name__ == '__main__':
    begin_script()
    main()
