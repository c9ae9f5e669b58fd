"""The base of all tasks: rules for n simulations at once, as a composer task."""

from __future__ import annotations

import abc
import collections
import numbers
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from dm_control import composer, mjcf
from dm_control.composer.observation import observable
from dm_env import specs

from trl_suite.actuation.action_map import ActionMap
from trl_suite.engine import PhysicsWorld, World
from trl_suite.util.compiled import compiled

# Meanings of options that several tasks have.
START_PHASE = 'phase of every start, in [0, 1), or pairs to draw it between; by default any'
TERRAIN_LEVEL = (
    "which of the terrain's parameter sets to draw from: 0 is the first, 0.5 half-way to the second"
)
SPAWNS = ('intended', 'upstream')
MAX_JOINT_SPEED = 200.0  # rad/s; beyond it a simulation counts as diverged


class Marker(NamedTuple):
    """Something that a task points out in pictures; the physics knows nothing of it.

    Attributes:
      shape: 'box', 'cylinder', 'sphere', 'ellipsoid', or 'arrow', which points along its yaw.
      position: of its middle, of an arrow its tail, m.
      size: as MuJoCo has it, m: half sides, radii, or of a cylinder radius and half height; of an
        arrow radius, radius and length.
      colour: red, green, blue, opacity.
      yaw: rad.
    """

    shape: str
    position: npt.ArrayLike
    size: Sequence[float]
    colour: tuple[float, float, float, float]
    yaw: float = 0.0


class Outcome(NamedTuple):
    """What a step of each simulation came to; simulations of simulations.

    Attributes:
      observation: all observation blocks side by side, (n, observation size).
      reward: (n,).
      reward_terms: its parts, weighted, (n, terms); 0 after a reset.
      failed: whether the episode has ended with discount 0, (n,) bool.
      diverged: whether that was because the physics became unstable, (n,) bool.
      fell: whether it failed without that: a fall, or a foot that missed its place, (n,) bool.
    """

    observation: np.ndarray
    reward: np.ndarray
    reward_terms: np.ndarray
    failed: np.ndarray
    diverged: np.ndarray
    fell: np.ndarray


def outcome(n: int, size: int, terms: int = 0) -> Outcome:
    """Makes room for n simulations, an observation of some size, and some reward terms."""
    return Outcome(
        np.zeros((n, size)), np.zeros(n), np.zeros((n, terms)), *np.zeros((3, n), bool)
    )  # fmt: skip


@compiled
def begin(i: int, outcome: Outcome) -> None:
    """Clears what the last episode of a simulation came to, but for its observation."""
    outcome.reward[i] = 0.0
    outcome.failed[i] = outcome.diverged[i] = outcome.fell[i] = False
    for k in range(outcome.reward_terms.shape[1]):
        outcome.reward_terms[i, k] = 0.0


@compiled
def conclude(i: int, failed: bool, outcome: Outcome) -> None:
    """Sums the reward terms up, or drops them where the episode has failed."""
    outcome.failed[i] = failed
    outcome.fell[i] = failed and not outcome.diverged[i]
    reward = 0.0
    for k in range(outcome.reward_terms.shape[1]):
        if failed:
            outcome.reward_terms[i, k] = 0.0
        reward += outcome.reward_terms[i, k]
    outcome.reward[i] = reward


@compiled
def too_fast(i: int, dofs: np.ndarray, limit: float, qvel: np.ndarray) -> bool:
    """Whether any of some velocities is beyond a limit, or no number."""
    for k in dofs:
        if not abs(qvel[i, k]) <= limit:
            return True
    return False


