"""Prioritised level replay: PPO trains most on the levels whose values it predicts worst.

Jiang et al.: Prioritized Level Replay. ICML 2021. Needs `pip install 'trl_suite[benchmark]'`.
"""

import argparse

import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecMonitor

from trl_suite.adapters.stable_baselines import SuiteVecEnv
from trl_suite.util.program import begin_script

TEMPERATURE, STALE = 0.1, 0.1  # of ranks; share of draws by the time since a level was seen


class Replay(BaseCallback):
    """Chooses the level of the next episode of every simulation."""

    def __init__(self, envs, count):
        super().__init__()
        self.envs, self.count, self.random = envs, count, np.random.default_rng(0)
        self.scores, self.seen, self.levels = np.full(count, np.inf), np.zeros(count), []

    def _on_step(self):
        self.levels.append([info['level'] for info in self.locals['infos']])
        order = np.lexsort((self.random.random(self.count), -self.scores))  # new levels first
        by_score = (1.0 + np.argsort(order)) ** (-1 / TEMPERATURE)
        by_age = self.num_timesteps - self.seen + 1
        chance = (1 - STALE) * by_score / by_score.sum() + STALE * by_age / by_age.sum()
        chosen = self.random.choice(self.count, self.envs.num_envs, p=chance)
        self.envs.environment.task.choose_level(np.arange(self.envs.num_envs), chosen.tolist())
        return True

    def _on_rollout_end(self):
        error, levels = np.abs(self.model.rollout_buffer.advantages), np.array(self.levels)
        for level in np.unique(levels):
            self.scores[level] = error[levels == level].mean()
            self.seen[level] = self.num_timesteps
        self.levels = []


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--environment', default='PD_Biped2D_Mixed_Terrain-v0', help='id or alias')
    parser.add_argument('--levels', type=int, default=100)
    parser.add_argument('--steps', type=int, default=1_000_000)
    given = parser.parse_args()
    envs = SuiteVecEnv(given.environment, 16, seed=0, task_kwargs={'levels': (0, given.levels)})
    replay = Replay(envs, given.levels)
    PPO('MlpPolicy', VecMonitor(envs), n_steps=256, verbose=1).learn(given.steps, replay)
    seen = np.flatnonzero(np.isfinite(replay.scores))
    print('hardest levels:', *seen[np.argsort(-replay.scores[seen])][:10])


if __name__ == '__main__':
    begin_script()
    main()
