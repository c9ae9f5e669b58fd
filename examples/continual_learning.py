"""Trains on one terrain after the other, and measures forgetting and transfer.

    python examples/continual_learning.py plaid_biped --budget 2e5
    python examples/continual_learning.py plaid_dog --budget 1e6 --threads 2 --output runs

Writes OUTPUT/SEQUENCE_sS.json; the same command continues after the last complete stage. The
learner is that of ppo.py, which keeps its networks, observation scales and optimiser from one
environment to the next. It does nothing against forgetting and serves as a baseline. Needs
`pip install 'trl_suite[train]'`.
"""

import argparse
import json
import pathlib

import ppo
import ppo_settings
import torch

from trl_suite import sequences, suite
from trl_suite.util.program import begin_script


class FineTuning:
    """PPO that keeps policy, value, scales and optimiser from one environment to the next."""

    def __init__(self, environment, settings, seed=0, threads=0):
        self.settings, self.seed, self.threads = settings, seed, threads
        self.trainer = ppo.Trainer(environment, seed, settings, threads)

    def learn(self, environment, budget):
        trainer = self.trainer
        trainer.environments.close()
        trainer.spec = suite.find(environment)
        trainer.begin_stage()
        # The number of samples differs between stages, and so do the seeds.
        seeds = sequences.train_seeds(self.settings.num_envs, (self.seed, trainer.samples))
        trainer.environments.seed(seeds)
        trainer.observation = trainer.environments.reset()
        end = trainer.samples + budget
        while trainer.samples < end:
            trainer.learn(trainer.collect())

    def policy(self, environment):
        return self.trainer.exported()

    def save(self, folder):
        self.trainer.save(folder)

    def load(self, folder):
        environment = json.loads((folder / 'curve.json').read_text())['id']
        self.trainer = ppo.Trainer(environment, self.seed, self.settings, self.threads)
        self.trainer.restore(folder)


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('sequence', help=', '.join(sequences.SEQUENCES))
    parser.add_argument('--budget', type=float, default=2e5, help='control steps per environment')
    parser.add_argument('--episodes', type=int, default=sequences.EPISODES, help='of every test')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--threads', type=int, default=0, help='0: all cores')
    parser.add_argument('--output', type=pathlib.Path, default=pathlib.Path('runs'))
    chosen = parser.parse_args(arguments)
    sequence = sequences.get(chosen.sequence)
    if chosen.threads:
        torch.set_num_threads(chosen.threads)
    settings = ppo_settings.settings_for(
        sequence.ids[0], start='', samples=chosen.budget * len(sequence), stages=()
    )
    chosen.output.mkdir(parents=True, exist_ok=True)
    result = sequences.run(
        sequence, FineTuning(sequence.ids[0], settings, chosen.seed, chosen.threads),
        int(chosen.budget), chosen.output / f'{sequence.name}_s{chosen.seed}.json',
        chosen.episodes, chosen.seed, chosen.threads, progress=True,
    )  # fmt: skip
    for id, row in zip(sequence.ids, result['scores'], strict=True):
        print(f'after {id:34}', *(f'{score:.3f}' for score in row))
    for name, value in result['metrics'].items():
        print(f'{name:40} {value:.3f}')


if __name__ == '__main__':
    begin_script()
    main()
