"""Baselines of continual learning, on top of PPO from ppo.py.

    cd examples
    trl-suite sequences run plaid_biped --learner continual_baselines:FineTuning --output ft.json

* `Scratch`: a new policy for every environment.
* `FineTuning`: one policy, trained on one environment after the other.
* `EWC`: the same with elastic weight consolidation (Kirkpatrick et al. 2017, arXiv:1612.00796).
* `MultiTask`: one policy, trained on all environments from the start.

All take the same number of samples in every stage; plaid.py has one more learner. A new method
overrides `train`. Needs `pip install 'trl_suite[train]'`.
"""

from __future__ import annotations

import dataclasses
import pathlib
from typing import Any

import checkpoints
import numpy as np
import ppo
import ppo_settings
import torch
from several import Several

from trl_suite import policies, sequences

NUM_ENVS = 64
STRENGTH = 1.0  # of the penalty of `EWC`, in units of the divergence from the previous policy
FISHER_SAMPLES = 1024


class FineTuning:
    """PPO that keeps policy, value, scales and optimiser from one environment to the next."""

    def __init__(self, sequence: sequences.Sequence, seed: int) -> None:
        torch.set_num_threads(1)  # a second thread slows down networks of this size
        self.sequence, self.seed = sequence, seed
        self.trainer = self.new_trainer()

    def new_trainer(self) -> ppo.Trainer:
        first = self.sequence.ids[0]
        settings = ppo_settings.settings_for(first, start='', stages=(), num_envs=NUM_ENVS)
        return ppo.Trainer(first, self.seed, settings, 1)

    def train(self, stage: sequences.Stage) -> None:
        self.learn(stage.environments(NUM_ENVS, autoreset='disabled'), stage.budget)

    def learn(self, environments: Any, samples: int) -> dict[str, torch.Tensor]:
        """Trains with PPO for at most a number of samples; returns those of the last update.

        The learning rate decreases to its last value, as in a separate run.
        """
        trainer = self.trainer
        trainer.settings = dataclasses.replace(trainer.settings, samples=samples)
        trainer.enter(environments)
        trainer.samples, batch = 0, {}
        while trainer.samples + trainer.settings.horizon * environments.num_envs <= samples:
            batch = trainer.collect()
            trainer.learn(batch)
        return batch

    def policy(self) -> policies.Policy:
        return self.trainer.exported()

    def save(self, folder: pathlib.Path) -> None:
        checkpoints.save(self.trainer.learnt(), folder / 'learner.pt')

    def load(self, folder: pathlib.Path) -> None:
        self.trainer.set_learnt(checkpoints.load(folder / 'learner.pt'))


class Scratch(FineTuning):
    """A new policy for every environment; the score on each after its stage is the reference."""

    def train(self, stage: sequences.Stage) -> None:
        self.trainer = self.new_trainer()
        super().train(stage)


class MultiTask(FineTuning):
    """One policy, trained on all environments from the start; the order has no effect."""

    def train(self, stage: sequences.Stage) -> None:
        self.learn(together(stage, stage.ids), stage.budget)


class EWC(FineTuning):
    """Fine-tuning with a penalty on changes of weights that were important before.

    The importance of a weight is its Fisher information, summed over environments, and the penalty
    is measured from the weights after the last one (online EWC, Schwarz et al. 2018,
    arXiv:1805.06370).
    """

    def __init__(self, sequence: sequences.Sequence, seed: int) -> None:
        super().__init__(sequence, seed)
        self.anchor: dict[str, torch.Tensor] = {}
        self.fisher: dict[str, torch.Tensor] = {}
        self.trainer.penalty = self.penalty

    def train(self, stage: sequences.Stage) -> None:
        environments = stage.environments(NUM_ENVS, autoreset='disabled')
        batch = self.learn(environments, stage.budget)
        if batch:
            self.consolidate(batch['observation'])

    def penalty(self) -> Any:
        """Second-order estimate of the divergence from the previous policy, times `STRENGTH`."""
        weights = dict(self.trainer.policy.named_parameters())
        terms = [
            (fisher * (weights[name] - self.anchor[name]) ** 2).sum()
            for name, fisher in self.fisher.items()
        ]
        return 0.5 * STRENGTH * sum(terms)

    def consolidate(self, observations: torch.Tensor) -> None:
        """Adds the Fisher information of the policy for scaled observations (n, k).

        Its diagonal is the mean square of the gradient of log pi(a | s), for actions of the policy.
        """
        network = self.trainer.policy
        self.anchor = {name: w.detach().clone() for name, w in network.named_parameters()}
        std = self.trainer.log_std.detach().exp()

        def log_probability(weights: Any, observation: Any, noise: Any) -> Any:
            mean = torch.func.functional_call(network, weights, observation)
            return -((mean.detach() + std * noise - mean) ** 2 / std**2 / 2).sum()

        gradients = torch.func.vmap(torch.func.grad(log_probability), in_dims=(None, 0, 0))
        chosen = self.trainer.random.permutation(len(observations))[:FISHER_SAMPLES]
        noise = self.trainer.random.standard_normal((len(chosen), len(std)), np.float32)
        for part in np.array_split(np.arange(len(chosen)), -(-len(chosen) // 64)):
            found = gradients(
                self.anchor, observations[chosen[part]], torch.from_numpy(noise[part])
            )
            for name, gradient in found.items():
                share = (gradient**2).sum(0) / len(chosen)
                self.fisher[name] = self.fisher.get(name, 0.0) + share

    def save(self, folder: pathlib.Path) -> None:
        super().save(folder)
        checkpoints.save({'anchor': self.anchor, 'fisher': self.fisher}, folder / 'ewc.pt')

    def load(self, folder: pathlib.Path) -> None:
        super().load(folder)
        state = checkpoints.load(folder / 'ewc.pt')
        self.anchor, self.fisher = state['anchor'], state['fisher']


def together(stage: sequences.Stage, ids: tuple[str, ...]) -> Several:
    """Makes `NUM_ENVS` simulations or a few fewer, as many of each environment."""
    each = NUM_ENVS // len(ids)
    return Several([stage.environments(each, id, autoreset='disabled') for id in ids])
