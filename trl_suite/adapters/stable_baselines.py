"""Stable-Baselines3's interface: a `VecEnv` that wraps a `VectorEnvironment`.

    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecMonitor
    from trl_suite.adapters.stable_baselines import SuiteVecEnv

    envs = VecMonitor(SuiteVecEnv('PD_Biped2D_Flat-v0', num_envs=64))
    PPO('MlpPolicy', envs).learn(1_000_000)

Single environments need no adapter: Stable-Baselines3 accepts `gymnasium.make('trl_suite/ID')`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from trl_suite.adapters.gym import SuiteVectorEnv, flat
from trl_suite.environments.vector import VectorEnvironment
from trl_suite.registry.catalogue import EnvSpec
from trl_suite.util import errors

try:
    from stable_baselines3.common.vec_env import VecEnv
except ImportError as error:
    message = f"trl_suite.adapters.stable_baselines needs an extra ({error}): pip install 'trl_suite[sb3]'"
    raise ImportError(message) from None

Indices = None | int | Iterable[int]


class SuiteVecEnv(VecEnv):
    """Many simulations on threads; a simulation whose episode ends is reset in the same step.

    The info of a simulation has 'fell', 'diverged', 'distance' (m), 'reward_NAME' for each reward
    term and 'TimeLimit.truncated'; if its episode ended, also 'terminal_observation'.

    Attributes:
      environment: the wrapped `trl_suite.environments.vector.VectorEnvironment`.
    """

    def __init__(
        self, environment: str | EnvSpec | VectorEnvironment, num_envs: int = 1,
        num_threads: int = 0, seed: int | Sequence[int] | None = None, *,
        render_mode: str | None = None, render_kwargs: dict[str, Any] | None = None, **options: Any,
    ) -> None:  # fmt: skip
        """Makes the environment; arguments that are not listed are those of `VectorEnvironment`.

        Args:
          environment: id, alias, or `EnvSpec`; or a vector environment with autoreset 'same_step',
            for which only `render_mode` and `render_kwargs` have an effect.
          render_mode: 'rgb_array', or None for no rendering.
          render_kwargs: options of `trl_suite.rendering.frame`: height, width, camera, ghost.
          **options: `step_limit`, `task_kwargs`, and `flat_observation`: True for 'MlpPolicy', False
            for 'MultiInputPolicy'.

        Raises:
          ValueError: unknown names or options; the message has the closest matches.
        """
        if not isinstance(environment, VectorEnvironment):
            usual: dict[str, Any] = {'autoreset': 'same_step', 'dtype': np.float32}
            environment = VectorEnvironment(
                environment, num_envs, num_threads, seed, **usual | options
            )
        elif options or seed is not None or num_envs not in (1, environment.num_envs):
            raise ValueError(
                'num_envs, seed and options cannot change an environment that is already made'
            )
        if environment.autoreset != 'same_step':
            raise ValueError(f"autoreset is {environment.autoreset!r}; expected 'same_step'")
        self.environment = environment
        self._view = view = SuiteVectorEnv(
            environment, render_mode=render_mode, render_kwargs=render_kwargs
        )
        super().__init__(view.num_envs, view.single_observation_space, view.single_action_space)
        self.metadata = view.metadata

    def seed(self, seed: int | None = None) -> list[int]:
        """Reseeds all simulations, whose seeds are derived from one as in the constructor.

        Successive seeds have no episodes in common, as they would with the seeds s + i that
        Stable-Baselines3 gives to environments of its own. Episodes that begin by themselves draw from
        the new seeds, too.
        """
        self.environment.seed(seed)
        seeds: list[int] = self.environment.seeds.tolist()
        return seeds

    def reset(self) -> Any:
        """Starts an episode in every simulation; `set_options` may have set its 'level'."""
        for options in self._options:
            errors.check_known('option of reset', ('level',), *options)
        given = (each.get('level') for each in self._options)  # None: it is drawn
        levels = {i: level for i, level in enumerate(given) if level is not None}
        with self.environment.core as core:
            if levels:
                core.task.choose_level([*levels], [*levels.values()])
            observation = self.environment.reset()
        self._reset_options()
        self.reset_infos = rows_of(flat(self.environment.info))
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Stores the actions, (n, k), clipped to [-1, 1], for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Performs the step; errors are those of `VectorEnvironment.step`."""
        observation, reward, terminated, truncated, info = self.environment.step(self._actions)
        ended, final = info.pop('ended'), info.pop('final_observation', None)
        infos = rows_of({**flat(info), 'TimeLimit.truncated': truncated})
        if ended.any():
            begun = rows_of(flat(self.environment.info))
            for env_id in np.flatnonzero(ended).tolist():
                infos[env_id]['terminal_observation'] = row_of(final, env_id)
                self.reset_infos[env_id] = begun[env_id]
        return observation, reward, terminated | truncated, infos

    def close(self) -> None:
        """Frees the simulations; may be called twice."""
        self.environment.close()

    def get_images(self) -> list[np.ndarray | None]:
        """Draws every simulation, (h, w, 3) uint8 each; None if render_mode is None."""
        return list(self._view.call('render'))

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """Returns an attribute of `environment`, once for each index; see `SuiteVectorEnv.call`."""
        values = self._view.get_attr(attr_name)
        return [values[env_id] for env_id in self._get_indices(indices)]

    def has_attr(self, attr_name: str) -> bool:
        """Returns whether this environment or `environment` has an attribute."""
        return hasattr(self._view, attr_name) or hasattr(self.environment, attr_name)

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        self._view.set_attr(attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Indices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Returns the pictures of 'render'; other methods would concern all simulations.

        Raises:
          AttributeError: there is no such method.
          RuntimeError: another method.
          TypeError: an attribute, or arguments of 'render'.
        """
        values = self.get_attr(method_name, indices)
        if method_name != 'render' or method_args or method_kwargs:
            raise TypeError(f"{method_name!r} is called; expected 'render', without arguments")
        return values

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Indices = None) -> list[bool]:
        """Returns False for every simulation: none has a Gymnasium wrapper."""
        return [False for _ in self._get_indices(indices)]


def rows_of(info: dict[str, Any]) -> list[dict[str, Any]]:
    """Converts a dict of arrays of n simulations to n dicts of Python numbers, and of arrays."""
    columns = (each.tolist() if each.ndim == 1 else list(each.copy()) for each in info.values())
    return [dict(zip(info, row, strict=True)) for row in zip(*columns, strict=True)]


def row_of(observation: Any, env_id: int) -> Any:
    """Returns the observation of one simulation."""
    if isinstance(observation, dict):
        return {name: value[env_id] for name, value in observation.items()}
    return observation[env_id]
