"""A learner for sequences of environments: fine-tunes one policy with Stable-Baselines3's PPO.

    cd examples
    trl-suite sequences run plaid_biped --learner continual_learning:FineTuning --output result.json

Needs `pip install 'trl_suite[sb3]'`.
"""

import copy

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize

from trl_suite.adapters.stable_baselines import SuiteVecEnv

NUM_ENVS, STEPS = 64, 32  # simulations, and their steps between updates


class FineTuning:
    """A new method overrides `train`."""

    def __init__(self, sequence, seed):
        first = SuiteVecEnv(sequence.ids[0], NUM_ENVS, seed=seed)  # determines sizes only
        self.scales = VecNormalize(first, norm_reward=False)
        self.rms = self.scales.obs_rms
        self.model = PPO(
            'MlpPolicy', self.scales, n_steps=STEPS, batch_size=512, n_epochs=5, gamma=0.95,
            target_kl=0.05, seed=seed, device='cpu',
            policy_kwargs={'net_arch': [256, 256], 'log_std_init': np.log(0.2)},
        )  # fmt: skip

    def train(self, stage):
        self.learn(stage, stage.budget)

    def learn(self, stage, samples):
        """Trains in simulations that count their samples; more than the budget are refused."""
        if samples < NUM_ENVS * STEPS:
            raise ValueError(f'{samples} samples; expected {NUM_ENVS * STEPS} or more, one update')
        environments = stage.environments(NUM_ENVS, autoreset='same_step', dtype=np.float32)
        self.scales = VecNormalize(SuiteVecEnv(environments), norm_reward=False)
        self.scales.obs_rms = self.rms
        self.model.set_env(self.scales)
        self.model.learn(samples // (NUM_ENVS * STEPS) * NUM_ENVS * STEPS)

    def layers(self):
        network = self.model.policy
        return torch.nn.Sequential(network.mlp_extractor.policy_net, network.action_net)

    def policy(self):
        """Returns the current policy, which further training does not change."""
        network, rms = copy.deepcopy((self.layers(), self.rms))

        def act(observation):
            seen = np.clip((observation - rms.mean) / np.sqrt(rms.var + 1e-8), -10, 10)
            with torch.no_grad():
                return network(torch.as_tensor(seen, dtype=torch.float32)).clamp(-1, 1).numpy()

        return act
