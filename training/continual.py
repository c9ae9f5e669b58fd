"""Baselines of continual learning, on top of PPO from `ppo.py`.

    cd training
    trl-suite sequences run plaid_biped --learner continual:FineTuning --output fine_tuning.json

All take the same number of samples in every stage. A new method overrides `train`. Needs
`pip install 'trl_suite[train]'`.
"""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import ppo
import runs
import settings
import torch
from several import Several

from trl_suite import policies, sequences
from trl_suite.runs import Stage

NUM_ENVS = 64
STRENGTH = 1.0  # of the penalty of `EWC`, in units of the divergence from the previous policy
FISHER_SAMPLES = 1024
DISTILLED = 0.2  # share of a stage's samples, for the distillation of `Plaid`
ROUNDS = 5  # of DAgger
Expert = Callable[[np.ndarray], np.ndarray]  # observations (n, k) -> actions (n, a)


class FineTuning:
    """PPO that keeps policy, value, scales and optimiser from one environment to the next."""

    def __init__(self, sequence: sequences.Sequence, seed: int) -> None:
        torch.set_num_threads(1)  # a second thread slows down networks of this size
        self.sequence, self.seed = sequence, seed
        self.trainer = self.new_trainer()

    def new_trainer(self) -> ppo.Trainer:
        first = self.sequence.ids[0]
        own = settings.settings_for(first, start='', stages=(), num_envs=NUM_ENVS)
        return ppo.Trainer(first, self.seed, own, 1)

    def train(self, stage: Stage) -> None:
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
        runs.save(self.trainer.learnt(), folder / 'learner.pt')

    def load(self, folder: pathlib.Path) -> None:
        self.trainer.set_learnt(runs.load(folder / 'learner.pt'))


class Scratch(FineTuning):
    """A new policy for every environment; the score on each after its stage is the reference."""

    def train(self, stage: Stage) -> None:
        self.trainer = self.new_trainer()
        super().train(stage)


class MultiTask(FineTuning):
    """One policy, trained on all environments from the start; the order has no effect."""

    def train(self, stage: Stage) -> None:
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

    def train(self, stage: Stage) -> None:
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
        runs.save({'anchor': self.anchor, 'fisher': self.fisher}, folder / 'ewc.pt')

    def load(self, folder: pathlib.Path) -> None:
        super().load(folder)
        state = runs.load(folder / 'ewc.pt')
        self.anchor, self.fisher = state['anchor'], state['fisher']


class Plaid(FineTuning):
    """PLAiD: progressive learning and integration via distillation.

    In every stage PPO trains the policy on the next terrain, for which it becomes an expert. Then
    this expert and the previous policy, an expert for all earlier terrains, are distilled into one
    policy, from which the next stage starts. Samples of both parts count; distillation takes some of
    them on earlier terrains. G. Berseth, C. Xie, P. Cernek, M. van de Panne: Progressive
    Reinforcement Learning with Distillation for Multi-Skilled Motion Control. ICLR 2018.
    """

    def train(self, stage: Stage) -> None:
        seen = stage.ids[: stage.number + 1]
        before = self.policy()
        distilled = int(DISTILLED * stage.budget) if stage.number else 0
        environments = stage.environments(self.trainer.settings.num_envs, autoreset='disabled')
        self.learn(environments, stage.budget - distilled)
        if distilled:
            experts = [before] * stage.number + [self.policy()]
            distil(self.trainer, together(stage, seen), experts, distilled)


def together(stage: Stage, ids: tuple[str, ...]) -> Several:
    """Makes `NUM_ENVS` simulations or a few fewer, as many of each environment."""
    each = NUM_ENVS // len(ids)
    return Several([stage.environments(each, id, autoreset='disabled') for id in ids])


def distil(
    trainer: ppo.Trainer, environments: Several, experts: Sequence[Expert], samples: int,
    rounds: int = ROUNDS,
) -> None:  # fmt: skip
    """Fits the policy of a trainer to experts, in states that it visits itself.

    DAgger: Ross et al. 2011, arXiv:1011.0686.

    Args:
      trainer: its policy acts, with its exploration noise, and is fitted after every round to all
        labels so far.
      environments: one part for every expert.
      experts: each labels the observations of its part.
      samples: largest number of samples, in all rounds together.
      rounds: number of rounds.
    """
    trainer.enter(environments)
    std = trainer.log_std.exp().detach().numpy()
    steps = samples // environments.num_envs
    seen: list[np.ndarray] = []
    labels: list[np.ndarray] = []
    for part in np.array_split(np.arange(steps), rounds):
        for _ in part:
            observation = trainer.observation
            parts = environments.split(observation)
            actions = [expert(o) for expert, o in zip(experts, parts, strict=True)]
            seen.append(observation)
            labels.append(np.clip(np.concatenate(actions), -1, 1))
            action = trainer.means(observation)
            step = environments.step(action + std * trainer.random.standard_normal(action.shape))
            ended = step.terminated | step.truncated
            trainer.observation = environments.reset(ended) if ended.any() else step.observation
        if len(part):
            trainer.scales.update(np.concatenate(seen[-len(part) :]))
            trainer.fit(seen, labels)
