"""Learners of the benchmark: PPO and SAC with the default settings of Stable-Baselines3.

    cd examples
    trl-suite benchmark run PD_Biped2D_Gaps_Terrain-v0 --learner stable_baselines_learners:SAC

Needs `pip install 'trl_suite[benchmark]'`.
"""

import numpy as np
import stable_baselines3
import stable_baselines_state
import torch
from stable_baselines3.common import utils
from stable_baselines_export import exported

from trl_suite.adapters.stable_baselines import SuiteVecEnv

ENVS = 8  # simulations; SAC, TD3 and TQC make one update after each step of all


class PPO:
    """Proximal policy optimisation; the other learners differ in `kind`."""

    kind = stable_baselines3.PPO

    def __init__(self, course, seed):
        torch.set_num_threads(1)  # a second thread slows down networks of this size
        self.spaces = SuiteVecEnv(course.ids[0], ENVS)
        self.model = self.kind('MlpPolicy', self.spaces, seed=seed, device='cpu')

    def train(self, stage):
        utils.set_random_seed(stage.seed * stage.count + stage.number)  # so that it can be resumed
        made = SuiteVecEnv(stage.environments(ENVS, autoreset='same_step', dtype=np.float32))
        self.model.set_env(made)
        if samples := stage.budget // (self.model.n_steps * ENVS) * self.model.n_steps * ENVS:
            self.model.learn(samples, reset_num_timesteps=False)

    def policy(self):
        return exported(self.model, self.spaces.environment)

    def save(self, folder):
        stable_baselines_state.save(self.model, folder / 'state.pt')

    def load(self, folder):
        stable_baselines_state.load(self.model, folder / 'state.pt')


class SAC(PPO):
    """Soft actor-critic."""

    kind = stable_baselines3.SAC
