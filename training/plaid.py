"""PLAiD: progressive learning and integration via distillation (Berseth et al. 2018).

    cd examples
    trl-suite sequences run plaid_biped --learner plaid:Plaid --output plaid.json

In every stage PPO trains the policy on the next terrain, for which it becomes an expert. Then this expert
and the previous policy, an expert for all earlier terrains, are distilled into one policy by DAgger
(Ross et al. 2011, arXiv:1011.0686). The next stage starts from this policy. Samples of both parts
count; distillation takes some of them on earlier terrains. G. Berseth, C. Xie, P. Cernek, M. van de
Panne: Progressive Reinforcement Learning with Distillation for Multi-Skilled Motion Control. ICLR
2018. Needs `pip install 'trl_suite[train]'`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import ppo
import torch
from continual_baselines import FineTuning, together
from several import Several

from trl_suite import sequences

SHARE = 0.2  # of a stage's samples, for distillation
ROUNDS = 5  # of DAgger

Expert = Callable[[np.ndarray], np.ndarray]


class Plaid(FineTuning):
    """Transfer with PPO, then distillation of the new and the previous policy into one."""

    def train(self, stage: sequences.Stage) -> None:
        seen = stage.ids[: stage.number + 1]
        before = self.policy()
        distilled = int(SHARE * stage.budget) if stage.number else 0
        environments = stage.environments(self.trainer.settings.num_envs, autoreset='disabled')
        self.learn(environments, stage.budget - distilled)
        if distilled:
            experts = [before] * stage.number + [self.policy()]
            distil(self.trainer, together(stage, seen), experts, distilled)


def distil(
    trainer: ppo.Trainer,
    environments: Several,
    experts: Sequence[Expert],
    samples: int,
    rounds: int = ROUNDS,
) -> None:
    """Fits the policy of a trainer to experts, in states that it visits itself (DAgger).

    Args:
      trainer: its policy acts, with its exploration noise, and is fitted after every round to all
        labels so far.
      environments: one part for every expert.
      experts: observations (n, k) -> actions (n, a); each labels the observations of its part.
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
            with torch.no_grad():
                action = trainer.policy(trainer.scales(observation)).numpy()
            step = environments.step(action + std * trainer.random.standard_normal(action.shape))
            ended = step.terminated | step.truncated
            trainer.observation = environments.reset(ended) if ended.any() else step.observation
        if len(part):
            trainer.scales.update(np.concatenate(seen[-len(part) :]))
            trainer.fit(seen, labels)
