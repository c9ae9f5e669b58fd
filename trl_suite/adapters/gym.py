"""Gymnasium's interface: `gymnasium.make` and `gymnasium.make_vec` for every id of the suite.

    import gymnasium
    import trl_suite.adapters.gym  # registers trl_suite/ID for every ID

    env = gymnasium.make('trl_suite/PD_Biped2D_Gaps_Terrain-v0')
    envs = gymnasium.make_vec('trl_suite/PD_Biped2D_Gaps_Terrain-v0', num_envs=64)

Gymnasium 1 does not register third-party environments automatically: without that import the id
must name the module, as in 'trl_suite.adapters.gym:trl_suite/PD_Biped2D_Gaps_Terrain-v0'. An
environment without an id is wrapped explicitly, e.g.
`SuiteEnv(suite.build('raptor', actuation='muscle'))`. A fall terminates an episode, the
environment's step limit truncates it; `info` has 'fell', 'diverged', 'distance' (m), and one entry
'reward_NAME' per reward term: their sum is the reward.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from trl_suite import rendering, suite
from trl_suite.bodies.reference import PHASE
from trl_suite.environments import arguments
from trl_suite.environments.environment import Environment
from trl_suite.environments.vector import VectorEnvironment
from trl_suite.registry import catalogue
from trl_suite.registry.spec import EnvSpec
from trl_suite.util import errors
from trl_suite.util.options import checked

try:
    import gymnasium
    from gymnasium import spaces
    from gymnasium.vector import AutoresetMode
    from gymnasium.vector.utils import batch_space, iterate
except ImportError as error:
    message = (
        f"trl_suite.adapters.gym needs Gymnasium ({error}): pip install 'trl_suite[gymnasium]'"
    )
    raise ImportError(message) from None

METADATA = {'render_modes': ['rgb_array'], 'render_fps': int(rendering.CONTROL_FPS)}  # of most ids
BOUNDS = {(PHASE.name, PHASE.size): (0.0, 1.0)}  # of observation blocks; others are unbounded
RENDER_OPTIONS = tuple(inspect.signature(rendering.frame).parameters)[1:]
_ONE_OBJECT = 'simulations share one object'
Info = dict[str, Any]


class SuiteEnv(gymnasium.Env[Any, np.ndarray]):
    """A single environment; `environment` is the wrapped `Environment` of `trl_suite.environments`.

    `reset(seed=s)` starts the same episode as the first reset of
    `suite.make(id, task_kwargs={'random': s})`; a reset without a seed starts the next episode.

    `truncated` is whether a step reached the step or time limit, also if the episode failed in this
    step, as for `gymnasium.wrappers.TimeLimit`.
    """

    metadata = METADATA

    def __init__(
        self, environment: str | EnvSpec | Environment, *, flat_observation: bool = True,
        task_kwargs: Info | None = None, dtype: DTypeLike = np.float32,
        max_episode_steps: int | None = None, render_mode: str | None = None,
        render_kwargs: Info | None = None,
    ) -> None:  # fmt: skip
        """Makes the environment.

        Args:
          environment: id, alias, `EnvSpec`, or an environment that is not used elsewhere.
          flat_observation: return all blocks concatenated as one vector, else a dict of blocks.
          task_kwargs: as for `suite.load`.
          dtype: dtype of observations and actions, float32 or float64.
          max_episode_steps: truncate after this number of steps, instead of the step limit of the id;
            -1 for never. If `task_kwargs` has a 'step_limit', the smaller one counts.
          render_mode: 'rgb_array', or None for no rendering. Gymnasium's `RecordVideo` needs the
            package moviepy.
          render_kwargs: options of `trl_suite.rendering.frame`: height, width, camera, ghost.

        Raises:
          ValueError: unknown names or options; the message has the closest matches.
        """
        self._flat = checked('flat_observation', flat_observation, bool)
        self._dtype = arguments.check_dtype(dtype)
        if not isinstance(environment, Environment):
            spec = catalogue.spec_of(environment)
            environment = suite.build_environment(spec, limited(task_kwargs, max_episode_steps), {})
        else:
            check_none(task_kwargs, max_episode_steps)
        self.environment, self.render_mode = environment, render_mode
        self._render_kwargs = rendered(render_mode, render_kwargs, environment.task)
        self.metadata = metadata(environment.task)
        shapes = {name: spec.shape for name, spec in environment.observation_spec().items()}
        self.observation_space, self.action_space = spaces_of(
            environment, shapes, flat_observation, self._dtype
        )

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Any, Info]:
        """Starts an episode, seeded if `seed` is given; one of 2**32 or more is hashed.

        `options` may have the 'level' of the environment's `reset`.
        """
        errors.check_known('option of reset', ('level',), *(options or {}))
        level = (options or {}).get('level')
        stream = arguments.stream_seed(seed)
        if seed is not None:
            arguments.check_seed('seed', stream)
            seed = int(seed)
        with self.environment.core as core:
            if level is not None:
                core.task.choose_level([0], level)
            if seed is not None:  # after all checks
                self.environment.random_state.seed(stream)
                core.seeds[0] = stream
            super().reset(seed=seed)
            time_step = self.environment.reset()
        return self._observation(time_step.observation), flat(self.environment.info)

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, Info]:
        """Applies one action, clipped to [-1, 1]; raises `ResetNeeded` if no episode is running."""
        if self.environment.core.usable().ended[0]:
            raise gymnasium.error.ResetNeeded('no episode is running; call reset first')
        time_step = self.environment.step(action)
        terminated = time_step.last() and time_step.discount == 0
        observation, info = self._observation(time_step.observation), flat(self.environment.info)
        return observation, time_step.reward, terminated, self.environment.at_limit, info

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """Draws the current state, (h, w, 3) uint8; None if render_mode is None."""
        self.environment.core.usable()
        return self.render_mode and rendering.frame(self.environment, **self._render_kwargs)  # type: ignore[return-value]

    def close(self) -> None:
        """Frees the simulation; may be called twice."""
        self.environment.close()

    def _observation(self, blocks: Mapping[str, np.ndarray]) -> Any:
        if self._flat:
            return np.concatenate([part.ravel() for part in blocks.values()], dtype=self._dtype)
        return {name: part.astype(self._dtype) for name, part in blocks.items()}


class SuiteVectorEnv(gymnasium.vector.VectorEnv[Any, np.ndarray, np.ndarray]):
    """A vector environment, the default of `gymnasium.make_vec`; wraps a `VectorEnvironment`.

    With the same seeds, simulation i equals environment i of a `SyncVectorEnv` of `SuiteEnv`.
    `reset(seed=[s0, s1, ...])` seeds every simulation. With `reset(seed=s)` simulation i gets the
    i-th number of `numpy.random.SeedSequence(s).generate_state(n)` as its seed, not s + i, so that
    successive seeds have no episodes in common. `truncated` is that of `SuiteEnv`.
    """

    def __init__(
        self, environment: str | EnvSpec | VectorEnvironment, num_envs: int = 1, *, num_threads: int = 0,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        flat_observation: bool = True, task_kwargs: Info | None = None,
        dtype: DTypeLike = np.float32, max_episode_steps: int | None = None,
        render_mode: str | None = None, render_kwargs: Info | None = None,
    ) -> None:  # fmt: skip
        """Makes the environment; the other arguments and errors are those of `SuiteEnv`.

        Args:
          environment: id, alias, `EnvSpec`, or a vector environment that is not used elsewhere, for
            which only `render_mode` and `render_kwargs` have an effect.
          num_envs: number of simulations.
          num_threads: threads that step the physics; 0 for all cores.
          autoreset_mode: 'NextStep', 'SameStep', 'Disabled', or Gymnasium's constants.
          dtype: dtype of observations, actions and rewards.
        """
        if not isinstance(environment, VectorEnvironment):
            modes = {mode.value: mode.name.lower() for mode in AutoresetMode}
            mode: Any = getattr(autoreset_mode, 'value', autoreset_mode)
            errors.check_known('autoreset_mode', modes, mode)
            options = limited(task_kwargs, max_episode_steps)
            environment = VectorEnvironment(
                environment, num_envs, num_threads, options.pop('random', None),
                autoreset=modes[mode], dtype=dtype, flat_observation=flat_observation,
                task_kwargs=options,
            )  # fmt: skip
        else:
            check_none(task_kwargs, max_episode_steps)
        self.environment, self.render_mode = environment, render_mode
        self.num_envs, dtype = environment.num_envs, environment.dtype
        self.autoreset_mode = AutoresetMode[environment.autoreset.upper()]  # TorchRL reads it
        self._render_kwargs = rendered(render_mode, render_kwargs, environment.task)
        self.metadata = {**metadata(environment.task), 'autoreset_mode': self.autoreset_mode}
        shapes = {name: (part.stop - part.start,) for name, part in environment.blocks.items()}
        self.single_observation_space, self.single_action_space = spaces_of(
            environment, shapes, environment.flat_observation, dtype
        )
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Info | None = None
    ) -> tuple[Any, Info]:
        """Starts episodes in all simulations, or in those of `options['reset_mask']`.

        They are seeded if `seed` is given, except where it is None. `options` may have the 'level' of the
        environment's `reset`.
        """
        errors.check_known('option of reset', ('level', 'reset_mask'), *(options or {}))
        env_ids = np.array((options or {}).get('reset_mask', np.ones(self.num_envs, bool)))
        if env_ids.dtype != bool or env_ids.shape != (self.num_envs,) or not env_ids.any():
            raise ValueError(
                f'reset_mask is {env_ids}; expected {self.num_envs} bools, not all false'
            )
        seeds: Any = seed
        level = (options or {}).get('level')
        if isinstance(seed, (list, tuple)) or (isinstance(seed, np.ndarray) and seed.ndim == 1):
            seeds = [*map(arguments.stream_seed, seed)]
            if None in seeds:
                known = np.array([each is not None for each in seeds])
                seeds = arguments.all_seeds([each or 0 for each in seeds], self.num_envs).tolist()
                with self.environment.core as core:  # whose errors come before anything changes
                    if core.fresh and not env_ids.all():
                        raise ValueError('the first reset must be of all simulations')
                    if level is not None:
                        core.task.choose_level(np.flatnonzero(env_ids), level)
                    self.environment.seed(seeds, env_ids & known)
                    seeds = level = None
        observation = self.environment.reset(env_ids, seeds, level)
        super().reset(seed=int(seed) if isinstance(seed, (int, np.integer)) else None)
        return observation, masked(flat(self.environment.info), env_ids)

    def step(self, actions: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, Info]:
        """Steps every simulation; arguments and errors are those of `VectorEnvironment.step`."""
        observation, reward, terminated, _, info = self.environment.step(actions)
        result: Info = {}
        ended = info.pop('ended', np.zeros(1, bool))
        if ended.any():  # and reset in the same step
            finals = iterate(self.observation_space, info.pop('final_observation'))
            last = (each if end else None for each, end in zip(finals, ended, strict=True))
            result = {'final_info': masked(flat(info), ended), '_final_info': ended.copy()}
            result |= {'final_obs': np.fromiter(last, object), '_final_obs': ended}
            info = self.environment.info
        result |= masked(flat(info), np.ones(self.num_envs, bool))
        return observation, reward, terminated, self.environment.at_limit, result

    def render(self) -> tuple[np.ndarray, ...] | None:  # type: ignore[override]
        """Draws every simulation; None if render_mode is None."""
        if self.render_mode is None:
            return None
        env_ids = range(self.num_envs)
        return tuple(self.environment.render(env_id, **self._render_kwargs) for env_id in env_ids)

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Returns an attribute of this object or of `environment`, or the picture, of each simulation.

        Of an array (n,), each simulation gets its own element.

        Raises:
          AttributeError: there is no such attribute.
          RuntimeError: a method other than 'render', since it would concern all simulations.
        """
        if name == 'render':
            return self.render() or (None,) * self.num_envs
        owner = self if hasattr(self, name) else self.environment
        value = getattr(owner, f'single_{name}' if hasattr(owner, f'single_{name}') else name)
        if callable(value):
            raise RuntimeError(f'{_ONE_OBJECT}: call {name} of its `environment`')
        own = isinstance(value, np.ndarray) and value.shape == (self.num_envs,)
        return tuple(value) if own else (value,) * self.num_envs

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Returns an attribute of each simulation; see `call`."""
        return self.call(name)

    def set_attr(self, name: str, values: Any) -> None:
        raise RuntimeError(f'{_ONE_OBJECT}: set {name} on its `environment`')

    def close_extras(self, **kwargs: Any) -> None:
        """Frees the simulations."""
        self.environment.close()

    def __del__(self) -> None:
        """Closes nothing, unlike Gymnasium 1.2: the wrapped environment may be in use elsewhere."""


def metadata(task: Any) -> Info:
    """Metadata of rendering; one frame per step plays in real time, except for gait cycles."""
    return {**METADATA, 'render_fps': max(1, round(1 / task.control_timestep))}


def rendered(render_mode: str | None, render_kwargs: Info | None, task: Any) -> Info:
    """Returns `render_kwargs` if it and `render_mode` are valid for a task."""
    checked('render_mode', render_mode, str | None, '', ['rgb_array'])
    options = errors.options('render_kwargs', render_kwargs)
    errors.check_known('option in render_kwargs', RENDER_OPTIONS, *options)
    if render_mode or options:
        rendering.check_options(task.world.models[0], task, **options)
    return options


def check_none(task_kwargs: Info | None, max_episode_steps: int | None) -> None:
    """Raises a ValueError if an environment is given, and options of a new one as well."""
    if task_kwargs or max_episode_steps is not None:
        raise ValueError(
            'task_kwargs and max_episode_steps cannot change an environment that is already made'
        )


def limited(task_kwargs: Info | None, max_episode_steps: int | None) -> Info:
    """Returns `task_kwargs` with the smaller of its step limit and `max_episode_steps`.

    By default the step limit is that of the id. `max_episode_steps` is Gymnasium's argument: None if it
    is not given, and -1 for no limit.
    """
    options = errors.options('task_kwargs', task_kwargs)
    if max_episode_steps == -1:
        return {'step_limit': None, **options}
    limit = checked('max_episode_steps', max_episode_steps, int | None, at_least=1)
    if limit is not None:
        own = checked('step_limit', options.get('step_limit'), int | None, at_least=1)
        options['step_limit'] = limit if own is None else min(own, limit)
    return options


def spaces_of(
    environment: Environment | VectorEnvironment,
    shapes: Mapping[str, tuple[int]],
    flat: bool,
    dtype: Any,
) -> tuple[spaces.Space[Any], spaces.Box]:
    """Returns the spaces of one simulation: blocks of these shapes, flat or not; actions in [-1, 1]."""
    bounds = {name: BOUNDS.get((name, *shape), (-np.inf, np.inf)) for name, shape in shapes.items()}
    # Pairs, as Dict would sort the keys of a dict.
    blocks = spaces.Dict([(n, spaces.Box(*bounds[n], s, dtype)) for n, s in shapes.items()])
    actions = spaces.Box(-1.0, 1.0, (len(environment.action_map),), dtype)
    return (spaces.flatten_space(blocks) if flat else blocks), actions


def flat(info: Info) -> Info:
    """Returns info without nested dicts, which few programs support.

    The entries are 'reward_NAME' for each term, and 'world_NAME' for each property of the world.
    """
    rest = {name: value for name, value in info.items() if not isinstance(value, dict)}
    for group in ('reward_terms', 'world'):
        prefix = group.removesuffix('_terms')
        rest |= {f'{prefix}_{name}': value for name, value in info.get(group, {}).items()}
    return rest


def unlimited(environment: str, **options: Any) -> SuiteEnv:
    """Makes an environment without a step limit: `gymnasium.make` adds a wrapper that truncates."""
    return SuiteEnv(environment, max_episode_steps=-1, **options)


unlimited.metadata = METADATA  # type: ignore[attr-defined]  # `gymnasium.make` reads the render modes from here


def masked(info: Info, env_ids: np.ndarray) -> Info:
    """Returns info in Gymnasium's format: 0 in other simulations, and for each key a mask, '_key'."""
    result: Info = {}
    for name, value in info.items():
        result[name] = value.copy()
        result[name][~env_ids] = 0
        result[f'_{name}'] = env_ids.copy()
    return result


for _id, _spec in catalogue.BY_ID.items():
    if f'trl_suite/{_id}' not in gymnasium.registry:
        gymnasium.register(
            f'trl_suite/{_id}',
            entry_point='trl_suite.adapters.gym:unlimited',
            vector_entry_point='trl_suite.adapters.gym:SuiteVectorEnv',
            kwargs={'environment': _id},
            max_episode_steps=_spec.step_limit,
        )
