"""Random actions through Shimmy, the wrapper for all environments of dm_control.

For programs that use Shimmy to wrap dm_control. The suite's own Gymnasium interface,
`trl_suite.gym`, also steps many simulations on threads, and reports how an episode ended. Needs
`pip install 'trl_suite[shimmy]'`.
"""

# Imported first: without a display, it makes dm_control, which Shimmy imports, render with EGL.
from trl_suite import suite  # isort: split

import gymnasium
from shimmy.dm_control_compatibility import DmControlCompatibilityV0

from trl_suite.util.program import begin_script


def main() -> None:
    # One vector, because Gymnasium would sort the keys of a dict of blocks before flattening it.
    environment = suite.build(
        'raptor', 'muscle', 'slopes_mixed', environment_kwargs={'flat_observation': True}
    )
    env = DmControlCompatibilityV0(environment, 'rgb_array', {'camera_id': 'raptor/side'})
    env = gymnasium.wrappers.FlattenObservation(env)
    env.reset(seed=1)  # the same episode as with task_kwargs={'random': 1}
    env.action_space.seed(1)
    total, ended = 0.0, False
    while not ended:
        _, reward, terminated, truncated, _ = env.step(env.action_space.sample())
        total, ended = total + reward, terminated or truncated
    print(f'return {total:.1f}, {environment.info["distance"]:.2f} m, fell: {terminated}')
    print(f'picture of shape {env.render().shape}')
    env.close()


if __name__ == '__main__':
    begin_script()
    main()
