"""n >= 1 simulations of a task: episodes, limits, random streams, saved states; and one as dm_env.

`Environment` shows one simulation as time steps of dm_env, and
`trl_suite.environments.vector.VectorEnvironment` many as arrays.
"""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Callable, Sequence
from typing import Any

import dm_env
import numpy as np
from dm_control import composer
from dm_control.composer import observation as composer_observation
from dm_env import specs

from trl_suite.environments import arguments, states
from trl_suite.environments.arguments import Ids
from trl_suite.rendering import contexts
from trl_suite.tasks.task import Task
from trl_suite.util import interrupts
from trl_suite.util.options import checked

TIME_ERROR = 1e-6  # s; more than the error of a sum of physics steps, less than one of them
HIGHLIGHT = (0.0, 0.5, 0.3)  # colour of a character with a reward of 1, as in dm_control.suite
CAUSES = ('fell', 'stuck', 'diverged')  # entries of `info` that tell how a task failed
FLAT_OBSERVATION_KEY = 'observations'  # dm_control's name of the flat vector
_SUBSTEP_HOOKS = ('before_substep', 'after_substep')
_NO_SUBSTEPS = 'substeps run in one call to C; use a plain composer.Environment for this task'


contexts.install()  # pictures of `physics.render`, too, may come from any thread


class Core:
    """n simulations, each with its random stream and its progress in an episode.

    `with core:` encloses their use. It raises a RuntimeError after `close`, in a forked process that
    lacks the threads, and while another thread is inside, since two threads that step the same
    simulation would crash the process; the same thread may enter again.

    Attributes:
      task: the task, bound to the simulations.
      world: the simulations of the physics.
      random: random stream of each simulation, from which resets draw.
      seeds: seeds of the random streams, (n,) uint32; 0 if they are not known.
      steps: steps since the beginning of the episode, (n,).
      ended: whether the episode has ended, so that a reset is needed, (n,) bool.
      fresh: whether no simulation was ever reset.
      signature: of saved states, see `states`.
    """

    def __init__(
        self, task: Task, kind: str, random: list[np.random.RandomState], threads: bool = False
    ) -> None:
        """Begins before the first reset.

        Args:
          task: the task, bound to n simulations.
          kind: of the environment; saved states of one kind are refused by others.
          random: random stream of each simulation.
          threads: whether the simulations have threads, which a forked process lacks.
        """
        n = task.world.n
        self.task, self.world, self.random = task, task.world, random
        self.seeds, self.steps = np.zeros(n, np.uint32), np.zeros(n, int)
        self.ended, self.fresh = np.ones(n, bool), True
        self.signature = states.signature(task, kind)
        self._lock, self._closed = threading.RLock(), False
        self._pid = os.getpid() if threads else None

    def __enter__(self) -> Core:
        if not self._lock.acquire(blocking=False):
            raise RuntimeError(
                'another thread is using the environment; make one environment for each thread'
            )
        if self._closed or self._pid is not None:
            try:
                self.usable()
            except RuntimeError:
                self._lock.release()
                raise
        return self

    def __exit__(self, *error: object) -> None:
        self._lock.release()

    def usable(self) -> Core:
        """Returns these simulations.

        Raises:
          RuntimeError: after `close`, or in a forked process.
        """
        if self._closed:
            raise RuntimeError('the environment is closed')
        if self._pid is not None and self._pid != os.getpid():
            raise RuntimeError(
                'a vector environment cannot be used after a fork: the child has no copy of its '
                "threads. Make it in the child, or use multiprocessing's start method 'spawn'"
            )
        return self

    def close(self) -> bool:
        """Lets the simulations go; returns whether they were there, and usable in this process."""
        if self._closed or self._pid not in (None, os.getpid()):
            return False
        with self:
            self.world.close()
            self._closed = True
            del self.task, self.world  # whose arrays would keep models and data in memory
        return True

    def share(self, work: Callable[[np.ndarray], None], ids: np.ndarray) -> None:
        """Calls `work` on the threads, each time for a part of some simulations."""
        if self.task.in_parts:
            self.world.share(work, ids)
        else:
            work(ids)

    def begin(self, ids: np.ndarray) -> None:
        """Begins episodes in some simulations of a vector environment."""
        if len(ids):
            self.ended[ids] = True  # until the reset has succeeded
            self.task.begin(ids, [self.random[env_id] for env_id in ids.tolist()])
            self.restart(ids)

    def restart(self, ids: Any) -> None:
        """Notes that an episode begins in some simulations; `ids` is an index, or several."""
        self.steps[ids], self.ended[ids], self.fresh = 0, False, False

    def count(self, ids: Any, step_limit: int | None, time_limit: float) -> Any:
        """Counts a step of some simulations; ends episodes that failed or reached a limit.

        Args:
          ids: index of a simulation, or indices of several.
          step_limit: in steps; None for no limit.
          time_limit: in s.

        Returns:
          Whether they reached a limit, also if they failed.
        """
        steps = self.steps[ids] = self.steps[ids] + 1
        # NumPy's False: an operation of a NumPy bool with Python's takes half a microsecond.
        at_limit = np.False_ if step_limit is None else steps >= step_limit
        if time_limit < math.inf:
            at_limit = at_limit | (self.world.time[ids] >= time_limit - TIME_ERROR)
        self.ended[ids] = at_limit | self.task.seen.failed[ids]
        return at_limit

    def read(self, ids: list[int]) -> dict[str, Any]:
        """Returns a copy of the state of some simulations, without their random streams."""
        return {
            'world': [self.world.get_state(env_id) for env_id in ids],
            'task': [self.task.get_whole_state(env_id) for env_id in ids],
            'steps': self.steps[ids],
            'ended': self.ended[ids],
        }

    def write(self, state: dict[str, Any], ids: list[int]) -> None:
        """Restores what `read` returned, in as many simulations."""
        for env_id, task, world in zip(ids, state['task'], state['world'], strict=True):
            self.task.set_whole_state(env_id, task)
            self.world.set_state(env_id, world)
        self.steps[ids], self.ended[ids] = state['steps'], state['ended']

    def get_state(self, env_ids: Ids = None) -> dict[str, Any]:
        """Returns the complete state of some simulations, or of all; see the environments."""
        with self:
            ids = arguments.given_ids(env_ids, len(self.ended))
            return states.seal({
                'made_for': dict(self.signature),
                **self.read(ids),
                'random': [self.random[env_id].get_state() for env_id in ids],
                'seeds': self.seeds[ids],
                'fresh': self.fresh,
            })  # fmt: skip

    def set_state(self, state: dict[str, Any], env_ids: Ids = None) -> None:
        """Restores a state in some simulations, or in all; see the environments."""
        with self:
            if env_ids is not None and self.fresh:
                raise RuntimeError('set_state of some simulations before the first reset')
            ids = arguments.given_ids(env_ids, len(self.ended))
            states.check(state, self.signature)
            if len(state['world']) != len(ids):
                raise ValueError(
                    f'the state has {len(state["world"])} simulations; expected {len(ids)}'
                )
            if len(set(ids)) != len(ids):
                raise ValueError(f'simulations {ids}; expected each of {len(ids)} simulations once')
            self.write(state, ids)
            for env_id, random in zip(ids, state['random'], strict=True):
                self.random[env_id].set_state(random)
            self.seeds[ids] = state['seeds']
            if env_ids is None:
                self.fresh = state['fresh']