class Task(composer.Task):
    """Rules of an environment for n simulations at once.

    The rules of a family are compiled functions of one simulation `i` (see
    `trl_suite.util.compiled`); its task holds the arrays that they work on and calls loops over
    simulations. A task of the user's may do the same with plain NumPy.

    An environment calls `bind` once, `reset` for simulations that begin an episode, and `step` for
    those that take a step. A step is

    1. `apply_action`: writes controls from actions, which it clips, and lays ground ahead;
    2. `simulate`: advances the physics;
    3. `finish_step`: clock, divergence, measurement, reward, failure, observation, in this order.

    Threads call `reset` and `step` for parts of the simulations: each must touch the simulations that
    it is given, and no others. The composer hooks below are the case n = 1, so that a plain `composer.Environment` runs
    the task as well; but not one whose step lasts a variable time, which overrides `simulate`.

    Attributes:
      world: the simulations, after compiling.
      action_map: what an action means.
      blocks: name -> slice of the observation, in order, terrain first.
      outcome: observation, reward and failure of each simulation.
      saved: tuples of arrays with n simulations that make up the state of the task, `outcome` among them.
      info_arrays: what `info` tells, arrays of n simulations by name, or dicts of such; kept up to date.
    """

    world: World
    action_map: ActionMap
    blocks: dict[str, slice]
    outcome: Outcome
    saved: tuple[NamedTuple, ...]
    info_arrays: dict[str, Any]
    CONFIG: Any = None  # its options: a subclass of `Config`, or {spatial: one} where they differ
    fields: tuple[str, ...] = ()  # of MjData, read beside those that every world binds
    in_parts = True  # whether threads may each be given a part of the simulations
    _begun = False  # whether no step was taken since composer's reset

    # What a family implements.

    @abc.abstractmethod
    def bind(self, world: World) -> None:
        """Resolves ids in a compiled world and allocates arrays of `world.n` simulations."""

    @abc.abstractmethod
    def reset(self, env_ids: np.ndarray, random_states: Sequence[np.random.RandomState]) -> None:
        """Draws terrain and start of some simulations, each from its stream, and observes them."""

    @abc.abstractmethod
    def apply_action(self, action: np.ndarray, env_ids: np.ndarray) -> None:
        """Takes the actions of some simulations, among those of all, shape (n, k), in [-1, 1]."""

    @abc.abstractmethod
    def finish_step(self, env_ids: np.ndarray) -> None:
        """Updates the outcome of some simulations after the physics has advanced."""

    @abc.abstractmethod
    def observe(self, env_ids: np.ndarray | None = None) -> None:
        """Writes the observations of some simulations, or of all, from the state of the world."""

    # The step and the state, for all families.

    def step(self, action: np.ndarray, env_ids: np.ndarray) -> None:
        """Advances some simulations by one step.

        Args:
          action: of all simulations, (n, k), in [-1, 1]; those of the others do not count.
          env_ids: sorted numbers of the simulations that take a step.
        """
        self.apply_action(action, env_ids)
        self.simulate(env_ids)
        self.finish_step(env_ids)

    def simulate(self, env_ids: np.ndarray) -> None:
        """Advances the physics of some simulations by one control step."""
        self.world.step(self._substeps, env_ids)

    def info(self) -> dict[str, Any]:
        """Returns what happened beyond observation and reward: arrays of n simulations, or dicts of such."""
        return _each(self.info_arrays, np.copy)

    def info_of(self, env_id: int) -> dict[str, Any]:
        """Returns the same of one simulation, as numbers."""
        return _each(self.info_arrays, lambda array: array.item(env_id))

    def get_state(self, env_id: int) -> dict[str, Any]:
        """Returns everything about one simulation that the world's state does not hold."""
        arrays = [[array[env_id].copy() for array in group] for group in self.saved]
        return {'arena': self.arena.state(env_id), 'arrays': arrays}  # type: ignore[attr-defined]

    def set_state(self, env_id: int, state: dict[str, Any]) -> None:
        """Restores what `get_state` returned; the world's state is set afterwards."""
        self.arena.restore(env_id, state['arena'])  # type: ignore[attr-defined]
        for group, values in zip(self.saved, state['arrays'], strict=True):
            for array, value in zip(group, values, strict=True):
                array[env_id] = value

    @property
    def observation(self) -> np.ndarray:
        """All observation blocks side by side, (n, observation size)."""
        return self.outcome.observation

    @property
    def reward(self) -> np.ndarray:
        """Reward of the last step, (n,)."""
        return self.outcome.reward

    @property
    def reward_terms(self) -> np.ndarray:
        """Its parts, weighted, (n, terms)."""
        return self.outcome.reward_terms

    @property
    def failed(self) -> np.ndarray:
        """Whether the episode has ended with discount 0, (n,) bool."""
        return self.outcome.failed

    @property
    def diverged(self) -> np.ndarray:
        """Whether it has because the physics became unstable, (n,) bool."""
        return self.outcome.diverged

    @property
    def signature(self) -> str:
        """Which task this is, for people and to recognise the owner of a saved state."""
        blocks = ', '.join(f'{name} {part.stop - part.start}' for name, part in self.blocks.items())
        steps = f'{self._substeps} x {self.physics_timestep:.6g} s'
        return f'{type(self).__name__} by {self.action_map.quantity} ({blocks}; {steps})'

    # Composer's interface: one simulation.

    def after_compile(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        self.bind(PhysicsWorld(physics, self.fields))

    def set_timesteps(self, control_timestep: float, physics_timestep: float) -> None:
        super().set_timesteps(control_timestep, physics_timestep)
        self._substeps = self.physics_steps_per_control_step  # composer's is slow to ask

    def initialize_episode(
        self, physics: mjcf.Physics, random_state: np.random.RandomState
    ) -> None:
        self.reset(self.world.all_ids, [random_state])
        self._begun = True

    def before_step(
        self, physics: mjcf.Physics, action: np.ndarray, random_state: np.random.RandomState
    ) -> None:
        if self._begun:
            # A plain composer.Environment leaves a reset with the actuators' velocities at zero.
            self.world.forward(self.world.all_ids)
            self._begun = False
        self.apply_action(np.asarray(action, dtype=float)[None], self.world.all_ids)

    def after_step(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        self.finish_step(self.world.all_ids)

    def get_reward(self, physics: mjcf.Physics) -> float:
        return float(self.reward[0])

    def get_discount(self, physics: mjcf.Physics) -> float:
        return 0.0 if self.failed[0] else 1.0

    def should_terminate_episode(self, physics: mjcf.Physics) -> bool:
        return bool(self.failed[0])

    def action_spec(self, physics: mjcf.Physics) -> specs.BoundedArray:
        return specs.BoundedArray(
            (len(self.action_map),), float, -1.0, 1.0, name='\t'.join(self.action_map.names)
        )

    @property
    def task_observables(self) -> dict[str, observable.Observable]:
        def block(part: slice) -> observable.Generic:
            item = observable.Generic(lambda physics: self.observation[0, part].copy())
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


def check_simulated(lasted: np.ndarray) -> None:
    """Checks that simulations have run the physics of a step of a task that does so by itself.

    Args:
      lasted: how long each has, 0 where it has not.

    Raises:
      RuntimeError: some have not.
    """
    if not lasted.all():
        raise RuntimeError(
            'a task whose steps are long runs their physics by itself: step it by '
            'trl_suite.environments.environment.Environment, not by a plain composer.Environment'
        )


def drawn_way(random: np.random.Generator, low: float, high: float) -> np.ndarray:
    """Draws a way on the ground in any direction, of any length from low to high, (2,) m."""
    angle = random.uniform(-np.pi, np.pi)
    return random.uniform(low, high) * np.array([np.cos(angle), np.sin(angle)])


def start_phases(
    option: float | Sequence[Sequence[float]] | None,
) -> Callable[[float], float]:
    """Returns what turns a uniform draw from [0, 1) into the phase of a start.

    Args:
      option: None: the phase is the draw. A number in [0, 1): it is always this. Pairs of numbers,
        ascending in [0, 1]: it lies between the numbers of a pair, as likely anywhere there.

    Raises:
      ValueError: anything else.
    """
    if option is None:
        return lambda drawn: drawn
    if isinstance(option, numbers.Real):
        phase = float(option)
        if not 0 <= phase < 1:
            raise ValueError(f'start_phase is {option}; expected a number in [0, 1), or pairs')
        return lambda drawn: phase
    try:
        pairs = np.asarray(option, float)
    except (TypeError, ValueError):
        pairs = np.empty(0)
    if pairs.ndim != 2 or pairs.shape[1] != 2 or not len(pairs) or not (
        (np.diff(pairs, axis=1) > 0).all() and (np.diff(pairs.ravel()) >= 0).all()
        and pairs[0, 0] >= 0 and pairs[-1, 1] <= 1
    ):  # fmt: skip
        raise ValueError(
            f'start_phase is {option}; expected a number in [0, 1), or ascending pairs '
            'of numbers in [0, 1]'
        )
    ends = np.cumsum(np.diff(pairs, axis=1))

    def phase_of(drawn: float) -> float:
        way = drawn * ends[-1]
        i = min(int(np.searchsorted(ends, way, side='right')), len(ends) - 1)
        return float(pairs[i, 1] - (ends[i] - way))

    return phase_of


def check_position_options(model: str, action_offset: str, action_scale: float | None) -> None:
    """Checks that options of position control are not given to another actuation model.

    Raises:
      ValueError: they are.
    """
    if model != 'position' and (action_offset != 'clip' or action_scale is not None):
        raise ValueError(
            f'action_offset and action_scale shape position control, not {model} control'
        )


def drawn_seed(random_state: np.random.RandomState) -> np.random.SeedSequence:
    """Draws the seed of a stream of its own, for what goes on to draw during an episode."""
    return np.random.SeedSequence(random_state.randint(0, 2**32, size=4, dtype=np.uint32))


def consecutive(sizes: dict[str, int]) -> dict[str, slice]:
    """Lays blocks of the given sizes side by side; empty ones are left out."""
    ends = np.cumsum(list(sizes.values()))
    return {
        name: slice(int(end) - size, int(end))
        for (name, size), end in zip(sizes.items(), ends, strict=True)
        if size
    }
