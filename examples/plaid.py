"""PLAiD (Berseth et al. 2018): transfer with PPO, then distillation of two policies into one.

    cd examples
    trl-suite sequences run plaid_biped --learner plaid:Plaid --output result.json

After PPO on a new terrain, its policy and the previous one, an expert for all earlier terrains, label the
observations that the policy meets on all of them (DAgger, Ross et al. 2011). Needs Stable-Baselines3.
"""

import numpy as np
import torch
from continual_learning import NUM_ENVS, FineTuning

SHARE, ROUNDS, EPOCHS = 0.2, 5, 10  # of a stage's samples; of DAgger; of each round


class Plaid(FineTuning):
    """Fine-tuning, and distillation after every stage but the first."""

    def train(self, stage):
        before, random = self.policy(), np.random.default_rng((stage.seed, stage.number))
        distilled = int(SHARE * stage.budget) if stage.number else 0
        self.learn(stage, stage.budget - distilled)
        if not distilled:
            return
        experts = [before] * stage.number + [self.policy()]
        each = NUM_ENVS // len(experts)
        parts = [stage.environments(each, id) for id in stage.ids[: len(experts)]]
        seen, labels = [part.reset() for part in parts], [[], []]
        for _ in range(ROUNDS):
            policy = self.policy()
            for _ in range(distilled // (ROUNDS * each * len(parts))):
                for i, (part, expert) in enumerate(zip(parts, experts, strict=True)):
                    labels[0].append(seen[i])
                    labels[1].append(expert(seen[i]))
                    noise = random.normal(0, 0.1, labels[1][-1].shape)
                    seen[i] = part.step(np.clip(policy(seen[i]) + noise, -1, 1)).observation
            self.fit(*map(np.concatenate, labels))

    def fit(self, observations, actions):
        """Fits the policy to the actions of experts."""
        network, optimizer = self.layers(), self.model.policy.optimizer
        inputs = torch.as_tensor(self.scales.normalize_obs(observations.astype(np.float32)))
        targets = torch.as_tensor(actions, dtype=torch.float32)
        for _ in range(EPOCHS):
            for part in torch.randperm(len(inputs)).split(512):
                optimizer.zero_grad()
                (network(inputs[part]) - targets[part]).square().mean().backward()
                optimizer.step()
