"""Measures the cost of learning: samples per second of training/ppo.py and of random actions.

    python benchmarks/training.py [--seconds S] [--threads N] [--torch-threads N]

Both rates are measured alternately in one process with the same number of simulations and threads;
the ratio is the result.
"""

import argparse
import pathlib
import sys
import time

import numpy as np
import torch

from trl_suite.vector import VectorEnvironment

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / 'training'))
import ppo

IDS = (
    'PD_Biped2D_LLC_Imitate_Flat-v0',
    'PD_Biped2D_Gaps_Terrain-v0',
    'PD_Raptor2D_LLC_Imitate_Flat-v0',
    'PD_Dog2D_Slopes_Terrain-v0',
)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--seconds', type=float, default=20.0, help='per environment and rate')
    parser.add_argument('--threads', type=int, default=2, help='of the simulation')
    parser.add_argument('--torch-threads', type=int, default=1, help='of the networks')
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.torch_threads)
    print('samples per second, learning / random actions: ratio')
    for id_ in IDS:
        trainer = ppo.Trainer(id_, 0, ppo.settings_for(id_), arguments.threads)
        rows = trainer.settings.num_envs
        environments = VectorEnvironment(id_, rows, arguments.threads, 0)
        environments.reset()
        size = len(environments.action_map)
        actions = np.random.default_rng(0).uniform(-1, 1, (50, rows, size))
        steps, seconds = {'learning': 0, 'random': 0}, {'learning': 0.0, 'random': 0.0}
        trainer.learn(trainer.collect())
        while min(seconds.values()) < arguments.seconds:
            begin = time.perf_counter()
            before = trainer.samples
            trainer.learn(trainer.collect())
            seconds['learning'] += time.perf_counter() - begin
            steps['learning'] += trainer.samples - before
            begin = time.perf_counter()
            for action in actions:
                environments.step(action)
            seconds['random'] += time.perf_counter() - begin
            steps['random'] += rows * len(actions)
        learning, random = (steps[kind] / seconds[kind] for kind in steps)
        print(f'{id_}: {learning:.0f} / {random:.0f}: {learning / random:.2f}', flush=True)


if __name__ == '__main__':
    main()
