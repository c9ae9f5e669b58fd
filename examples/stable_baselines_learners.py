"""Learners of the benchmark: PPO and SAC with the default settings of Stable-Baselines3.

    cd examples
    trl-suite benchmark run PD_Biped2D_Gaps_Terrain-v0 --learner stable_baselines_learners:SAC

Needs `pip install 'trl_suite[benchmark]'`.
"""

import numpy as np
import stable_baselines3
import torch
from stable_baselines3.common import utils
from stable_baselines_export import exported

from trl_suite.adapters.stable_baselines import SuiteVecEnv

ENVS = 8  # simulations; SAC, TD3 and TQC make one update after each step of all
BUFFER = ('observations', 'next_observations', 'actions', 'rewards', 'dones', 'timeouts')


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
        self.model.save(folder / 'model.zip')
        if buffer := getattr(self.model, 'replay_buffer', None):  # without what is still empty
            filled = {name: getattr(buffer, name)[: buffer.size()] for name in BUFFER}
            np.savez(folder / 'buffer.npz', next=buffer.pos, **filled)

    def load(self, folder):
        self.model = self.kind.load(folder / 'model.zip', self.spaces, device='cpu')
        if buffer := getattr(self.model, 'replay_buffer', None):
            with np.load(folder / 'buffer.npz') as saved:
                buffer.pos = int(saved['next'])
                buffer.full = len(saved['dones']) == buffer.buffer_size
                for name in BUFFER:
                    getattr(buffer, name)[: len(saved[name])] = saved[name]


class SAC(PPO):
    """Soft actor-critic."""

    kind = stable_baselines3.SAC
