"""Trains a policy with Stable-Baselines3's PPO on threads of simulations.

Prints the mean return of the episodes that ended in every 20 000 steps; an episode has at most 256
steps of reward at most 1. Needs `pip install 'trl_suite[sb3]'`.
"""

import argparse
import math
import time

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from trl_suite.adapters.stable_baselines import SuiteVecEnv


class LearningCurve(BaseCallback):
    """Prints the mean return, and stops when time is up."""

    def __init__(self, minutes: float, every: int) -> None:
        super().__init__()
        self.minutes, self.every = minutes, every
        self.start, self.episodes = time.perf_counter(), []
        print('   steps  return  length  episodes  minutes')

    def _on_step(self) -> bool:
        minutes = (time.perf_counter() - self.start) / 60
        self.episodes += [info['episode'] for info in self.locals['infos'] if 'episode' in info]
        before = self.num_timesteps - self.training_env.num_envs
        if self.num_timesteps // self.every > before // self.every and self.episodes:
            returns = np.mean([episode['r'] for episode in self.episodes])
            lengths = np.mean([episode['l'] for episode in self.episodes])
            print(
                f'{self.num_timesteps:8} {returns:7.1f} {lengths:7.1f} {len(self.episodes):9} '
                f'{minutes:8.2f}',
                flush=True,
            )
            self.episodes.clear()
        return minutes < self.minutes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--environment', default='PD_Biped2D_Flat-v0', help='id or alias')
    parser.add_argument('--minutes', type=float, default=3.0, help='how long to train')
    parser.add_argument('--num_envs', type=int, default=64)
    parser.add_argument('--num_threads', type=int, default=0, help='of the physics; 0: all cores')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--every', type=int, default=20_000, help='steps between printed lines')
    parser.add_argument('--save', help='where to write the policy, .zip, and the scales, .pkl')
    arguments = parser.parse_args()

    torch.set_num_threads(arguments.num_threads or torch.get_num_threads())
    rows = SuiteVecEnv(arguments.environment, arguments.num_envs, arguments.num_threads)
    environments = VecNormalize(VecMonitor(rows), norm_reward=False)
    model = PPO(
        'MlpPolicy',
        environments,
        n_steps=32,
        batch_size=512,
        n_epochs=5,
        learning_rate=3e-4,
        gamma=0.95,
        gae_lambda=0.95,
        target_kl=0.05,
        policy_kwargs={
            'net_arch': [256, 256],
            'activation_fn': torch.nn.Tanh,
            'log_std_init': math.log(0.2),  # exploration of about 0.3 rad
        },
        seed=arguments.seed,
        device='cpu',
    )
    model.learn(10**9, LearningCurve(arguments.minutes, arguments.every))
    if arguments.save:
        model.save(arguments.save)
        environments.save(arguments.save.removesuffix('.zip') + '.pkl')


if __name__ == '__main__':
    main()
