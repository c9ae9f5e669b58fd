"""Random actions through Gymnasium: one environment, then many on threads.

Needs `pip install 'trl_suite[gymnasium]'`.
"""

import gymnasium
import numpy as np

import trl_suite.gym  # noqa: F401, registers the environments
from trl_suite.util.program import begin_script

ID = 'trl_suite/PD_Biped2D_Gaps_Terrain-v0'


def main() -> None:
    env = gymnasium.make(ID)
    env.reset(seed=1)
    env.action_space.seed(1)
    total, ended = 0.0, False
    while not ended:
        _, reward, terminated, truncated, info = env.step(env.action_space.sample())
        total, ended = total + reward, terminated or truncated
    print(f'one: return {total:.1f}, {info["distance"]:.2f} m, fell: {info["fell"]}')
    env.close()

    envs = gymnasium.make_vec(ID, num_envs=16)
    envs = gymnasium.wrappers.vector.RecordEpisodeStatistics(envs)
    envs.reset(seed=1)
    envs.action_space.seed(1)
    for _ in range(256):
        envs.step(envs.action_space.sample())
    print(
        f'{envs.num_envs}: {envs.episode_count} episodes, mean return {np.mean(envs.return_queue):.1f}'
    )
    envs.close()


if __name__ == '__main__':
    begin_script()
    main()
