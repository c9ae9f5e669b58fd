"""Trains a policy with TorchRL's PPO on threads. Needs `pip install 'trl_suite[torchrl]'`."""

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
from trl_suite.util.program import begin_script

NUM_ENVS, STEPS = 64, 32  # simulations; steps of each between updates
begin_script()
parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument('--environment', default='PD_Biped2D_Flat-v0', help='id or alias')
parser.add_argument('--samples', type=int, default=100_000, help='steps of all simulations')
args = parser.parse_args()
torch.manual_seed(0)
# 'Disabled', because TorchRL resets simulations that have ended.
many = gymnasium.make_vec(f'trl_suite/{args.environment}', NUM_ENVS, autoreset_mode='Disabled')
environment = TransformedEnv(GymWrapper(many), RewardSum())
environment.set_seed(0)
layers = {'num_cells': (256, 256), 'activation_class': nn.Tanh}
size = environment.action_spec.shape[-1]
noise = AddStateIndependentNormalScale(size, init_value=math.log(0.2))  # about 0.3 rad
mean = nn.Sequential(MLP(out_features=size, **layers), noise)
actor = ProbabilisticActor(
    TensorDictModule(mean, in_keys=['observation'], out_keys=['loc', 'scale']),
    in_keys=['loc', 'scale'], distribution_class=IndependentNormal, return_log_prob=True,
)  # fmt: skip
critic = ValueOperator(MLP(out_features=1, **layers))
critic(actor(environment.reset()))  # initialises the lazy layers
advantage = GAE(gamma=0.95, lmbda=0.95, value_network=critic, average_gae=True)
loss = ClipPPOLoss(actor, critic, entropy_coeff=0.0, critic_coeff=0.5)
optimizer = torch.optim.Adam(loss.parameters(), lr=3e-4)
collector = Collector(
    environment, actor, frames_per_batch=STEPS * NUM_ENVS, total_frames=args.samples,
    auto_register_policy_transforms=True,
)  # fmt: skip
for update, batch in enumerate(collector, 1):
    for _ in range(5):
        with torch.no_grad():
            advantage(batch)
        steps = batch.reshape(-1)
        for chosen in torch.randperm(len(steps)).split(512):
            losses = loss(steps[chosen])
            optimizer.zero_grad()
            (losses['loss_objective'] + losses['loss_critic']).backward()
            nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
            optimizer.step()
    returns = batch['next', 'episode_reward'][batch['next', 'done']]
    print(f'{update * len(steps):8} steps, return {returns.mean().item():5.1f}', flush=True)
