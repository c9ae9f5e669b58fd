"""Many simulations of one environment, each on its own terrain, stepped on threads, as arrays.

    environments = VectorEnvironment('PD_Biped2D_Gaps_Terrain-v0', num_envs=64, seed=1)
    observation = environments.reset()
    step = environments.step(actions)  # (64, 11) in [-1, 1]

Simulation i is bit-identical to the single environment with the seed `environments.seeds[i]`, for
any number of simulations and threads, and whenever other simulations are reset.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike

from trl_suite import rendering
from trl_suite.environments import arguments, states
from trl_suite.environments.environment import Environment
from trl_suite.environments.simulations import Simulations
from trl_suite.registry.build import build_task
from trl_suite.registry.catalogue import EnvSpec, spec_of
from trl_suite.tasks.task import Task
from trl_suite.util import errors

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

    Attributes:
      num_envs: number of simulations n.
      seeds: seed of each simulation, (n,) uint32.
      at_limit: whether the last step reached the step or time limit, also if it failed, (n,) bool.
      blocks: slice of each observation block in the flat vector.
      action_map: the map from actions to physical units.
      control_timestep: duration of a step, s.
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
        errors.check_whole('num_envs', num_envs, 1, MOST_ENVS)
        errors.check_whole('num_threads', num_threads, 0, MOST_THREADS, '; 0 uses all cores')
        if autoreset not in AUTORESET:
            raise ValueError(errors.unknown('autoreset', autoreset, AUTORESET))
        try:
            known = np.dtype(dtype) in (np.dtype(np.float64), np.dtype(np.float32))
        except TypeError:
            known = False
        if not known:
            raise ValueError(f'dtype is {dtype!r}; expected float64 or float32')
        errors.check_kind('flat_observation', flat_observation, bool)
        self.spec = spec_of(environment)
        self.num_envs, self.autoreset, self.dtype = int(num_envs), autoreset, np.dtype(dtype)
        self.flat_observation = flat_observation
        self._task_kwargs = options = arguments.absolute(errors.options('task_kwargs', task_kwargs))
        if 'random' in options:
            raise ValueError("task_kwargs has 'random'; use the argument `seed` instead")
        own = (
            self.spec.step_limit if isinstance(step_limit, int) and step_limit == -1 else step_limit
        )
        self.step_limit = arguments.check_step_limit(options.pop('step_limit', own))
        self.time_limit = arguments.check_time_limit(options.pop('time_limit', float('inf')))
        task = build_task(self.spec, self._task_kwargs)
        self._simulations: Simulations | None = Simulations(task, self.num_envs, int(num_threads))
        self._pid = os.getpid()
        self._one_thread = arguments.OneThread()
        self.blocks, self.action_map = dict(task.blocks), task.action_map
        self.control_timestep: float = task.control_timestep
        self.seeds = self._simulations.seeds
        self.at_limit = np.zeros(self.num_envs, bool)
        self._picture: Environment | None = None
        self.seed(seed)

    def seed(
        self,
        seed: int | Sequence[int] | None,
        env_ids: np.ndarray | Sequence[int] | None = None,
    ) -> None:
        """Reseeds the random streams, from which resets draw, of some simulations or of all.

        Args:
          seed: one seed for all n simulations or n seeds, as for the constructor.
          env_ids: numbers of the simulations to reseed, or a mask (n,) bool; None for all.

        Raises:
          TypeError: a seed that is not an integer.
          ValueError: a negative seed, or a wrong number of seeds.
        """
        with self._one_thread:
            simulations = self._usable()
            seeds = arguments.all_seeds(seed, self.num_envs)
            simulations.seed(seeds, arguments.unique_ids(env_ids, self.num_envs))

    def reset(
        self,
        env_ids: np.ndarray | Sequence[int] | None = None,
        seed: int | Sequence[int] | None = None,
    ) -> Any:
        """Begins an episode in some simulations, or in all; the others are unchanged.

        Args:
          env_ids: numbers of simulations, or a mask (n,) bool; None for all.
          seed: reseeds these simulations first: one seed for all n simulations or n seeds, as for
            the constructor.

        Returns:
          The observations of all simulations.
        """
        with self._one_thread:
            simulations = self._usable()
            numbers = arguments.unique_ids(env_ids, self.num_envs)
            if simulations.fresh and len(numbers) < self.num_envs:
                raise ValueError('the first reset must be of all simulations')
            if seed is not None:
                self.seed(seed, numbers)
            simulations.fresh = False
            self.share(self.begin, numbers)
            return self._observation()

    def step(self, action: np.ndarray, env_ids: np.ndarray | Sequence[int] | None = None) -> Step:
        """Takes one step in every simulation, or in some.

        Args:
          action: (n, k), clipped to [-1, 1].
          env_ids: numbers of simulations, or a mask (n,) bool; None for all. The others are not
            stepped: their reward and its terms are 0, and their other entries of `info` are those
            of their last step.

        Raises:
          ValueError: an action of the wrong shape, or with NaN or infinity; the message names the
            simulation.
          RuntimeError: before the first reset, after `close`, in a forked process, while another
            thread uses the environment, or with autoreset 'disabled' for a simulation that has
            ended.
        """
        with self._one_thread:
            return self._step(self._usable(), action, env_ids)

    def _step(
        self,
        simulations: Simulations,
        action: np.ndarray,
        env_ids: np.ndarray | Sequence[int] | None,
    ) -> Step:
        if simulations.fresh:
            raise RuntimeError('step before the first reset')
        action = self.action_map.checked(action, self.num_envs)
        task, world = simulations.task, simulations.world
        steps, ended = simulations.steps, simulations.ended
        asked = world.all_ids if env_ids is None else arguments.unique_ids(env_ids, self.num_envs)
        resetting, env_ids = asked[ended[asked]], asked[~ended[asked]]
        if len(resetting) and self.autoreset == 'disabled':
            raise RuntimeError(
                f'simulation {resetting[0]} has ended; reset it, or choose another autoreset'
            )

        def work(part: np.ndarray) -> None:
            over = np.isin(part, resetting)
            self.begin(part[over])
            task.step(action, part[~over])
            # A slice is copied faster than an array of indices.
            near = len(part) and part[-1] - part[0] == len(part) - 1
            env_ids = slice(part[0], part[-1] + 1) if near else part
            observation[env_ids] = task.observation[env_ids]

        observation = np.empty(task.observation.shape, self.dtype)
        self.share(work, asked)
        steps[env_ids] += 1
        reward, terminated, info = task.reward.copy(), task.failed.copy(), task.info()
        if len(env_ids) < self.num_envs:
            resting = np.ones(self.num_envs, bool)
            resting[env_ids] = False
            for each in (reward, terminated, *info.get('reward_terms', {}).values()):
                each[resting] = 0
        self.at_limit = truncated = np.zeros(self.num_envs, bool)
        if self.step_limit is not None:
            truncated[env_ids] = steps[env_ids] >= self.step_limit
        if self.time_limit < np.inf:
            truncated[env_ids] |= world.time[env_ids] >= self.time_limit - arguments.TIME_ERROR
        truncated = truncated & ~terminated
        ended[asked] = terminated[asked] | truncated[asked]
        if self.autoreset == 'same_step':
            info['ended'] = ended.copy()
            if ended.any():
                info['final_observation'] = self._observation()
                self.share(self.begin, ended.nonzero()[0])
                observation = task.observation.astype(self.dtype)
        if len(asked) < self.num_envs:
            observation = task.observation.astype(self.dtype)
        reward = reward.astype(self.dtype, copy=False)
        return Step(self._parts(observation), reward, terminated, truncated, info)

    @property
    def info(self) -> dict[str, Any]:
        """Further results of each simulation's last step or reset: see the task's `info`."""
        return self._usable().task.info()

    def render(self, env_id: int = 0, **options: Any) -> np.ndarray:
        """Renders one simulation, (h, w, 3) uint8; options as for `trl_suite.rendering.frame`."""
        with self._one_thread:
            simulations = self._usable()
            if self._picture is None:  # the models of the simulations have no visual assets
                self._picture = Environment(build_task(self.spec, self._task_kwargs))
                self._picture.reset()
            arguments.given_ids([env_id], self.num_envs)
            self._picture.task.set_state(0, simulations.task.get_state(env_id))
            self._picture.task.world.set_state(0, simulations.world.get_state(env_id))
            return rendering.frame(self._picture, **options)

    @property
    def task(self) -> Task:
        """The task, whose arrays have a leading axis of n simulations."""
        return self._usable().task

    def close(self) -> None:
        """Frees the simulations; may be called twice."""
        with self._one_thread:
            if self._simulations is not None and os.getpid() == self._pid:
                self._simulations.world.close()
            self._simulations = None
            if self._picture is not None:
                self._picture.close()
                self._picture = None

    def get_state(self, env_ids: np.ndarray | Sequence[int] | None = None) -> dict[str, Any]:
        """Returns the complete state of some simulations, or of all.

        Args:
          env_ids: numbers of m simulations, or a mask (n,) bool; None for all.
        """
        with self._one_thread:
            return self._usable().get_state(arguments.given_ids(env_ids, self.num_envs))

    def set_state(
        self, state: dict[str, Any], env_ids: np.ndarray | Sequence[int] | None = None
    ) -> None:
        """Restores a state from `get_state` of an environment with the same id and options.

        Args:
          state: state of m simulations.
          env_ids: numbers of the m simulations to restore, without repeats, or a mask (n,) bool;
            None for all.

        Raises:
          TypeError: the state is not a dict.
          ValueError: the state belongs to an environment with other contents, such as another
            ground, has another number of simulations, or was changed after `get_state`, or
            `env_ids` is invalid; this environment is unchanged.
          RuntimeError: only some simulations are restored before the first reset.
        """
        with self._one_thread:
            simulations = self._usable()
            if env_ids is not None and simulations.fresh:
                raise RuntimeError('set_state of some simulations before the first reset')
            simulations.set_state(state, arguments.given_ids(env_ids, self.num_envs))
            if env_ids is None:
                simulations.fresh = state['fresh']

    def copy_from(
        self, other: VectorEnvironment, other_ids: Sequence[int], env_ids: Sequence[int]
    ) -> None:
        """Copies the state of simulations of another environment, e.g. to try actions.

        Random streams and seeds are not copied: the copies evolve identically until a random number
        is drawn from these streams.

        Args:
          other: environment with the same id and options, or this one.
          other_ids: numbers of its simulations, whose states before the call are copied.
          env_ids: numbers of as many simulations of this environment, without repeats.

        Raises:
          TypeError: `other` is not a vector environment.
          ValueError: an environment with another id or options, or invalid simulation numbers.
          RuntimeError: one of the two environments was never reset.
        """
        if not isinstance(other, VectorEnvironment):
            raise TypeError(f'other is {type(other).__name__}; expected VectorEnvironment')
        with self._one_thread, other._one_thread:
            simulations, others = self._usable(), other._usable()
            if simulations.fresh or others.fresh:
                raise RuntimeError('copy_from before the first reset')
            difference = states.differences(others.signature, simulations.signature)
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
            simulations.copy_from(others, sources, ids)

    def __getstate__(self) -> dict[str, Any]:
        raise TypeError(
            'a vector environment cannot be pickled; pickle its arguments (id, num_envs, seed) and '
            'get_state(), and construct a new one from these'
        )

    def share(self, work: Callable[[np.ndarray], None], env_ids: np.ndarray) -> None:
        """Calls `work` on the threads, each time for a part of the simulations."""
        simulations = self._usable()
        if simulations.task.in_parts:
            simulations.world.share(work, env_ids)
        else:
            work(env_ids)

    def begin(self, env_ids: np.ndarray) -> None:
        """Begins episodes in some simulations, without the checks and observations of `reset`."""
        self._usable().begin(env_ids)

    def _observation(self) -> Any:
        return self._parts(self._usable().task.observation.astype(self.dtype))

    def _parts(self, flat: np.ndarray) -> Any:
        """Returns observations (n, size) in the form that the user gets: an array, or a dict."""
        if self.flat_observation:
            return flat
        return {name: flat[:, part] for name, part in self.blocks.items()}

    def _usable(self) -> Simulations:
        """Returns the simulations.

        Raises:
          RuntimeError: after `close`, or in a forked process.
        """
        if self._simulations is None:
            raise RuntimeError('the environment is closed')
        if os.getpid() != self._pid:
            raise RuntimeError(
                'a vector environment cannot be used after a fork: the child has no copy of its '
                "threads. Make it in the child, or use multiprocessing's start method 'spawn'"
            )
        return self._simulations
