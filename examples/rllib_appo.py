"""Trains a policy with RLlib's APPO: asynchronous PPO, whose learner does not wait for runners.

For clusters with many or unequal nodes. Samples of slow runners are a little older, which is corrected by
V-trace, as in IMPALA (Espeholt et al. 2018, arXiv:1802.01561). The loss of a runner does not delay training.
Runners and simulations are those of `rllib_ppo.py`. An update is one report of RLlib, at least 5 s apart.
"""

import rllib_ppo
from ray.rllib.algorithms.appo import APPOConfig

from trl_suite.util.program import begin_script

REPORT = 5  # s between reports
POLL = 0.05  # s that the first process waits for samples; with RLlib's 0 it polls without a pause


def configuration(id_, runners=2, num_envs=32, seed=0):
    """Returns APPO, whose batch has `STEPS` steps of all simulations of one runner."""
    config = rllib_ppo.configuration(id_, runners, num_envs, seed, APPOConfig())
    return config.reporting(min_time_s_per_iteration=REPORT).training(
        train_batch_size_per_learner=rllib_ppo.STEPS * num_envs,
        minibatch_size=rllib_ppo.STEPS * max(num_envs // 2, 1), use_circular_buffer=False,
        entropy_coeff=0.0, timeout_s_sampler_manager=POLL,
        # The policy to which changes are clipped follows after two batches. RLlib counts in fillings
        # of the circular buffer, used or not: 32 batches by default, too long for short runs.
        circular_buffer_num_batches=1, circular_buffer_iterations_per_batch=1,
        target_network_update_freq=2,
    )  # fmt: skip


if __name__ == '__main__':
    begin_script()
    rllib_ppo.main(configuration)
