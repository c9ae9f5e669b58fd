"""The base class of all tasks, which are composer tasks for n simulations at once."""

from __future__ import annotations

import abc
import collections
import functools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt
from dm_control import composer, mjcf
from dm_control.composer.observation import observable
from dm_env import specs

from trl_suite.actuation.action_map import ActionMap
from trl_suite.bodies.blocks import Block, layout
from trl_suite.engine import PhysicsWorld, World
from trl_suite.policies.mirror import Mirror
from trl_suite.tasks.component import Component, position, seed_of
from trl_suite.tasks.rewards import Outcome, Term, outcome

if TYPE_CHECKING:
    from trl_suite.tasks.variation.levels import Levels


class Marker(NamedTuple):
    """A shape that a task adds to rendered images. It has no effect on the physics.

    Attributes:
      shape: 'box', 'cylinder', 'sphere', 'ellipsoid', or 'arrow', which points along its yaw.
      position: position of the centre, or of an arrow's tail, m.
      size: size as in MuJoCo, m: half sizes of a box, radii of a sphere or an ellipsoid, radius
        and half height of a cylinder; for an arrow: radius, radius, length.
      colour: red, green, blue and opacity, in [0, 1].
      yaw: rotation about the vertical axis, rad.
    """

    shape: str
    position: npt.ArrayLike
    size: Sequence[float]
    colour: tuple[float, float, float, float]
    yaw: float = 0.0


def _of_outcome(name: str, meaning: str) -> Any:
    """Returns a property of a task: an array of its outcome."""
    return property(lambda task: getattr(task.outcome, name), doc=meaning)


