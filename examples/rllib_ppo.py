"""Trains a policy with RLlib's PPO: each runner is a process that steps many simulations.

    python examples/rllib_ppo.py --environment PD_Biped2D_Flat-v0 --runners 2

On several machines (`docs/cluster.md` describes how to start a cluster) the runners are spread over
all of them; `--runners` may be the total number of cores less one. Runner i has the seed s + i, so
runners have different terrain. An episode has at most 256 steps of reward at most 1. Needs
`pip install 'trl_suite[rllib]'`.
"""

import argparse
import math

from gymnasium import VectorizeMode
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.connectors.env_to_module import MeanStdFilter
from ray.rllib.core.rl_module.apis import TargetNetworkAPI
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig

from trl_suite.adapters.ray import connect
from trl_suite.util.program import begin_script

STEPS = 32  # steps of every simulation between updates
NOISE = (
    0.2  # standard deviation of the first actions, about 0.3 rad; with RLlib's 1 all walkers fall
)


def on_runners(algorithm, id_, runners=2, num_envs=32, seed=0):
    """Returns an `AlgorithmConfig` whose runners step `num_envs` simulations on one core each."""

    def set_noise(learner, **_):
        policy = learner.module['default_policy']
        policy.pi.log_std.data.fill_(math.log(NOISE))
        if isinstance(policy, TargetNetworkAPI):  # of APPO; copies made before
            for network, target in policy.get_target_network_pairs():
                target.load_state_dict(network.state_dict())

    def less_noise(algorithm, **_):
        algorithm.learner_group.foreach_learner(set_noise)
        algorithm.env_runner_group.sync_weights(
            from_worker_or_learner_group=algorithm.learner_group, inference_only=True
        )

    return (
        algorithm
        .environment(f'trl_suite.gym:trl_suite/{id_}', env_config={'num_threads': 1})
        .env_runners(
            num_env_runners=runners, num_envs_per_env_runner=num_envs, rollout_fragment_length=STEPS,
            gym_env_vectorize_mode=VectorizeMode.VECTOR_ENTRY_POINT,
            env_to_module_connector=lambda env, spaces, device: MeanStdFilter(),
        )
        .rl_module(model_config=DefaultModelConfig(fcnet_hiddens=[256, 256], free_log_std=True))
        .callbacks(on_algorithm_init=less_noise)
        .fault_tolerance(restart_failed_env_runners=True)
        .debugging(seed=seed, log_level='ERROR')
    )  # fmt: skip


def configuration(id_, runners=2, num_envs=32, seed=0):
    """Returns PPO, which updates when all runners have taken `STEPS` steps."""
    return on_runners(PPOConfig(), id_, runners, num_envs, seed).training(
        train_batch_size_per_learner=STEPS * num_envs * runners, minibatch_size=512, num_epochs=5,
        lr=3e-4, gamma=0.95, lambda_=0.95, clip_param=0.2, use_kl_loss=False, grad_clip=0.5,
        vf_loss_coeff=0.5, vf_clip_param=math.inf,
    )  # fmt: skip


def main(configuration, description):
    """Trains as the command line says, and prints returns."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument('--environment', default='PD_Biped2D_Flat-v0', help='id')
    parser.add_argument('--runners', type=int, default=2, help='at most the number of cores')
    parser.add_argument('--updates', type=int, default=50)
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--address', help="of Ray: 'auto', or HOST:PORT; default: this machine's")
    arguments = parser.parse_args()
    connect(arguments.address)
    algorithm = configuration(
        arguments.environment, arguments.runners, seed=arguments.seed
    ).build_algo()
    for _ in range(arguments.updates):
        found = algorithm.train()['env_runners']
        # A report of APPO may come between two samples.
        steps = found.get('num_env_steps_sampled_lifetime', 0)
        mean = found.get('episode_return_mean', math.nan)
        print(f'{steps:8.0f} steps, return {mean:5.1f}', flush=True)
    algorithm.stop()


if __name__ == '__main__':
    begin_script()
    main(configuration, __doc__.splitlines()[0])
