"""Writes a policy of Stable-Baselines3 in the format of the suite, which needs no PyTorch.

    from stable_baselines3 import SAC
    from stable_baselines_export import exported
    from trl_suite import policies
    from trl_suite.adapters.stable_baselines import SuiteVecEnv

    envs = SuiteVecEnv('PD_Biped2D_Flat-v0', 8)
    model = SAC('MlpPolicy', envs).learn(10_000)
    policies.save(exported(model, envs.environment), 'sac.npz')

For 'MlpPolicy' of PPO, A2C, SAC, TD3, DDPG and TQC; `VecNormalize` may scale the observations: then
load a saved model with it, PPO.load('ppo.zip', env=VecNormalize.load('ppo.pkl', envs)).
"""

import numpy as np
import torch

from trl_suite import policies

ACTIVATIONS = {torch.nn.Tanh: 'tanh', torch.nn.ReLU: 'relu', torch.nn.ELU: 'elu'}


def exported(model, environment):
    """Returns the deterministic policy.

    The output of an actor is tanh(x): a change by tanh(x) of the only choice, the action 0. The
    outputs are then a number for that choice, here 0, and x.

    Args:
      model: a model of Stable-Baselines3.
      environment: the `VectorEnvironment` that it was trained in, or a similar one.
    """
    net, squashed = model.policy, hasattr(model.policy, 'actor')
    if net.activation_fn not in ACTIVATIONS or (model.use_sde and net.squash_output):
        raise ValueError(
            'expected activations tanh, relu or elu, and no squashed output with use_sde'
        )
    parts = (
        net.actor if squashed else torch.nn.Sequential(net.mlp_extractor.policy_net, net.action_net)
    )
    layers = [
        part for name, part in parts.named_modules()
        if isinstance(part, torch.nn.Linear) and name != 'log_std'
    ]  # fmt: skip
    weights = [layer.weight.detach().numpy().T.copy() for layer in layers]
    biases = [layer.bias.detach().numpy().copy() for layer in layers]
    options = {}
    scales = model.get_vec_normalize_env()
    if scales is not None and scales.norm_obs:
        std = np.sqrt(scales.obs_rms.var + scales.epsilon)
        options = {'mean': scales.obs_rms.mean, 'std': std, 'clip': scales.clip_obs}
    if squashed:
        weights[-1], biases[-1] = np.pad(weights[-1], ((0, 0), (1, 0))), np.pad(biases[-1], (1, 0))
        size = len(environment.action_map)
        options |= {'choices': np.zeros((1, size)), 'largest_change': np.float32(1)}
    options['activation'] = ACTIVATIONS[net.activation_fn]
    return policies.Policy.for_environment(environment, weights, biases, **options)
