"""Random actions through Shimmy, the wrapper for all environments of dm_control.

For programs that wrap dm_control's own suite in the same way. `trl_suite.gym` is the suite's own
interface: it also steps many on threads, and says how an episode ended. Needs
`pip install 'trl_suite[shimmy]'`.
"""

# First: without a screen it lets dm_control, which Shimmy imports, draw by EGL.
from trl_suite import suite  # isort: split

import gymnasium
from shimmy.dm_control_compatibility import DmControlCompatibilityV0


def main() -> None:
    # One vector: Gymnasium sorts the keys of a dict of blocks, and would flatten it in that order.
    environment = suite.build(
        'raptor', 'muscle', 'slopes_mixed', environment_kwargs={'flat_observation': True}
    )
    env = DmControlCompatibilityV0(environment, 'rgb_array', {'camera_id': 'raptor/side'})
    env = gymnasium.wrappers.FlattenObservation(env)
    env.reset(seed=1)  # the episode of task_kwargs={'random': 1}
    env.action_space.seed(1)
    total, ended = 0.0, False
    while not ended:
        _, reward, terminated, truncated, _ = env.step(env.action_space.sample())
        total, ended = total + reward, terminated or truncated
    print(f'return {total:.1f}, {environment.info["distance"]:.2f} m, fell: {terminated}')
    print(f'picture of shape {env.render().shape}')
    env.close()


if __name__ == '__main__':
    main()
