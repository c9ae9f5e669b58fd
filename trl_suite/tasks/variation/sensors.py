"""Sensors: noise, bias, drop-outs and delay of observation blocks.

An observed number is the true one of `delay` steps ago, plus a bias that is constant within an
episode, plus noise that is drawn in every step. What the controller computes itself is exact: the
phase, the reference, and the observation of a footstep controller.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from trl_suite.bodies.blocks import LEVELS, Block, layout
from trl_suite.bodies.state import WHOLE, allocated
from trl_suite.engine import World
from trl_suite.tasks.component import SENSORS, Component, spawned
from trl_suite.tasks.rewards import Outcome
from trl_suite.tasks.task import Task
from trl_suite.util import errors
from trl_suite.util.compiled import compiled, packed
from trl_suite.util.options import Config, Range, checked, option
from trl_suite.util.random import random, seed_stream, standard_normal

TERRAIN_DROPOUT = (0.01, 0.05, 0.15)  # of the presets
MOST_DELAY = 1000  # steps


@dataclasses.dataclass(frozen=True, kw_only=True)
class SensorConfig(Config):
    """Options of sensors; numbers are for all measured blocks, mappings for blocks by name."""

    presets = MappingProxyType({level: {} for level in LEVELS})  # what they do stands in the blocks

    preset: str | None = option(None, 'preset that the other options change', choices=LEVELS)
    noise: Any = option(
        None,
        'standard deviation of Gaussian noise in every step, in the units of the block; for contact, the '
        'probability that a flag is wrong; by default 0, or that of the preset',
    )
    bias: Any = option(
        None,
        'standard deviation of a Gaussian offset, drawn at the start of an episode for each number of a '
        'block; a map of the ground has a single one; by default 0, or that of the preset',
    )
    terrain_dropout: float | None = option(
        None,
        'probability that a number of a map of the ground is missing in a step; it is then observed as 0, '
        'the height of the ground under the root; by default 0, or that of the preset',
        at_least=0,
        at_most=1,
    )
    delay: Any = option(
        None,
        'age of what is observed, in steps of the environment (in gaits, cycles); a pair of bounds: drawn '
        'for each episode and block; by default 0, or that of the preset if steps last 1/30 s',
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in 'noise', 'bias':
            for block, value in _entries(getattr(self, name)):
                where = f'{name}[{block!r}]' if block else name
                checked(where, value, float, at_least=0, at_most=1e6)
        for block, value in _entries(self.delay):
            where = f'delay[{block!r}]' if block else 'delay'
            message = f'{where} is {value!r}; expected whole numbers of steps up to {MOST_DELAY}'
            try:
                low, high = checked(where, value, Range, at_least=0, at_most=MOST_DELAY)
            except ValueError:
                raise ValueError(message) from None
            if low % 1 or high % 1:
                raise ValueError(message)


class SensorState(NamedTuple):
    """State of the sensors of each simulation.

    Attributes:
      observation: what is observed, (n, size).
      bias: offset of each number, (n, size).
      noise: current noise of each number, (n, size); 1 for a flag that is wrong.
      missing: whether a number is missing at present, (n, size).
      delay: age of each number, (n, size) steps.
      history: exact observations of the last steps, (n, depth, size); depth 0 without delay.
      stream: random stream, see `trl_suite.util.random.seed_stream`, (n, 6).
      head: place of the current observation in the history, (n,).
    """

    observation: np.ndarray
    bias: np.ndarray
    noise: np.ndarray
    missing: np.ndarray
    delay: np.ndarray
    history: np.ndarray
    stream: np.ndarray
    head: np.ndarray = WHOLE


class SensorData(NamedTuple):
    """Data of the compiled functions of sensors.

    Attributes:
      exact: exact observation, (n, size).
      noise, bias: standard deviations, (size,).
      wrong: probability that a flag is wrong, (size,).
      dropout: probability that a number is missing, (size,).
      shared: whether the bias (first row) and the delay (second row) of a number are those of the
        number before it, (2, size) bool.
      delay: bounds of the age, (size, 2) steps.
      state: the state.
    """

    exact: np.ndarray
    noise: np.ndarray
    bias: np.ndarray
    wrong: np.ndarray
    dropout: np.ndarray
    shared: np.ndarray
    delay: np.ndarray
    state: SensorState


def sensor_data(
    config: SensorConfig, blocks: Sequence[Block], exact: np.ndarray, long_steps: bool
) -> SensorData:
    """Allocates sensors.

    Args:
      config: the options; see `check` for which fit the blocks.
      blocks: the blocks of an observation.
      exact: the exact observations, (n, size).
      long_steps: whether steps are gait cycles or footsteps: presets then have no delay.
    """
    n, size = exact.shape
    noise, bias, wrong, dropout = np.zeros((4, size))
    shared, delay = np.zeros((2, size), bool), np.zeros((size, 2), int)
    slices = layout(blocks)
    for block in blocks:
        if isinstance(block.noise, str) or not block.size:
            continue
        name, part, measured = block.name, slices[block.name], block.noise
        flags = measured.kind == 'flags'
        target = wrong if flags else noise
        target[part] = _of(config.noise, name, _at(config.preset, measured.noise), flags)
        bias[part] = _of(config.bias, name, _at(config.preset, measured.bias), flags)
        latest = 0 if long_steps else _at(config.preset, measured.delay)
        delay[part] = checked('delay', _of(config.delay, name, (0, latest), False), Range)
        shared[1, part.start + 1 : part.stop] = True
        if measured.kind == 'map':
            given = config.terrain_dropout
            dropout[part] = _at(config.preset, TERRAIN_DROPOUT) if given is None else given
            shared[0, part.start + 1 : part.stop] = True
    depth = int(delay.max()) + 1 if delay.any() else 0
    numbers = np.zeros(size)
    state = allocated(
        SensorState,
        n,
        observation=numbers,
        bias=numbers,
        noise=numbers,
        missing=np.zeros(size, bool),
        delay=np.zeros(size, int),
        history=np.zeros((depth, size)),
        stream=np.zeros(6, np.uint64),
    )
    return SensorData(exact, noise, bias, wrong, dropout, shared, delay, state)


def check(config: SensorConfig, blocks: Sequence[Block]) -> None:
    """Checks that the options fit the observation blocks of a task.

    Raises:
      ValueError: an unknown block, one that is exact, or an option that has no effect.
    """
    found = {block.name: block.noise for block in blocks if block.size}
    kinds = {name: 'exact' if isinstance(how, str) else how.kind for name, how in found.items()}
    for name in ('noise', 'bias', 'delay'):
        given = getattr(config, name)
        for block, value in given.items() if isinstance(given, Mapping) else ():
            if block not in found:
                raise ValueError(errors.unknown(f'block in {name}', block, found))
            if kinds[block] == 'exact':
                raise ValueError(f'{name} of block {block!r}: {found[block]}, so it is exact')
            if kinds[block] == 'flags' and name == 'bias':
                raise ValueError(f'bias of block {block!r}: flags have no bias, only noise')
            if kinds[block] == 'flags' and name == 'noise' and value > 1:
                raise ValueError(f'noise of block {block!r} is {value}; it is a probability')
    if config.terrain_dropout is not None and 'map' not in kinds.values():
        raise ValueError('terrain_dropout has no effect: the task does not observe the ground')


def _at(preset: str | None, values: Sequence[Any]) -> Any:
    """Returns the value for a preset; 0 without one."""
    return 0 if preset is None else values[LEVELS.index(preset)]


def _entries(value: Any) -> list[tuple[str, Any]]:
    """Returns names and values of a mapping, or one value without a name; nothing for None."""
    if value is None:
        return []
    return list(value.items()) if isinstance(value, Mapping) else [('', value)]


def _of(given: Any, name: str, default: Any, flags: bool) -> Any:
    """Returns the value for a block; a number for all blocks is not for flags."""
    if isinstance(given, Mapping):
        return given.get(name, default)
    return default if given is None or flags else given


@compiled
def begin(i: int, data: SensorData) -> None:
    """Draws bias and delay of an episode, and fills the history with the current observation."""
    state = data.state
    for k in range(len(data.noise)):
        if data.shared[0, k]:
            state.bias[i, k] = state.bias[i, k - 1]
        elif data.bias[k] > 0.0:
            state.bias[i, k] = data.bias[k] * standard_normal(i, state.stream)
        low, high = data.delay[k, 0], data.delay[k, 1]
        if data.shared[1, k]:
            state.delay[i, k] = state.delay[i, k - 1]
        elif high > low:
            state.delay[i, k] = low + int(random(i, state.stream) * (high - low + 1))
        else:
            state.delay[i, k] = low
    state.head[i] = 0
    for place in range(state.history.shape[1]):
        for k in range(len(data.noise)):
            state.history[i, place, k] = data.exact[i, k]


@compiled
def draw(i: int, data: SensorData) -> None:
    """Draws the noise and the missing numbers of a step."""
    state = data.state
    for k in range(len(data.noise)):
        if data.noise[k] > 0.0:
            state.noise[i, k] = data.noise[k] * standard_normal(i, state.stream)
        elif data.wrong[k] > 0.0:
            state.noise[i, k] = random(i, state.stream) < data.wrong[k]
        if data.dropout[k] > 0.0:
            state.missing[i, k] = random(i, state.stream) < data.dropout[k]


@compiled
def observe(i: int, data: SensorData) -> None:
    """Writes what is observed."""
    state, depth = data.state, data.state.history.shape[1]
    for k in range(len(data.noise)):
        value = data.exact[i, k]
        if depth > 0:
            state.history[i, state.head[i], k] = value
            value = state.history[i, (state.head[i] - state.delay[i, k]) % depth, k]
        if data.wrong[k] > 0.0:
            value = 1.0 - value if state.noise[i, k] > 0.0 else value
        else:
            value += state.bias[i, k] + state.noise[i, k]
        state.observation[i, k] = 0.0 if state.missing[i, k] else value


@compiled
def sense_all(env_ids: np.ndarray, fresh: bool, data: SensorData) -> None:
    """Writes what is observed after a step, or if `fresh` in new episodes. Takes a pack."""
    depth = data.state.history.shape[1]
    for i in env_ids:
        if fresh:
            begin(i, data)
        elif depth > 0:
            data.state.head[i] = (data.state.head[i] + 1) % depth
        draw(i, data)
        observe(i, data)


class Sensors(Component):
    """Sensors: the observation has noise, bias, drop-outs and delay.

    Rewards, terminations and custom functions read the true state. `info` has 'clean_observation',
    the exact observation, (n, size).
    """

    def __init__(self, config: SensorConfig) -> None:
        self._config = config

    def added_to(self, task: Task) -> None:
        super().added_to(task)
        self._observed = *task.observed, *(b for each in task.components for b in each.blocks)
        check(self._config, self._observed)

    @property
    def made_of(self) -> dict[str, tuple[str, Any]]:
        return {'sensors': (str(self._config.changed), self._config)}

    def bind(self, world: World, outcome: Outcome) -> Outcome:
        data = sensor_data(self._config, self._observed, outcome.observation, self.task.steps_vary)
        self._pack, self._state = packed(data), data.state
        self.saved = (data.state,)
        self.info_arrays = {'clean_observation': outcome.observation}
        return Outcome(data.state.observation, *outcome[1:])

    def begin(self, env_id: int, seed: np.random.SeedSequence) -> None:
        seed_stream(env_id, spawned(seed, SENSORS), self._state.stream)

    def finish(self, env_ids: np.ndarray, fresh: bool) -> None:
        sense_all(env_ids, fresh, self._pack)
