"""Trains a policy with Stable-Baselines3's PPO on threads of simulations.

Prints after every `--every` steps the mean return of the last 100 episodes; an episode has at most 256
steps of reward at most 1. Needs `pip install 'trl_suite[sb3]'`.
"""

import argparse
import math

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from trl_suite.adapters.stable_baselines import SuiteVecEnv
from trl_suite.util.program import begin_script

begin_script()
parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument('--environment', default='PD_Biped2D_Flat-v0', help='id or alias')
parser.add_argument('--samples', type=int, default=300_000)
parser.add_argument('--num_envs', type=int, default=64)
parser.add_argument('--num_threads', type=int, default=0, help='of the physics; 0: all cores')
parser.add_argument('--seed', type=int, default=0)
parser.add_argument('--every', type=int, default=20_480, help='steps between printed lines')
parser.add_argument('--save', help='where to write the policy, .zip, and the scales, .pkl')
args = parser.parse_args()

torch.set_num_threads(args.num_threads or torch.get_num_threads())
environments = VecNormalize(
    VecMonitor(SuiteVecEnv(args.environment, args.num_envs, args.num_threads)), norm_reward=False
)
model = PPO(
    'MlpPolicy', environments, n_steps=32, batch_size=512, n_epochs=5, learning_rate=3e-4,
    gamma=0.95, gae_lambda=0.95, target_kl=0.05, seed=args.seed, device='cpu',
    policy_kwargs={
        'net_arch': [256, 256], 'activation_fn': torch.nn.Tanh,
        'log_std_init': math.log(0.2),  # exploration of about 0.3 rad
    },
)  # fmt: skip
print('   steps  return  length')
while model.num_timesteps < args.samples:
    model.learn(args.every, reset_num_timesteps=False)
    returns, lengths = ([episode[key] for episode in model.ep_info_buffer] for key in 'rl')
    print(f'{model.num_timesteps:8} {np.mean(returns):7.1f} {np.mean(lengths):7.1f}', flush=True)
if args.save:
    model.save(args.save)
    environments.save(args.save.removesuffix('.zip') + '.pkl')
