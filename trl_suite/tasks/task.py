"""The base of all tasks: rules over a batch axis, worn as a composer task."""

from __future__ import annotations

import abc
import collections
import numbers
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from dm_control import composer, mjcf
from dm_control.composer.observation import observable
from dm_env import specs

from trl_suite.action_map import ActionMap
from trl_suite.world import PhysicsWorld, World

_ONLY_ROW = np.zeros(1, int)
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
    position: Sequence[float]
    size: Sequence[float]
    colour: tuple[float, float, float, float]
    yaw: float = 0.0


class Task(composer.Task):
    """Rules of an environment, written once over a leading axis of n simulations.

    A subclass owns arrays of n rows. It is driven by four methods: `bind` (a compiled world),
    `begin_episodes` (some rows), `act` (all rows, before the physics) and `finish_step` (all rows,
    after it). The composer hooks below are the case n = 1, so that a plain `composer.Environment`
    runs the task as well; but not one whose step lasts a variable time, which overrides `simulate`.

    Attributes:
      world: the simulations, after compiling.
      action_map: what an action means.
      observation: all observation blocks side by side, shape (n, observation size).
      blocks: name -> slice of `observation`, in order, terrain first.
      reward: shape (n,).
      failed: rows whose episode has ended with discount 0, shape (n,) bool.
      diverged: the failed rows whose physics broke down, shape (n,) bool.
    """

    world: World
    action_map: ActionMap
    observation: np.ndarray
    blocks: dict[str, slice]
    reward: np.ndarray
    failed: np.ndarray
    diverged: np.ndarray
    fields: tuple[str, ...] = ()  # of MjData, read beside those that every world binds
    _begun = False  # whether no step was taken since composer's reset

    # What a family implements.

    @abc.abstractmethod
    def bind(self, world: World) -> None:
        """Resolves ids in a compiled world and allocates arrays of `world.n` rows."""

    @abc.abstractmethod
    def begin_episodes(
        self, rows: np.ndarray, random_states: Sequence[np.random.RandomState]
    ) -> None:
        """Draws terrain and start of some rows, each from its stream; `observe` is yet to follow."""

    @abc.abstractmethod
    def observe(self) -> None:
        """Writes the observations of all rows from the world's state."""

    @abc.abstractmethod
    def act(self, action: np.ndarray) -> None:
        """Takes actions, shape (n, k), in [-1, 1]."""

    @abc.abstractmethod
    def finish_step(self, stepped: np.ndarray | None = None) -> None:
        """Updates reward, failed and observation after the physics has advanced.

        Args:
          stepped: which rows took a step, (n,) bool; the others have just begun an episode. None if
            all did.
        """

    @abc.abstractmethod
    def infos(self) -> dict[str, Any]:
        """What happened beyond observation and reward: arrays of n rows, or dicts of such."""

    @abc.abstractmethod
    def get_state(self, row: int) -> dict[str, Any]:
        """Everything about one row that the world's state does not hold."""

    @abc.abstractmethod
    def set_state(self, row: int, state: dict[str, Any]) -> None:
        """Restores what `get_state` returned; the world's state is set afterwards."""

    @property
    def signature(self) -> str:
        """Which task this is, for people and to tell whose a saved state is."""
        blocks = ', '.join(f'{name} {part.stop - part.start}' for name, part in self.blocks.items())
        steps = f'{self._substeps} x {self.physics_timestep:.6g} s'
        return f'{type(self).__name__} by {self.action_map.quantity} ({blocks}; {steps})'

    def simulate(self, rows: np.ndarray | None = None) -> None:
        """Advances the physics of some rows (sorted numbers), or of all, by one control step."""
        self.world.step(self._substeps, rows)

    # Composer's interface: one simulation.

    def after_compile(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        self.bind(PhysicsWorld(physics, self.fields))

    def set_timesteps(self, control_timestep: float, physics_timestep: float) -> None:
        super().set_timesteps(control_timestep, physics_timestep)
        self._substeps = self.physics_steps_per_control_step  # composer's is slow to ask

    def initialize_episode(
        self, physics: mjcf.Physics, random_state: np.random.RandomState
    ) -> None:
        self.begin_episodes(_ONLY_ROW, [random_state])
        self.observe()
        self._begun = True

    def before_step(
        self, physics: mjcf.Physics, action: np.ndarray, random_state: np.random.RandomState
    ) -> None:
        if self._begun:
            # A plain composer.Environment leaves a reset with the actuators' velocities at zero.
            self.world.forward(_ONLY_ROW)
            self._begun = False
        self.act(np.asarray(action, dtype=float)[None])

    def after_step(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        self.finish_step()

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


def check_simulated(lasted: np.ndarray) -> None:
    """Checks that rows have run the physics of a step of a task that does so by itself.

    Args:
      lasted: how long each has, 0 where it has not.

    Raises:
      RuntimeError: some have not.
    """
    if not lasted.all():
        raise RuntimeError(
            'a task whose steps are long runs their physics by itself: step it by '
            'trl_suite.environment.Environment, not by a plain composer.Environment'
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
    if pairs.ndim != 2 or pairs.shape[1] != 2 or not (
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
