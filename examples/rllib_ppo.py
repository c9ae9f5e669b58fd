"""Trains a policy with RLlib's PPO: each runner is a process that steps many simulations.

Runner i has the seed s + i, and so other terrain. Needs `pip install 'trl_suite[rllib]'`.
"""

import argparse

from gymnasium import VectorizeMode
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.connectors.env_to_module import MeanStdFilter
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig

from trl_suite.adapters.ray import connect
from trl_suite.util.program import begin_script

STEPS = 32  # of every simulation between updates


def less_noise(algorithm, **_):
    def set_noise(learner, **_):
        policy = learner.module['default_policy']
        policy.pi.log_std.data.fill_(-1.6)  # 0.2, about 0.3 rad; with RLlib's 1 all walkers fall
        for network, target in getattr(policy, 'get_target_network_pairs', tuple)():  # of APPO
            target.load_state_dict(network.state_dict())

    algorithm.learner_group.foreach_learner(set_noise)
    algorithm.env_runner_group.sync_weights(from_worker_or_learner_group=algorithm.learner_group)


def configuration(id_, runners=2, num_envs=32, seed=0, config=None):
    """Returns PPO, or another `config`; each runner steps `num_envs` simulations on one core."""
    config = config or PPOConfig().training(lambda_=0.95, vf_clip_param=float('inf'))
    config.environment(f'trl_suite.gym:trl_suite/{id_}', env_config={'num_threads': 1})
    config.rl_module(model_config=DefaultModelConfig(fcnet_hiddens=[256, 256], free_log_std=True))
    config.callbacks(on_algorithm_init=less_noise).fault_tolerance(restart_failed_env_runners=True)
    config.debugging(seed=seed, log_level='ERROR').env_runners(num_env_runners=runners)
    config.env_runners(gym_env_vectorize_mode=VectorizeMode.VECTOR_ENTRY_POINT)
    config.env_runners(env_to_module_connector=lambda env, spaces, device: MeanStdFilter())
    config.env_runners(num_envs_per_env_runner=num_envs, rollout_fragment_length=STEPS)
    config.training(train_batch_size_per_learner=STEPS * num_envs * runners, minibatch_size=512)
    config.training(lr=3e-4, gamma=0.95, clip_param=0.2, use_kl_loss=False, num_epochs=5)
    return config.training(grad_clip=0.5, vf_loss_coeff=0.5)


def main(make):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--environment', default='PD_Biped2D_Flat-v0', help='id')
    parser.add_argument('--runners', type=int, default=2, help='at most the number of cores')
    parser.add_argument('--address', help="of Ray: 'auto', or HOST:PORT")
    args = parser.parse_args()
    connect(args.address)
    algorithm = make(args.environment, args.runners).build_algo()
    for _ in range(50):
        found = algorithm.train()['env_runners']
        print(found.get('num_env_steps_sampled_lifetime'), found.get('episode_return_mean'))


if __name__ == '__main__':
    begin_script()
    main(configuration)
