"""Trains a policy with RLlib's APPO: asynchronous PPO, whose learner does not wait for runners.

    python examples/rllib_appo.py --environment PD_Biped2D_Flat-v0 --runners 16 --updates 200

For clusters with many or unequal nodes. Samples of slow runners are a little older, which is corrected by
V-trace, as in IMPALA (Espeholt et al. 2018, arXiv:1802.01561). The loss of a runner does not delay training.
Runners and simulations are those of `rllib_ppo.py`. An update is one report of RLlib, at least 5 s apart.
With one runner and seed 0 the return on `PD_Biped2D_Flat-v0` rose from 15 to 75 in 141 000 steps.
Needs `pip install 'trl_suite[rllib]'`.
"""

import rllib_ppo
from ray.rllib.algorithms.appo import APPOConfig

from trl_suite.util.program import begin_script

REPORT = 5  # s between reports
POLL = 0.05  # s that the first process waits for samples; with RLlib's 0 it polls without a pause


def configuration(id_, runners=2, num_envs=32, seed=0):
    """Returns APPO, whose batch has `STEPS` steps of all simulations of one runner."""
    return (
        rllib_ppo.on_runners(APPOConfig(), id_, runners, num_envs, seed)
        .training(
            train_batch_size_per_learner=rllib_ppo.STEPS * num_envs,
            minibatch_size=rllib_ppo.STEPS * max(num_envs // 2, 1),
            num_epochs=5, use_circular_buffer=False, lr=3e-4, gamma=0.95, clip_param=0.2,
            use_kl_loss=False, grad_clip=0.5, vf_loss_coeff=0.5, entropy_coeff=0.0,
            timeout_s_sampler_manager=POLL,
            # The policy to which changes are clipped follows after two batches. RLlib counts in fillings
            # of the circular buffer, used or not: 32 batches by default, too long for short runs.
            circular_buffer_num_batches=1, circular_buffer_iterations_per_batch=1,
            target_network_update_freq=2,
        )
        .reporting(min_time_s_per_iteration=REPORT)
    )  # fmt: skip


if __name__ == '__main__':
    begin_script()
    rllib_ppo.main(configuration, __doc__.splitlines()[0])
