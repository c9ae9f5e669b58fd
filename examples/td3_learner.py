"""Learner of the benchmark: TD3 of Stable-Baselines3 with its default settings.

    cd examples
    trl-suite benchmark run PD_Biped2D_Gaps_Terrain-v0 --learner td3_learner:TD3

Except for the exploration noise, which is that of the paper; the library's default is none.
"""

import numpy as np
import stable_baselines3
from stable_baselines3.common import noise
from stable_baselines_learners import PPO


class TD3(PPO):
    """Twin delayed deep deterministic policy gradient."""

    kind = stable_baselines3.TD3

    def __init__(self, course, seed):
        super().__init__(course, seed)
        size = self.spaces.action_space.shape
        self.model.action_noise = noise.NormalActionNoise(np.zeros(size), np.full(size, 0.1))
