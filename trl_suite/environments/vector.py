"""Many simulations of one environment, each on its own terrain, stepped on threads, as arrays.

    environments = VectorEnvironment('PD_Biped2D_Gaps_Terrain-v0', num_envs=64, seed=1)
    observation = environments.reset()
    step = environments.step(actions)  # (64, 11) in [-1, 1]

Simulation i is bit-identical to the single environment with the seed `environments.seeds[i]`, for
any number of simulations and threads, and whenever other simulations are reset.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike

from trl_suite import rendering
from trl_suite.engine import BatchWorld, light_model
from trl_suite.environments import arguments, hooks, states
from trl_suite.environments.arguments import Ids
from trl_suite.environments.core import Core
from trl_suite.environments.environment import Environment
from trl_suite.registry.build import build_task
from trl_suite.registry.catalogue import EnvSpec, spec_of
from trl_suite.tasks.task import Task
from trl_suite.util import errors
from trl_suite.util.options import checked

MOST_ENVS = 2**20  # simulations of one batch
MOST_THREADS = 4096
AUTORESET = ('next_step', 'same_step', 'disabled')


class Step(NamedTuple):
    """The results of one step of all simulations.

    Attributes:
      observation: (n, size), or a dict of blocks (n, ...) in order.
      reward: (n,).
      terminated: whether the episode failed, (n,) bool.
      truncated: whether the step or time limit ended the episode, not a failure, (n,) bool.
      info: arrays (n, ...) by name: 'fell', 'diverged', 'distance', 'reward_terms' (a dict), ...;
        with autoreset 'same_step' also 'ended' and, if an episode ended, 'final_observation'.
    """

    observation: Any
    reward: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    info: dict[str, Any]


class VectorEnvironment:
    """n simulations of one environment.

    `autoreset` has the modes of Gymnasium 1. With 'next_step', a simulation whose episode has ended
    ignores its action in the next step and returns the first observation of a new episode with
    reward 0. With 'same_step', it is reset in the step in which its episode ended: the observation
    is the first of the new episode, and the last one of the old episode is in
    `info['final_observation']`. With 'disabled', the caller resets simulations; stepping a
    simulation whose episode has ended raises an exception.

    In all methods, `env_ids` are indices of simulations, or a mask (n,) bool; None for all.

    Attributes:
      core: the simulations, see `trl_suite.environments.core.Core`.
      num_envs: number of simulations n.
      at_limit: whether the last step reached the step or time limit, also if it failed, (n,) bool.
      blocks: slice of each observation block in the flat vector.
      action_map: the map from actions to physical units.
      control_timestep: duration of a step, s; of gaits and footsteps nominal, as it varies
        (`task.steps_vary`).
    """

    def __init__(
        self,
        environment: str | EnvSpec,
        num_envs: int,
        num_threads: int = 0,
        seed: int | Sequence[int] | None = None,
        *,
        autoreset: str = 'next_step',
        dtype: DTypeLike = np.float64,
        flat_observation: bool = True,
        step_limit: int | None = -1,
        task_kwargs: Mapping[str, Any] | None = None,
    ) -> None:
        """Compiles one model without visual assets and makes n simulations of it.

        Args:
          environment: id, alias, or `EnvSpec`.
          num_envs: number of simulations.
          num_threads: threads that step the physics; 0 uses all cores.
          seed: one seed for all: simulation i gets the i-th number of
            `numpy.random.SeedSequence(seed).generate_state(n)`. Or a sequence of n seeds, one
            per simulation. Drawn from the operating system if None.
          autoreset: one of `AUTORESET`.
          dtype: type of observations and rewards, float64 or float32.
          flat_observation: return observations as one array instead of a dict of blocks.
          step_limit: control steps after which an episode is truncated; by default (-1) that of the
            `EnvSpec`; None for no limit.
          task_kwargs: as for `suite.load`, including `time_limit` (s) and `step_limit`, which
            overrides the argument above; not `random`, for which the argument `seed` is used.

        Raises:
          ValueError: unknown names or options, or numbers out of range.
        """
        checked('num_envs', num_envs, int, at_least=1, at_most=MOST_ENVS)
        checked('num_threads', num_threads, int, at_least=0, at_most=MOST_THREADS)
        errors.check_known('autoreset', AUTORESET, autoreset)
        checked('flat_observation', flat_observation, bool)
        self.spec, self.dtype = spec_of(environment), arguments.check_dtype(dtype)
        self.num_envs, self.autoreset = int(num_envs), autoreset
        self.flat_observation = flat_observation
        self._task_kwargs = options = errors.options('task_kwargs', task_kwargs)
        if 'random' in options:
            raise ValueError("task_kwargs has 'random'; use the argument `seed` instead")
        if isinstance(step_limit, int) and step_limit == -1:
            step_limit = self.spec.step_limit
        self.step_limit, self.time_limit = arguments.limits(
            options.pop('step_limit', step_limit), options.pop('time_limit', math.inf)
        )
        task = build_task(self.spec, options)
        hooks.check(task)
        if names := hooks.called(task):
            raise ValueError(
                f'the task or an entity in it has a hook {names[0]}, which only a single Environment calls'
            )
        entities = (each.observables.as_dict() for each in task.root_entity.iter_entities())
        for own in (*entities, vars(task).get('_task_observables', {})):
            for name, each in own.items():
                if each.enabled and name not in task.blocks:
                    raise ValueError(
                        f'observable {name!r} is one that only a single Environment has; expected the option '
                        "'observations'"
                    )
        model = light_model(task.root_entity.mjcf_model)
        task.attach(BatchWorld(model, self.num_envs, int(num_threads), task.fields))
        streams = [np.random.RandomState(0)] * self.num_envs
        self.core = Core(task, 'vector environment', streams, threads=True)
        self.blocks, self.action_map = dict(task.blocks), task.action_map
        self.control_timestep: float = task.control_timestep
        self.at_limit = np.zeros(self.num_envs, bool)
        self._picture: Environment | None = None
        self.seed(seed)

    def seed(self, seed: int | Sequence[int] | None, env_ids: Ids = None) -> None:
        """Reseeds the random streams, from which resets draw, of some simulations or of all.

        Args:
          seed: one seed for all n simulations or n seeds, as for the constructor.
          env_ids: simulations to reseed.

        Raises:
          TypeError: a seed that is not an integer.
          ValueError: a negative seed, or a wrong number of seeds.
        """
        with self.core as core:
            seeds = arguments.all_seeds(seed, self.num_envs)
            for env_id in arguments.unique_ids(env_ids, self.num_envs).tolist():
                core.seeds[env_id] = seeds[env_id]
                core.random[env_id] = np.random.RandomState(int(seeds[env_id]))

    def reset(
        self,
        env_ids: Ids = None,
        seed: int | Sequence[int] | None = None,
        level: int | Sequence[int] | None = None,
    ) -> Any:
        """Begins an episode in some simulations, or in all; the others are unchanged.

        Args:
          env_ids: simulations in which an episode begins.
          seed: reseeds these simulations first: one seed for all n simulations or n seeds, as for
            the constructor.
          level: with the option `levels`, the seed of the terrain: one for these simulations, or one
            for each, in ascending order of their indices; drawn if None.

        Returns:
          The observations of all simulations.

        Raises:
          ValueError: there is no such level, and for invalid arguments.
        """
        with self.core as core:
            ids = arguments.unique_ids(env_ids, self.num_envs)
            if core.fresh and len(ids) < self.num_envs:
                raise ValueError('the first reset must be of all simulations')
            if seed is not None:
                arguments.all_seeds(seed, self.num_envs)  # raises before anything changes
            if level is not None:
                core.task.choose_level(ids, level)
            if seed is not None:
                self.seed(seed, ids)
            core.share(core.begin, ids)
            self._find_limits(ids.tolist())
            return self._blocks(core.task.seen.observation.astype(self.dtype))

    def step(self, action: np.ndarray, env_ids: Ids = None) -> Step:
        """Takes one step in every simulation, or in some.

        Args:
          action: (n, k), clipped to [-1, 1].
          env_ids: simulations that take a step. The others are not stepped: their reward and its
            terms are 0, and their other entries of `info` are those of their last step.

        Raises:
          ValueError: actions of the wrong shape, or NaN or infinity in one that is not ignored; the
            message names the simulation.
          RuntimeError: before the first reset, after `close`, in a forked process, while another
            thread uses the environment, or with autoreset 'disabled' for a simulation that has
            ended.
        """
        with self.core as core:
            return self._step(core, action, env_ids)

    def _step(self, core: Core, action: np.ndarray, env_ids: Ids) -> Step:
        if core.fresh:
            raise RuntimeError('step before the first reset')
        action, task = self.action_map.numbers(action, self.num_envs), core.task
        everyone = core.world.all_ids
        asked = everyone if env_ids is None else arguments.unique_ids(env_ids, self.num_envs)
        over = core.ended[asked]
        resetting, stepped = asked[over], asked[~over]
        if len(resetting) and self.autoreset == 'disabled':
            raise RuntimeError(
                f'simulation {resetting[0]} has ended; reset it, or choose another autoreset'
            )
        some_rest = len(stepped) < self.num_envs
        if some_rest:
            resting = np.ones(self.num_envs, bool)
            resting[stepped] = False
            action = np.where(resting[:, None], 0.0, action)
        self.action_map.check_finite(action)

        def work(part: np.ndarray) -> None:
            over = np.isin(part, resetting)
            core.begin(part[over])
            task.advance(action, part[~over])
            # A slice is copied faster than an array of indices.
            near = len(part) and part[-1] - part[0] == len(part) - 1
            env_ids = slice(part[0], part[-1] + 1) if near else part
            observation[env_ids] = task.seen.observation[env_ids]

        observation = np.empty(task.seen.observation.shape, self.dtype)
        core.share(work, asked)
        self.at_limit = np.zeros(self.num_envs, bool)
        self.at_limit[stepped] = core.count(stepped, self.step_limit, self.time_limit)
        reward, terminated, info = task.seen.reward.copy(), task.seen.failed.copy(), task.info()
        if some_rest:
            for each in (reward, terminated, *info.get('reward_terms', {}).values()):
                each[resting] = 0
        truncated = self.at_limit & ~terminated
        if self.autoreset == 'same_step':
            info['ended'] = ended = np.zeros(self.num_envs, bool)
            ended[stepped] = core.ended[stepped]
            if ended.any():
                info['final_observation'] = self._blocks(task.seen.observation.astype(self.dtype))
                core.share(core.begin, ended.nonzero()[0])
                observation = task.seen.observation.astype(self.dtype)
        if len(asked) < self.num_envs:
            observation = task.seen.observation.astype(self.dtype)
        reward = reward.astype(self.dtype, copy=False)
        return Step(self._blocks(observation), reward, terminated, truncated, info)

    @property
    def info(self) -> dict[str, Any]:
        """Further results of each simulation's last step or reset: see the task's `info`."""
        return self.task.info()

    def render(self, env_id: int = 0, **options: Any) -> np.ndarray:
        """Renders one simulation, (h, w, 3) uint8; options as for `trl_suite.rendering.frame`."""
        with self.core as core:
            if self._picture is None:  # the models of the simulations have no visual assets
                self._picture = Environment(build_task(self.spec, self._task_kwargs))
                self._picture.reset()
            ids = arguments.given_ids([env_id], self.num_envs)
            self._picture.core.write(core.read(ids), [0])
            return rendering.frame(self._picture, **options)

    @property
    def seeds(self) -> np.ndarray:
        """Seeds of the random streams, (n,) uint32."""
        return self.core.seeds.copy()

    @property
    def level(self) -> np.ndarray | None:
        """Level of the episode of each simulation, (n,); None without the option `levels`."""
        levels = self.task.levels
        return None if levels is None else levels.state.level.copy()

    @property
    def task(self) -> Task:
        """The task, whose arrays have a leading axis of n simulations."""
        return self.core.usable().task

    def close(self) -> None:
        """Frees the simulations; may be called twice."""
        if self.core.close() and self._picture is not None:
            self._picture.close()

    def get_state(self, env_ids: Ids = None) -> dict[str, Any]:
        """Returns the complete state of some simulations, or of all."""
        return self.core.get_state(env_ids)

    def set_state(self, state: dict[str, Any], env_ids: Ids = None) -> None:
        """Restores a state from `get_state` of an environment with the same id and options.

        Args:
          state: state of m simulations.
          env_ids: the m simulations to restore, without repeats.

        Raises:
          TypeError: the state is not a dict.
          ValueError: the state belongs to an environment with other contents, such as another
            ground, has another number of simulations, or was changed after `get_state`, or
            `env_ids` is invalid; this environment is unchanged.
          RuntimeError: only some simulations are restored before the first reset.
        """
        self.core.set_state(state, env_ids)
        self._find_limits(arguments.given_ids(env_ids, self.num_envs))

    def copy_from(
        self, other: VectorEnvironment, other_ids: Sequence[int], env_ids: Sequence[int]
    ) -> None:
        """Copies the state of simulations of another environment, e.g. to try actions.

        Random streams and seeds are not copied: the copies evolve identically until a random number
        is drawn from these streams.

        Args:
          other: environment with the same id and options, or this one.
          other_ids: its simulations, whose states before the call are copied.
          env_ids: as many simulations of this environment, without repeats.

        Raises:
          TypeError: `other` is not a vector environment.
          ValueError: an environment with another id or options, or invalid indices.
          RuntimeError: one of the two environments was never reset.
        """
        if not isinstance(other, VectorEnvironment):
            raise TypeError(f'other is {type(other).__name__}; expected VectorEnvironment')
        with self.core as core, other.core as others:
            if core.fresh or others.fresh:
                raise RuntimeError('copy_from before the first reset')
            difference = states.differences(others.signature, core.signature)
            if difference:
                raise ValueError(
                    f'cannot copy simulations of {other.spec.id} to {self.spec.id}: {difference}'
                )
            sources = arguments.given_ids(other_ids, other.num_envs)
            ids = arguments.given_ids(env_ids, self.num_envs)
            if len(sources) != len(ids) or len(set(ids)) != len(ids):
                raise ValueError(
                    f'cannot copy {len(sources)} simulations to simulations {ids}; expected as many '
                    'different ones'
                )
            core.write(others.read(sources), ids)
            self._find_limits(ids)

    def _find_limits(self, ids: list[int]) -> None:
        """Updates `at_limit` of some simulations, whose state has been replaced."""
        self.at_limit = self.at_limit.copy()
        self.at_limit[ids] = self.core.at_limit(ids, self.step_limit, self.time_limit)

    def __getstate__(self) -> dict[str, Any]:
        raise TypeError(
            'a vector environment cannot be pickled; pickle its arguments (id, num_envs, seed) and '
            'get_state(), and construct a new one from these'
        )

    def _blocks(self, flat: np.ndarray) -> Any:
        """Returns observations (n, size) in the form that the user gets: an array, or a dict."""
        if self.flat_observation:
            return flat
        return {name: flat[:, part] for name, part in self.blocks.items()}
