"""Trains a policy with RLlib's PPO: runners, processes of their own, step many simulations each.

This is how the suite goes beyond one machine. With the same packages on all, run `ray start --head`
on one and on the others the command that it prints; this program, run on the first, finds them, and
`--runners` may be as many as they have cores. Runner i has the seed s + i, so each meets ground of its
own. An episode has at most 256 steps of reward at most 1. Needs `pip install 'trl_suite[rllib]'`.
"""

import argparse
import math

from gymnasium import VectorizeMode
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.connectors.env_to_module import MeanStdFilter
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig

STEPS = 32  # of every simulation between updates
NOISE = 0.2  # standard deviation of the first actions, about 0.3 rad; RLlib's 1 fells any walker


def configuration(id_, runners=2, num_envs=32, seed=0):
    """PPO with as many runners as given, each of which steps `num_envs` simulations on one core."""

    def less_noise(algorithm, **_):
        algorithm.learner_group.foreach_learner(
            lambda learner, **_: learner.module['default_policy'].pi.log_std.data.fill_(
                math.log(NOISE)
            )
        )
        algorithm.env_runner_group.sync_weights(
            from_worker_or_learner_group=algorithm.learner_group, inference_only=True
        )

    return (
        PPOConfig()
        .environment(f'trl_suite.gym:trl_suite/{id_}', env_config={'num_threads': 1})
        .env_runners(
            num_env_runners=runners, num_envs_per_env_runner=num_envs, rollout_fragment_length=STEPS,
            gym_env_vectorize_mode=VectorizeMode.VECTOR_ENTRY_POINT,
            env_to_module_connector=lambda env, spaces, device: MeanStdFilter(),
        )
        .training(
            train_batch_size_per_learner=STEPS * num_envs * runners, minibatch_size=512, num_epochs=5,
            lr=3e-4, gamma=0.95, lambda_=0.95, clip_param=0.2, use_kl_loss=False, grad_clip=0.5,
            vf_loss_coeff=0.5, vf_clip_param=math.inf,
        )
        .rl_module(model_config=DefaultModelConfig(fcnet_hiddens=[256, 256], free_log_std=True))
        .callbacks(on_algorithm_init=less_noise)
        .debugging(seed=seed, log_level='ERROR')
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--environment', default='PD_Biped2D_Flat-v0', help='id')
    parser.add_argument('--runners', type=int, default=2, help='at most as many as cores')
    parser.add_argument('--updates', type=int, default=50)
    parser.add_argument('--seed', type=int, default=0)
    arguments = parser.parse_args()
    algorithm = configuration(
        arguments.environment, arguments.runners, seed=arguments.seed
    ).build_algo()
    for _ in range(arguments.updates):
        found = algorithm.train()['env_runners']
        steps, mean = found['num_env_steps_sampled_lifetime'], found['episode_return_mean']
        print(f'{steps:8.0f} steps, return {mean:5.1f}', flush=True)
    algorithm.stop()


if __name__ == '__main__':
    main()
