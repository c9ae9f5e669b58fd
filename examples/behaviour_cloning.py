"""Trains a policy to imitate a data set, and evaluates it. Needs `pip install 'trl_suite[minari,train]'`.

trl-suite dataset PD_Biped2D_Flat-v0 --policy reference --episodes 50 --minari
python behaviour_cloning.py PD_Biped2D_Flat-reference-v0
"""

import argparse

import minari
import numpy as np
import torch

import trl_suite.adapters.gym  # noqa: F401  registers environments
from trl_suite.util.program import begin_script


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('dataset', help='name of a data set')
    parser.add_argument('--epochs', type=int, default=20)
    parser.add_argument('--episodes', type=int, default=10, help='episodes of the evaluation')
    arguments = parser.parse_args()
    torch.manual_seed(0)

    dataset = minari.load_dataset(arguments.dataset)
    episodes = list(dataset.iterate_episodes())
    x = torch.from_numpy(np.concatenate([each.observations[:-1] for each in episodes]))
    y = torch.from_numpy(np.concatenate([each.actions for each in episodes]))
    mean, std = x.mean(0), x.std(0) + 1e-3
    network = torch.nn.Sequential(
        torch.nn.Linear(x.shape[1], 256), torch.nn.Tanh(), torch.nn.Linear(256, 256),
        torch.nn.Tanh(), torch.nn.Linear(256, y.shape[1]),
    )  # fmt: skip
    optimizer = torch.optim.Adam(network.parameters(), 1e-3)
    for epoch in range(arguments.epochs):
        losses = []
        for part in torch.randperm(len(x)).split(256):
            loss = ((network((x[part] - mean) / std) - y[part]) ** 2).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            losses.append(loss.item())
        print(f'epoch {epoch + 1}: error {np.mean(losses):.4f}')

    environment, returns = dataset.recover_environment(), []
    for seed in range(arguments.episodes):
        (observation, _), done, total = environment.reset(seed=seed), False, 0.0
        while not done:
            with torch.no_grad():
                action = network((torch.from_numpy(observation) - mean) / std).numpy()
            observation, reward, terminated, truncated, _ = environment.step(action)
            total, done = total + reward, terminated or truncated
        returns.append(total)
    print(f'return {np.mean(returns):.1f} of {environment.spec.max_episode_steps}')


if __name__ == '__main__':
    begin_script()
    main()