class Task(composer.Task):
    """Observation, reward, termination and reset of an environment, for n simulations at once.

    `trl-suite info` prints the observation blocks and the reward terms of an environment's task.

    The rules of the suite's tasks are compiled functions of one simulation `i` (see
    `trl_suite.util.compiled`); the task holds the arrays that they use and calls loops over
    simulations. A custom task may do the same with plain NumPy.

    An environment calls `bind` once, `reset` for simulations in which an episode starts, and `step`
    for the others, by way of `attach`, `begin` and `advance`, which add the components. A step
    consists of

    1. `apply_action`: clips the actions, sets the controls, and moves ground windows if necessary;
       or, where a controller drives the joints, sets the plan or the gait that it follows;
    2. `simulate`: advances the physics;
    3. `finish_step`: checks for divergence, measures the body, updates the clock, and computes
       reward, failure and observation, in this order; where a controller drives the joints,
       `simulate` does the first of these in each of its control steps.

    Several threads call `reset` and `step`, each for some of the simulations. A call may change
    only the simulations that it is given. The composer hooks below call the same methods for one
    simulation, so that a plain `composer.Environment` can run the task, unless it overrides
    `simulate`, as tasks with a controller do.

    Attributes:
      world: the simulations; set by `bind`.
      arena: the arena with the terrain.
      action_map: the map from actions to physical units.
      mirror: reflection of observations and actions, for policies; None if it is not available.
      observed: the blocks of the observation, in order, terrain first; some may be empty.
      blocks: name -> slice of the observation, in order; a task may set it instead of `observed`.
      terms: the terms of the reward, in order.
      outcome: observation, reward and failure of each simulation.
      components: what changes the task from outside, in this order.
      seen: the outcome after all components, which an environment returns.
      saved: the state of the task: tuples of arrays (n, ...), of which `outcome` is one.
      info_arrays: the arrays (n, ...) that `info` returns, by name, or dicts of such arrays;
        updated in place.
    """

    world: World
    arena: Any  # PlanarArena or SpatialArena
    action_map: ActionMap
    mirror: Mirror | None = None
    terms: tuple[Term, ...] = ()
    outcome: Outcome
    components: tuple[Component, ...] = ()
    seen: Outcome
    saved: tuple[NamedTuple, ...]
    info_arrays: dict[str, Any]
    CONFIG: Any = None  # options: a subclass of `Config`, or a dict of them by `spec.spatial`
    fields: tuple[str, ...] = ()  # further fields of MjData to bind, see `World`
    steps_vary = False  # whether the duration of steps varies, so that it is not 1/30 s
    in_parts = True  # whether several threads may call the task, each for some simulations
    step_in_parts = True  # the same, without components
    levels: Levels | None = None  # the component that chooses terrain, if there is one
    _just_reset = False  # whether composer has reset the task, and no step has followed yet
    _begun: tuple[np.ndarray, np.ndarray]  # qpos and qvel after composer has reset the task

    # Methods that a subclass implements.

    @abc.abstractmethod
    def bind(self, world: World) -> None:
        """Resolves ids in a compiled world and allocates arrays for `world.n` simulations."""

    @abc.abstractmethod
    def reset(self, env_ids: np.ndarray, random_states: Sequence[np.random.RandomState]) -> None:
        """Starts episodes: draws terrain and initial states, and computes the observations.

        Args:
          env_ids: ids of the m simulations in which an episode starts.
          random_states: random states of these simulations, m of them.
        """

    @abc.abstractmethod
    def apply_action(self, action: np.ndarray, env_ids: np.ndarray) -> None:
        """Applies the actions of some simulations.

        Args:
          action: actions of all simulations, (n, k), finite, not yet clipped to [-1, 1].
          env_ids: ids of the simulations whose actions are applied.
        """

    @abc.abstractmethod
    def finish_step(self, env_ids: np.ndarray) -> None:
        """Writes the outcome of some simulations, after the physics was advanced."""

    @abc.abstractmethod
    def observe(self, env_ids: np.ndarray | None = None) -> None:
        """Writes the observations of some simulations, or of all, from the state of the world."""

    # Observation, step and state, for all tasks.

    @functools.cached_property
    def observed(self) -> tuple[Block, ...]:
        return tuple(Block(name, part.stop - part.start) for name, part in self.blocks.items())

    @functools.cached_property
    def blocks(self) -> dict[str, slice]:
        return layout(vars(self).get('observed', ()))

    def _allocate(self, n: int, distance: np.ndarray) -> None:
        """Allocates the outcome of n simulations; `info` has it, and their distances (n,) in m."""
        size = sum(block.size for block in self.observed)
        self.outcome = outcome(n, size, len(self.terms))
        names = [term.name for term in self.terms]
        self.info_arrays = {
            'reward_terms': dict(zip(names, self.outcome.reward_terms.T, strict=True)),
            'fell': self.outcome.fell,
            'diverged': self.outcome.diverged,
            'distance': distance,
        }

    def add(self, component: Component) -> None:
        """Adds a component; it must not be part of another task.

        Raises:
          ValueError: the component does not fit the task.
        """
        component.added_to(self)
        self.components = *self.components, component

    def attach(self, world: World) -> None:
        """Binds the task and its components to a world."""
        # Those of the task without components: composer may compile, and so attach, a second time.
        own, self.step_in_parts = self.__dict__.setdefault('_own', (self.observed, self.in_parts))
        self.in_parts = self.step_in_parts
        self.observed, self.blocks = own, layout(own)
        for component in self.components:
            component.prepare(world)
        self.bind(world)
        self.seen = self.outcome
        for component in self.components:
            self.seen = component.bind(world, self.seen)
            self.in_parts &= component.in_parts
            for name, entry in component.info_arrays.items():
                terms = self.info_arrays.setdefault(name, entry)
                if isinstance(entry, dict):
                    terms |= entry
        added = [block for component in self.components for block in component.blocks]
        if added:
            self.observed = *own, *added
            self.blocks = layout(self.observed)

    def begin(self, env_ids: np.ndarray, random_states: Sequence[np.random.RandomState]) -> None:
        """Starts episodes, with components; see `reset`."""
        if not self.components:
            self.reset(env_ids, random_states)
            return
        before = [position(random_state) for random_state in random_states]
        for env_id, random_state in zip(env_ids.tolist(), random_states, strict=True):
            seed = seed_of(random_state)
            for component in self.components:
                component.begin(env_id, seed)
        self.reset(env_ids, random_states)
        for random_state, old in zip(random_states, before, strict=True):
            if position(random_state) == old:
                random_state.random_sample()  # the task drew nothing: components vary all the same
        for component in self.components:
            component.finish(env_ids, True)

    def advance(self, action: np.ndarray, env_ids: np.ndarray) -> None:
        """Advances some simulations by one step, with components; see `step`."""
        if not self.components:
            self.step(action, env_ids)
            return
        for component in self.components:
            component.before_physics(action, env_ids)
        if self.in_parts or not self.step_in_parts:
            self.step(action, env_ids)
        else:  # the components are called for all simulations together
            self.world.share(lambda part: self.step(action, part), env_ids)
        for component in self.components:
            component.finish(env_ids, False)

    def step(self, action: np.ndarray, env_ids: np.ndarray) -> None:
        """Advances some simulations by one step.

        Args:
          action: actions of all simulations, (n, k), finite; those of the others are ignored.
          env_ids: sorted indices of the simulations that take a step.
        """
        self.apply_action(action, env_ids)
        self.simulate(env_ids)
        self.finish_step(env_ids)

    def simulate(self, env_ids: np.ndarray) -> None:
        """Advances the physics of some simulations by one control step."""
        self.world.step(self._substeps, env_ids)

    @property
    def steps_per_call(self) -> int:
        """The least number of physics steps between two controls; see `simulate`."""
        return self._substeps

    def terrain_seed(
        self, env_id: int, random_state: np.random.RandomState
    ) -> np.random.SeedSequence:
        """Draws the seed of an episode's terrain; with levels, it is the level, and the draw has no effect."""
        drawn = drawn_seed(random_state)
        if self.levels is None:
            return drawn
        return np.random.SeedSequence(int(self.levels.state.level[env_id]))

    def choose_level(self, env_ids: Any, level: int | Sequence[int]) -> None:
        """Sets the level of the next episode of some simulations.

        Raises:
          ValueError: the task has no levels, or not this one.
        """
        if self.levels is None:
            raise ValueError(
                f"level is {level}; expected an environment with the option 'levels', such as (0, 100)"
            )
        self.levels.choose(env_ids, level)

    def info(self) -> dict[str, Any]:
        """Returns further results by name: arrays of n simulations, or dicts of such arrays."""
        return _each(self.info_arrays, np.copy)

    def info_of(self, env_id: int) -> dict[str, Any]:
        """Returns `info` for one simulation, as numbers, or arrays if there are several."""
        return _each(self.info_arrays, lambda array: _row(array, env_id))

    def get_state(self, env_id: int) -> dict[str, Any]:
        """Returns the state of one simulation, except that of the world and of components."""
        return {'arena': self.arena.state(env_id), 'arrays': _state(self.saved, env_id)}

    def set_state(self, env_id: int, state: dict[str, Any]) -> None:
        """Restores a state from `get_state`; the caller restores the world's state afterwards."""
        self.arena.restore(env_id, state['arena'])
        _restore(self.saved, env_id, state['arrays'])

    def get_whole_state(self, env_id: int) -> dict[str, Any]:
        """Returns the state of one simulation, with components, except that of the world."""
        parts = [_state(component.saved, env_id) for component in self.components]
        return {'task': self.get_state(env_id), 'components': parts}

    def set_whole_state(self, env_id: int, state: dict[str, Any]) -> None:
        """Restores a state from `get_whole_state`."""
        for component, arrays in zip(self.components, state['components'], strict=True):
            _restore(component.saved, env_id, arrays)
            component.restored(env_id)
        self.set_state(env_id, state['task'])

    observation = _of_outcome('observation', 'Exact observation, without components, (n, size).')
    reward = _of_outcome('reward', 'Reward of the last step, (n,).')
    reward_terms = _of_outcome('reward_terms', 'Weighted terms of the reward, (n, terms).')
    failed = _of_outcome('failed', 'Whether the episode has ended with discount 0, (n,) bool.')
    diverged = _of_outcome('diverged', 'Whether it has because the physics diverged, (n,) bool.')

    @property
    def made_of(self) -> dict[str, tuple[str, Any]]:
        """What the task is made of, by name: labels, and the contents that sign saved states."""
        blocks = ', '.join(f'{name} {part.stop - part.start}' for name, part in self.blocks.items())
        steps = f'{self._substeps} x {self.physics_timestep:.6g} s'
        label = f'{type(self).__name__} by {self.action_map.quantity} ({blocks}; {steps})'
        actions = self.action_map
        # In single precision: computed numbers depend on the type of processor.
        numbers = np.array([actions.action_offset, actions.action_scale], np.float32)
        arrays = [[(array.dtype.str, *array.shape[1:]) for array in part] for part in self.saved]
        fields = [getattr(part, '_fields', ()) for part in self.saved]
        contents = label, type(self), actions.names, numbers, arrays, fields
        found: dict[str, tuple[str, Any]] = {'task': (label, contents)}
        config = getattr(self, 'config', None)
        found['options'] = type(config).__name__, config
        for name, of, part in (
            ('character', 'character', 'spec'), ('terrain', 'arena', 'terrain'),
            ('motion', 'motion', None), ('motion', 'clip', None),
        ):  # fmt: skip
            value = getattr(self, of, None)
            value = value if part is None else getattr(value, part, None)
            if value is not None:
                found[name] = getattr(value, 'name', ''), getattr(value, 'contents', value)
        return found

    def markers(self, env_id: int) -> list[Marker]:
        """Returns markers for rendered images of a simulation."""
        return []

    # Composer's interface: one simulation.

    def after_compile(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        self.attach(PhysicsWorld(physics, self.fields))

    def set_timesteps(self, control_timestep: float, physics_timestep: float) -> None:
        """Sets the time steps, s, before the model is compiled.

        Raises:
          RuntimeError: the model is compiled already.
        """
        if hasattr(self, 'world'):
            raise RuntimeError(
                'the model is compiled; set time steps before the environment is made, with the option '
                'substeps of the task'
            )
        super().set_timesteps(control_timestep, physics_timestep)
        self._substeps = self.physics_steps_per_control_step  # composer's property is slow

    def initialize_episode(
        self, physics: mjcf.Physics, random_state: np.random.RandomState
    ) -> None:
        self.begin(self.world.all_ids, [random_state])
        self._just_reset = True
        self._begun = self.world.qpos.copy(), self.world.qvel.copy()

    def after_hooks(self) -> None:
        """Measures again if composer's hooks have changed the pose or the rates since `initialize_episode`."""
        world, ids = self.world, self.world.all_ids
        if all(map(np.array_equal, self._begun, (world.qpos, world.qvel))):
            return
        world.forward(ids)
        if 'body' in vars(self):
            self.body.recentre(ids)
        self.observe(ids)
        self.outcome.reward_terms[ids] = 0.0  # `observe` may have written those of the start
        for component in self.components:
            component.finish(ids, True)

    def before_step(
        self, physics: mjcf.Physics, action: np.ndarray, random_state: np.random.RandomState
    ) -> None:
        if self._just_reset:
            # A plain composer.Environment leaves actuator velocities of zero after a reset.
            self.world.forward(self.world.all_ids)
            self._just_reset = False
        self._stepped = int(self.world.engine.steps[0])
        given = self.action_map.checked(action)[None]
        for component in self.components:
            component.before_physics(given, self.world.all_ids)
        self.apply_action(given, self.world.all_ids)

    def after_step(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        if self.world.engine.steps[0] == self._stepped:  # composer has advanced the physics itself
            needs = [component.by_engine for component in self.components]
            if type(self).simulate is not Task.simulate:
                needs.append('the steps of this task')
            if any(needs):
                raise RuntimeError(
                    f'{next(filter(None, needs))} need trl_suite.environments.environment.Environment, '
                    'not a plain composer.Environment'
                )
        self.finish_step(self.world.all_ids)
        for component in self.components:
            component.finish(self.world.all_ids, False)

    def get_reward(self, physics: mjcf.Physics) -> float:
        return float(self.seen.reward[0])

    def get_discount(self, physics: mjcf.Physics) -> float:
        return 0.0 if self.seen.failed[0] else 1.0

    def should_terminate_episode(self, physics: mjcf.Physics) -> bool:
        return bool(self.seen.failed[0])

    def action_spec(self, physics: mjcf.Physics) -> specs.BoundedArray:
        # One bound per number, as in dm_control's own action specs.
        bound = np.ones(len(self.action_map))
        return specs.BoundedArray(
            bound.shape, float, -bound, bound, name='\t'.join(self.action_map.names)
        )

    @property
    def task_observables(self) -> dict[str, observable.Observable]:
        def block(part: slice) -> observable.Generic:
            item = observable.Generic(lambda physics: self.seen.observation[0, part].copy())
            item.enabled = True
            return item

        if not hasattr(self, '_task_observables'):
            self._task_observables = collections.OrderedDict(
                (name, block(part)) for name, part in self.blocks.items()
            )
        return self._task_observables


def _each(entries: dict[str, Any], function: Callable[[np.ndarray], Any]) -> dict[str, Any]:
    return {
        name: _each(entry, function) if isinstance(entry, dict) else function(entry)
        for name, entry in entries.items()
    }


def _row(array: np.ndarray, env_id: int) -> Any:
    return array.item(env_id) if array.ndim == 1 else array[env_id].copy()


def _state(saved: Sequence[NamedTuple], env_id: int) -> list[list[np.ndarray]]:
    return [[array[env_id].copy() for array in group] for group in saved]


def _restore(saved: Sequence[NamedTuple], env_id: int, state: list[list[np.ndarray]]) -> None:
    for group, values in zip(saved, state, strict=True):
        for array, value in zip(group, values, strict=True):
            array[env_id] = value


def random_displacement(random: np.random.Generator, low: float, high: float) -> np.ndarray:
    """Draws a horizontal displacement with uniform direction and length in [low, high), (2,) m."""
    angle = random.uniform(-np.pi, np.pi)
    return random.uniform(low, high) * np.array([np.cos(angle), np.sin(angle)])


def drawn_seed(random_state: np.random.RandomState) -> np.random.SeedSequence:
    """Draws the 128-bit seed of a separate random stream, e.g. for draws within an episode."""
    return np.random.SeedSequence(random_state.randint(0, 2**32, size=4, dtype=np.uint32))
