"""Runs a trained policy in worlds that vary, with pushes and with sensors that are not exact."""

import numpy as np

from trl_suite import policies
from trl_suite.util.program import begin_script
from trl_suite.vector import VectorEnvironment

ID = 'PD_Biped2D_Gaps_Terrain-v0'
OPTIONS = {
    'randomize': {
        'preset': 'robot', 'friction': (0.4, 1.2),  # the preset, with another range of friction
        'push': {'force': (50, 150), 'duration': 0.2, 'interval': (1.0, 3.0)},
    },
    'sensors': {'noise': {'terrain': 0.03, 'pose': 0.01, 'velocity': 0.05}, 'terrain_dropout': 0.05},
}  # fmt: skip


def main() -> None:
    environments = VectorEnvironment(ID, 64, seed=1, autoreset='disabled', task_kwargs=OPTIONS)
    policy, observation = policies.reference(ID), environments.reset()
    world = environments.info['world']  # drawn at the reset, one number per simulation
    runs, length, error = np.ones(64, bool), np.zeros(64, int), 0.0
    while runs.any():
        step = environments.step(policy(observation), runs)
        # A critic may use what no sensor measures: the exact observation, and the world.
        error = np.abs(step.observation - step.info['clean_observation'])[runs].mean()
        observation, length[runs] = step.observation, length[runs] + 1
        runs &= ~(step.terminated | step.truncated)
    print(f'mean error of an observed number in the last step: {error:.3f}')
    for low, high in ((0.4, 0.8), (0.8, 1.2)):
        chosen = (world['friction'] >= low) & (world['friction'] < high)
        print(f'friction {low} to {high}: {length[chosen].mean():.0f} steps on average')


if __name__ == '__main__':
    begin_script()
    main()
