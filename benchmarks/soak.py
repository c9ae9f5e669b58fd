"""Runs the vector environment for long: memory must stay flat, every number finite.

    python benchmarks/soak.py [--steps 2000000] [--num_envs 256] [--threads 1] [--seed 0]

Goes over several environments in turn under random actions and prints, for each, control steps,
episodes, divergences, largest |observation|, and resident memory at the first tenth and the end.
"""

import argparse
import resource

import numpy as np
from tqdm import tqdm

from trl_suite.vector import VectorEnvironment

IDS = (
    'PD_Biped2D_Gaps_Terrain-v0', 'PD_Dog2D_Slopes_Mixed_Terrain-v0',
    'PD_Raptor2D_Steps_Terrain-v0', 'MTU_Biped2D_LLC_Imitate_Flat-v0',
    'Torque_Dog2D_LLC_Imitate_Flat-v0', 'Vel_Raptor2D_LLC_Imitate_Flat-v0',
)  # fmt: skip


def resident_mb():
    with open('/proc/self/statm') as file:
        return int(file.read().split()[1]) * resource.getpagesize() / 1e6


def soak(id_, steps, num_envs, threads, seed):
    environments = VectorEnvironment(id_, num_envs, threads, seed=seed)
    random = np.random.default_rng(seed)
    largest = np.abs(environments.reset()).max()
    episodes = diverged = early = 0
    calls = max(10, steps // num_envs)
    for call in tqdm(range(calls), desc=id_, mininterval=5):
        step = environments.step(random.uniform(-1, 1, (num_envs, len(environments.action_map))))
        assert np.isfinite(step.observation).all() and np.isfinite(step.reward).all(), (id_, call)
        largest = max(largest, np.abs(step.observation).max())
        episodes += int((step.terminated | step.truncated).sum())
        diverged += int(step.info['diverged'].sum())
        if call == calls // 10:
            early = resident_mb()
    print(
        f'{id_}: {calls * num_envs} steps, {episodes} episodes, {diverged} diverged, largest '
        f'{largest:.1f}, memory {early:.1f} -> {resident_mb():.1f} MB',
        flush=True,
    )
    environments.close()


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--steps', type=int, default=2_000_000)
    parser.add_argument('--num-envs', type=int, default=256)
    parser.add_argument('--threads', type=int, default=1)
    parser.add_argument('--seed', type=int, default=0)
    arguments = parser.parse_args()
    for id_ in IDS:
        steps = arguments.steps // len(IDS)
        soak(id_, steps, arguments.num_envs, arguments.threads, arguments.seed)


if __name__ == '__main__':
    main()
