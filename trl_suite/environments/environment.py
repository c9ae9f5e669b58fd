"""One simulation of a task as time steps of dm_env."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import dm_env
import numpy as np
from dm_control import composer
from dm_control.composer import observation as composer_observation
from dm_env import specs

from trl_suite.environments import arguments, hooks
from trl_suite.environments.core import Core
from trl_suite.rendering import contexts
from trl_suite.tasks.task import Task
from trl_suite.util import interrupts
from trl_suite.util.options import checked

HIGHLIGHT = (0.0, 0.5, 0.3)  # colour of a character with a reward of 1, as in dm_control.suite
CAUSES = ('fell', 'stuck', 'diverged')  # entries of `info` that tell how a task failed
FLAT_OBSERVATION_KEY = 'observations'  # dm_control's name of the flat vector


contexts.install()  # pictures of `physics.render`, too, may come from any thread


class Environment(composer.Environment):
    """`composer.Environment` with all substeps of a step in one call.

    Differences from composer: substeps run in C, and the model is compiled once (hooks of substeps,
    and `initialize_episode_mjcf`, are refused; so is a task that overrides `get_reward` and the like),
    observation blocks bypass the observation updater, for which a control step is one update (delays of
    users' observables count these), divergence ends the episode instead of raising an exception, and
    the full state can be saved and restored.

    As usual in dm_env, `TimeStep.discount` of the last step is 0 if the task failed and 1 if the
    step or time limit ended the episode.

    Only one thread may use an environment at a time; a second one is rejected.

    Attributes:
      core: the simulation.
      blocks: slice of each observation block in the flat vector.
      action_map: the map from actions to physical units (`trl_suite.actuation.action_map.ActionMap`).
      step_limit: steps after which an episode is truncated, or None: control steps of 1/30 s, in
        planning environments footsteps, in gaits cycles.
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
          random: seed, or a random state; a seed from the operating system if None.
          flat_observation: return all blocks as one vector, under the key 'observations'.
          visualize_reward: whether images show the reward, as in `dm_control.suite`: moving bodies
            turn green as it rises to 1.

        Raises:
          ValueError: a limit that is not positive, an invalid seed, a `flat_observation` or
            `visualize_reward` that is no bool, or hooks that would not be called.
          TypeError: a seed that is not an integer.
        """
        self.step_limit, time_limit = arguments.limits(step_limit, time_limit)
        if isinstance(random, (int, float, str, bytes, np.random.Generator)):
            arguments.check_seed('random', random)
        if isinstance(random, np.random.RandomState):
            kind = random.get_state(legacy=False)['bit_generator']
            if kind != 'MT19937':
                raise ValueError(f'random is a RandomState of {kind}; expected one of MT19937')
        checked('flat_observation', flat_observation, bool)
        checked('visualize_reward', visualize_reward, bool)
        self._flat_observation = flat_observation
        if random is None:
            random = int(np.random.SeedSequence().generate_state(1)[0])
        hooks.check(task)
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
        # Whether there are hooks to call; checking them takes time.
        called = hooks.called(task)
        self._hooked = 'before_step' in called or 'after_step' in called
        self._begun_by_hooks = 'initialize_episode' in called
        self._extra_hooks = False

    def add_extra_hook(self, hook_name: str, hook_callable: Callable[..., None]) -> None:
        self.core.usable()
        hooks.check_extra(hook_name)
        super().add_extra_hook(hook_name, hook_callable)
        self._hooked = self._begun_by_hooks = self._extra_hooks = True

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
            self._show_reward(0.0)
            # Composer's hooks: that of the task, `Task.initialize_episode`, and those of entities.
            self._hooks.initialize_episode(self._physics_proxy, self._random_state)
            if self._begun_by_hooks:
                core.task.after_hooks()
            core.restart(0)
            if self._has_own_observables:
                self._observation_updater.reset(self._physics_proxy, self._random_state)
            return dm_env.restart(self._observe())

    def step(self, action: np.ndarray) -> dm_env.TimeStep:
        """Takes one action; begins a new episode instead if the last time step ended one.

        Args:
          action: clipped to [-1, 1], shape of `action_spec()`; ignored if an episode begins.

        Raises:
          ValueError: an action of the wrong shape, or with NaN or infinity.
          RuntimeError: after `close`, or while another thread uses the environment.
        """
        with self.core as core:
            if core.ended[0]:
                return self.reset()
            action, task, physics = self.action_map.checked(action), core.task, self._physics_proxy
            if self._has_own_observables:
                self._observation_updater.prepare_for_next_control_step()
            if self._hooked:  # by way of `Task.before_step` and `after_step`: the same as `advance`
                self._hooks.before_step(physics, action, self._random_state)
                task.simulate(core.world.all_ids)
                self._hooks.after_step(physics, self._random_state)
            else:
                task.advance(action[None], core.world.all_ids)
            core.count(0, self.step_limit, self._time_limit)
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
    def at_limit(self) -> bool:
        """Whether the last step reached the step or time limit, also if it failed."""
        return bool(self.core.usable().at_limit(0, self.step_limit, self._time_limit))

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
            found |= self._observation_updater.get_observation()
        if self._flat_observation:
            parts = [row, *(np.ravel(value) for value in found.values())]
            return {FLAT_OBSERVATION_KEY: np.concatenate(parts)}
        return found

    def reward_spec(self) -> specs.Array:
        """Returns the specification of rewards; raises RuntimeError after `close`."""
        self.core.usable()
        return super().reward_spec()

    def discount_spec(self) -> specs.BoundedArray:
        """Returns the specification of discounts; raises RuntimeError after `close`."""
        self.core.usable()
        return super().discount_spec()

    def action_spec(self) -> specs.BoundedArray:
        return self.task.action_spec(self._physics_proxy)

    def observation_spec(self) -> dict[str, specs.Array]:
        found = {
            name: specs.Array(np.shape(value), np.result_type(value), name)
            for name, value in self.observation().items()
        }
        if self._has_own_observables and not self._flat_observation:
            found |= self._observation_updater.observation_spec()
        return found

    def get_state(self) -> dict[str, Any]:
        """Returns the complete state: physics, task, terrain and random streams.

        The dict holds arrays and plain values; it can be pickled, and restored by any environment
        that was built in the same way.
        """
        return self.core.get_state()

    def set_state(self, state: dict[str, Any]) -> None:
        """Restores a state from `get_state`; the same actions then give bit-identical results.

        Buffers of users' observables are not part of it, and begin as at a reset. Errors are those of
        `VectorEnvironment.set_state`.
        """
        with self.core as core:
            core.set_state(state)
            if self._has_own_observables:
                stream = self._random_state.get_state()
                self._observation_updater.reset(self._physics_proxy, self._random_state)
                self._random_state.set_state(stream)

    def __reduce__(self) -> tuple[Any, ...]:
        if self.recipe is None:
            raise TypeError(
                'this environment was not made by trl_suite.suite, so it cannot be rebuilt from a '
                'pickle; pickle env.get_state() instead'
            )
        if self._extra_hooks:
            raise TypeError(
                'this environment has hooks of add_extra_hook, which a pickle would lack; pickle '
                'env.get_state() instead'
            )
        build, arguments = self.recipe
        return build, arguments, {'step_limit': self.step_limit, 'state': self.get_state()}

    def __setstate__(self, saved: dict[str, Any]) -> None:
        self.step_limit = saved['step_limit']
        self.set_state(saved['state'])


def _colours(model: Any) -> tuple[np.ndarray, np.ndarray]:
    """Returns the geoms of moving bodies, (g,), and their colours, (g, 3)."""
    geoms = np.flatnonzero(model.body_weldid[model.geom_bodyid] > 0)
    colours, materials = model.geom_rgba[geoms, :3].copy(), model.geom_matid[geoms]
    own = materials >= 0
    colours[own] = model.mat_rgba[materials[own], :3]
    return geoms, colours
