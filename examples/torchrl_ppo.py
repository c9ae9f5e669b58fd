"""Trains a policy with TorchRL's PPO on threads of simulations.

Prints the mean return of the episodes that ended since the last update; an episode has at most 256
steps of reward at most 1. Needs `pip install 'trl_suite[torchrl]'`.
"""

import argparse
import math

import gymnasium
import torch
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import GymWrapper, RewardSum, TransformedEnv
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import trl_suite.gym  # noqa: F401, registers the environments

STEPS, EPOCHS, BATCH = 32, 5, 512  # of each row between updates; over them; steps in a minibatch
NOISE = 0.2  # standard deviation of the first actions, about 0.3 rad


def train(id_, num_envs=64, samples=100_000, seed=0):
    """Yields the number of steps and the mean return after every update."""
    torch.manual_seed(seed)
    # TorchRL itself says which num_envs begin anew: 'Disabled'.
    environment = GymWrapper(
        gymnasium.make_vec(f'trl_suite/{id_}', num_envs=num_envs, autoreset_mode='Disabled')
    )
    environment = TransformedEnv(environment, RewardSum())
    environment.set_seed(seed)
    size, layers = environment.action_spec.shape[-1], {'num_cells': (256, 256)}
    noise = AddStateIndependentNormalScale(size, init_value=math.log(NOISE))
    actor = ProbabilisticActor(
        TensorDictModule(
            nn.Sequential(MLP(out_features=size, activation_class=nn.Tanh, **layers), noise),
            in_keys=['observation'], out_keys=['loc', 'scale'],
        ),
        in_keys=['loc', 'scale'], distribution_class=IndependentNormal, return_log_prob=True,
    )  # fmt: skip
    critic = ValueOperator(MLP(out_features=1, activation_class=nn.Tanh, **layers))
    critic(actor(environment.reset()))  # gives the layers their sizes
    advantage = GAE(gamma=0.95, lmbda=0.95, value_network=critic, average_gae=True)
    loss = ClipPPOLoss(actor, critic, entropy_coeff=0.0, critic_coeff=0.5)
    optimizer = torch.optim.Adam(loss.parameters(), lr=3e-4)
    collector = Collector(
        environment, actor, frames_per_batch=STEPS * num_envs, total_frames=samples,
        auto_register_policy_transforms=True,
    )  # fmt: skip
    for update, batch in enumerate(collector, 1):
        for _ in range(EPOCHS):
            with torch.no_grad():
                advantage(batch)
            steps = batch.reshape(-1)
            for chosen in torch.randperm(len(steps)).split(BATCH):
                losses = loss(steps[chosen])
                optimizer.zero_grad()
                (losses['loss_objective'] + losses['loss_critic']).backward()
                nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
                optimizer.step()
        ended = batch['next', 'done']
        yield update * STEPS * num_envs, batch['next', 'episode_reward'][ended].mean().item()
    collector.shutdown()


if __name__ == '__main__':
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--environment', default='PD_Biped2D_Flat-v0', help='id or alias')
    parser.add_argument('--num-envs', type=int, default=64, help='simulations at once')
    parser.add_argument(
        '--samples', type=int, default=100_000, help='steps of all num_envs together'
    )
    parser.add_argument('--seed', type=int, default=0)
    arguments = parser.parse_args()
    for count, mean in train(*vars(arguments).values()):
        print(f'{count:8} steps, return {mean:5.1f}', flush=True)