class Environment(composer.Environment):
    """`composer.Environment` with all substeps of a step in one call.

    Differences from composer: substeps run in C (`before_substep` and `after_substep` hooks are
    rejected), observation blocks bypass the observation updater, divergence ends the episode
    instead of raising an exception, and the full state can be saved and restored.

    As usual in dm_env, `TimeStep.discount` of the last step is 0 if the task failed and 1 if the
    step or time limit ended the episode.

    Only one thread may use an environment at a time; a second one is rejected.

    Attributes:
      core: the simulation.
      blocks: slice of each observation block in the flat vector.
      action_map: the map from actions to physical units (`trl_suite.actuation.action_map.ActionMap`).
      step_limit: steps after which an episode is truncated, or None: control steps of 1/30 s, in
        planning environments footsteps, in gaits cycles.
      at_limit: whether the last step reached the step or time limit, also if it failed.
    """

    _task: Task

    def __init__(
        self,
        task: Task,
        *,
        step_limit: int | None = None,
        time_limit: float = float('inf'),
        random: int | Sequence[int] | np.random.RandomState | None = None,
        flat_observation: bool = False,
        visualize_reward: bool = False,
    ) -> None:
        """Compiles the task.

        Args:
          task: a task that no other environment uses.
          step_limit: steps after which an episode is truncated.
          time_limit: simulated time in s after which an episode is truncated.
          random: seed; drawn from the operating system if None.
          flat_observation: return all blocks as one vector, under the key 'observations'.
          visualize_reward: whether images show the reward, as in `dm_control.suite`: moving bodies
            turn green as it rises to 1.

        Raises:
          ValueError: a limit that is not positive, an invalid seed, a `flat_observation` or
            `visualize_reward` that is no bool, or substep hooks.
          TypeError: a seed that is not an integer.
        """
        self.step_limit, time_limit = arguments.limits(step_limit, time_limit)
        if isinstance(random, (int, float, str, bytes, np.random.Generator)):
            arguments.check_seed('random', random)
        checked('flat_observation', flat_observation, bool)
        checked('visualize_reward', visualize_reward, bool)
        self._flat_observation = flat_observation
        self.at_limit = False
        self.recipe: tuple[Callable[..., Environment], tuple[Any, ...]] | None = None
        super().__init__(
            task,
            time_limit=time_limit,
            random_state=random,
            strip_singleton_obs_buffer_dim=True,
            recompile_mjcf_every_episode=False,
        )
        task.random = self._random_state  # as tasks of dm_control.suite have it
        # The model is compiled already. Otherwise, composer would compile it again at the first
        # reset.
        self._mjcf_never_compiled = False
        self._colours = _colours(self._physics.model) if visualize_reward else None
        self.core = Core(task, 'single environment', [self._random_state])
        if arguments.is_integer(random):
            self.core.seeds[0] = random
        self.blocks, self.action_map = dict(task.blocks), task.action_map
        # Whether there are hooks to call before or after a step. Checking them takes time.
        self._hooked = any(self._entity_hooks(name) for name in ('before_step', 'after_step'))
        for name in _SUBSTEP_HOOKS:
            overridden = getattr(type(task), name) is not getattr(composer.Task, name)
            if overridden or self._entity_hooks(name):
                raise ValueError(f'the task or an entity in it has a {name} hook: {_NO_SUBSTEPS}')

    def _entity_hooks(self, name: str) -> list[Callable[..., None]]:
        """Returns the hooks of a name that entities override.

        dm_control compares bytecode, which differs from what it expects with `python -OO`.
        """
        empty = getattr(composer.Entity, name)
        hooks = getattr(self._hooks, f'_{name}').entity_hooks
        return [hook for hook in hooks if getattr(hook, '__func__', hook) is not empty]

    def add_extra_hook(self, hook_name: str, hook_callable: Callable[..., None]) -> None:
        self.core.usable()
        if hook_name in _SUBSTEP_HOOKS:
            raise ValueError(f'cannot add a {hook_name} hook: {_NO_SUBSTEPS}')
        super().add_extra_hook(hook_name, hook_callable)
        self._hooked = True

    def _make_observation_updater(self) -> composer_observation.Updater:
        # Of a user's own observables; with one substep, it counts a control step as a single update.
        blocks, known = self._task.blocks, self._task.observables
        own = {name: item for name, item in known.items() if item.enabled and name not in blocks}
        self._has_own_observables = bool(own)
        return composer_observation.Updater(own, 1, True, False)

    def reset(self, level: int | None = None) -> dm_env.TimeStep:
        """Begins an episode; returns its first time step.

        Args:
          level: with the option `levels`, the seed of its terrain; drawn if None.

        Raises:
          ValueError: there is no such level.
          RuntimeError: after `close`, or while another thread uses the environment.
        """
        with self.core as core:
            if level is not None:
                core.task.choose_level([0], level)
            core.ended[0] = True  # until the reset has succeeded
            self.at_limit = False
            self._show_reward(0.0)
            # Composer's hooks: that of the task, `Task.initialize_episode`, and those of entities.
            self._hooks.initialize_episode(self._physics_proxy, self._random_state)
            core.restart(0)
            if self._has_own_observables:
                self._observation_updater.reset(self._physics_proxy, self._random_state)
            return dm_env.restart(self._observe())

    def step(self, action: np.ndarray) -> dm_env.TimeStep:
        """Takes one action; begins a new episode instead if the last time step ended one.

        Args:
          action: clipped to [-1, 1], shape of `action_spec()`.

        Raises:
          ValueError: an action of the wrong shape, or with NaN or infinity.
          RuntimeError: after `close`, or while another thread uses the environment.
        """
        with self.core as core:
            action, task, physics = self.action_map.checked(action), core.task, self._physics_proxy
            if core.ended[0]:
                return self.reset()
            if self._has_own_observables:
                self._observation_updater.prepare_for_next_control_step()
            if self._hooked:  # by way of `Task.before_step` and `after_step`: the same as `advance`
                self._hooks.before_step(physics, action, self._random_state)
                task.simulate(core.world.all_ids)
                self._hooks.after_step(physics, self._random_state)
            else:
                task.advance(action[None], core.world.all_ids)
            self.at_limit = bool(core.count(0, self.step_limit, self._time_limit))
            if self._has_own_observables:
                self._observation_updater.update()
            reward, failed = float(task.seen.reward[0]), bool(task.seen.failed[0])
            self._show_reward(reward)
            step_type = dm_env.StepType.LAST if core.ended[0] else dm_env.StepType.MID
            return dm_env.TimeStep(step_type, reward, float(not failed), self._observe())

    def _show_reward(self, reward: float) -> None:
        if self._colours is not None:
            geoms, colours = self._colours
            share = min(max(reward, 0.0), 1.0) ** 4
            shown = share * np.array(HIGHLIGHT) + (1 - share) * colours
            self._physics.model.geom_rgba[geoms, :3] = shown

    def close(self) -> None:
        """Frees the simulation and the task. A second call does nothing."""
        # An interrupt halfway would leave a rendering context that is freed twice.
        with interrupts.postponed():
            if self.core.close():
                super().close()
                # These refer to arrays of the model and its data, and would keep them in memory.
                del self._task, self._hooks, self._observation_updater

    @property
    def task(self) -> Task:
        """The task, bound to one simulation.

        Raises:
          RuntimeError: after `close`.
        """
        return self.core.usable().task

    @property
    def level(self) -> int | None:
        """Level of the episode; None without the option `levels`."""
        levels = self.task.levels
        return None if levels is None else int(levels.state.level[0])

    @property
    def physics(self) -> Any:
        self.core.usable()
        return super().physics

    @property
    def info(self) -> dict[str, Any]:
        """Further results of the last step, by name: see the task's `info_arrays`."""
        return self.task.info_of(0)

    @property
    def ending(self) -> str:
        """Why the episode ended: 'fell', 'stuck', 'diverged', 'failed' or 'truncated'; '' before."""
        if self.core.fresh or not self.core.ended[0]:
            return ''
        if not self.task.seen.failed[0]:
            return 'truncated'
        info = self.info
        return next((cause for cause in CAUSES if info.get(cause)), 'failed')

    def observation(self) -> dict[str, np.ndarray]:
        """Returns the observation of the current state, e.g. after `set_state`."""
        self.core.usable()
        return self._observe()

    def _observe(self) -> dict[str, np.ndarray]:
        row, found = self._task.seen.observation[0].copy(), {}
        if not self._flat_observation:
            found = {name: row[part] for name, part in self.blocks.items()}
        if self._has_own_observables:
            own = self._observation_updater.get_observation()
            found |= {name: np.asarray(value, float) for name, value in own.items()}
        if self._flat_observation:
            parts = [row, *(value.ravel() for value in found.values())]
            return {FLAT_OBSERVATION_KEY: np.concatenate(parts)}
        return found

    def action_spec(self) -> specs.BoundedArray:
        return self.task.action_spec(self._physics_proxy)

    def observation_spec(self) -> dict[str, specs.Array]:
        return {
            name: specs.Array(value.shape, value.dtype, name)
            for name, value in self.observation().items()
        }

    def get_state(self) -> dict[str, Any]:
        """Returns the complete state: physics, task, terrain and random streams.

        The dict holds arrays and plain values; it can be pickled, and restored by any environment
        that was built in the same way.
        """
        return self.core.get_state()

    def set_state(self, state: dict[str, Any]) -> None:
        """Restores a state from `get_state`; the same actions then give bit-identical results.

        Errors are those of `VectorEnvironment.set_state`.
        """
        with self.core as core:
            core.set_state(state)
            if self._has_own_observables:
                self._observation_updater.reset(self._physics_proxy, self._random_state)

    def __reduce__(self) -> tuple[Any, ...]:
        if self.recipe is None:
            raise TypeError(
                'this environment was not made by trl_suite.suite, so it cannot be rebuilt from a '
                'pickle; pickle env.get_state() instead'
            )
        build, arguments = self.recipe
        return build, arguments, self.get_state()

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.set_state(state)


def _colours(model: Any) -> tuple[np.ndarray, np.ndarray]:
    """Returns the geoms of moving bodies, (g,), and their colours, (g, 3)."""
    geoms = np.flatnonzero(model.body_weldid[model.geom_bodyid] > 0)
    colours, materials = model.geom_rgba[geoms, :3].copy(), model.geom_matid[geoms]
    own = materials >= 0
    colours[own] = model.mat_rgba[materials[own], :3]
    return geoms, colours
