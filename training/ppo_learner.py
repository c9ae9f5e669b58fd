"""Learner of the benchmark: ppo.py with its default settings, from a random policy.

cd training
trl-suite benchmark run PD_Biped2D_Gaps_Terrain-v0 --learner ppo_learner:SuitePPO
"""

import dataclasses

import ppo
import runs
import torch


class SuitePPO:
    """PPO with scaled observations, in 64 simulations, with a learning rate that decreases."""

    def __init__(self, course, seed, **options):
        torch.set_num_threads(1)  # a second thread slows down networks of this size
        self.options = {'autoreset': 'disabled', **options}  # of simulations
        self.trainer = ppo.Trainer(course.ids[0], seed, ppo.Settings(), 1)

    def train(self, stage):
        trainer, total = self.trainer, stage.budget * stage.count
        trainer.settings = settings = dataclasses.replace(trainer.settings, samples=total)
        trainer.enter(stage.environments(settings.num_envs, **self.options))
        while stage.left >= settings.num_envs * settings.horizon:
            trainer.learn(trainer.collect())

    def policy(self):
        return self.trainer.exported()

    def save(self, folder):
        state = {'samples': self.trainer.samples, **self.trainer.learnt()}
        runs.save(state, folder / 'learner.pt')

    def load(self, folder):
        state = runs.load(folder / 'learner.pt')
        self.trainer.samples = state['samples']
        self.trainer.set_learnt(state)
