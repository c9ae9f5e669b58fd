"""Sensors: noise, bias, drop-outs and delay of observation blocks.

An observed number is the true one of `delay` steps ago, plus a bias that is constant within an
episode, plus noise that is drawn in every step. What the controller computes itself is exact: the
phase, the reference, and the observation of a footstep controller.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from trl_suite.tasks.disturbances.worlds import bounds, preset_and_options
from trl_suite.util import errors
from trl_suite.util.compiled import compiled, compiled_loop
from trl_suite.util.options import Config, option
from trl_suite.util.random import random, standard_normal

MAPS = ('terrain', 'surface')  # blocks that describe the ground
FLAGS = ('contact',)  # blocks of zeros and ones
EXACT = {
    'phase': "the phase is the controller's own clock",
    'reference': 'the reference is known to the controller',
    'low_level': 'the footstep controller has its own observation',
}
MOST_DELAY = 1000  # steps
FRESH, NEXT, AGAIN = range(3)  # a new episode; the next step; the same state once more


@dataclasses.dataclass(frozen=True, kw_only=True)
class SensorConfig(Config):
    """Options of sensors; numbers are for all measured blocks, mappings for blocks by name."""

    preset: str | None = option(
        None, 'preset that the other options change', choices=('mild', 'robot', 'harsh')
    )
    noise: Any = option(
        0.0,
        'standard deviation of Gaussian noise in every step, in the units of the block; for `contact`, the '
        'probability that a flag is wrong',
    )  # fmt: skip
    bias: Any = option(
        0.0,
        'standard deviation of a Gaussian offset, drawn at the start of an episode for each number of a '
        'block; a map of the ground has a single one',
    )  # fmt: skip
    terrain_dropout: float = option(
        0.0,
        'probability that a number of a map of the ground is missing in a step; it is then observed as 0, '
        'the height of the ground under the root',
        at_least=0, at_most=1,
    )  # fmt: skip
    delay: Any = option(
        0,
        'age of what is observed, in steps of the environment (in gaits, cycles); a pair of bounds: drawn '
        'for each episode and block',
    )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, most in (('noise', 1e6), ('bias', 1e6)):
            given = getattr(self, name)
            for block, value in _entries(given):
                if not _number(value) or not 0 <= value <= most:
                    where = f'{name}[{block!r}]' if block else name
                    raise ValueError(f'{where} is {value!r}; expected a number from 0 to {most:g}')
        for block, value in _entries(self.delay):
            where = f'delay[{block!r}]' if block else 'delay'
            message = f'{where} is {value!r}; expected whole numbers of steps up to {MOST_DELAY}'
            try:
                low, high = bounds(where, value)
            except (TypeError, ValueError, OverflowError):
                raise ValueError(message) from None
            if low % 1 or high % 1 or not 0 <= low <= high <= MOST_DELAY:
                raise ValueError(message)


# Noise of 'robot': uniform noise of +-a has the standard deviation a / sqrt(3). legged_gym
# (`legged_robot_config.py`; Rudin et al. 2022) has +-0.1 m for heights of the ground and +-0.1 m/s
# for velocities of the base; +-0.01 rad for joint angles, in MuJoCo Playground 0.03 rad, which are
# 5 to 15 mm at the end of a leg of 0.5 m. Bias, drop-outs and delays are chosen, and so are the
# other presets: about a third of 'robot', and twice as much.
PRESETS: Mapping[str, Mapping[str, Any]] = {
    'mild': {
        'noise': {
            'terrain': 0.02, 'surface': 0.02, 'pose': 0.003, 'velocity': 0.02, 'strain': 0.003,
            'contact': 0.002, 'plan': 0.003, 'goal': 0.01, 'ball': 0.01, 'target_heading': 0.005,
        },
        'bias': {'terrain': 0.005, 'pose': 0.002},
        'terrain_dropout': 0.01,
    },
    'robot': {
        'noise': {
            'terrain': 0.06, 'surface': 0.06, 'pose': 0.01, 'velocity': 0.06, 'strain': 0.01,
            'contact': 0.01, 'plan': 0.01, 'goal': 0.03, 'ball': 0.03, 'target_heading': 0.02,
        },
        'bias': {'terrain': 0.02, 'pose': 0.005},
        'terrain_dropout': 0.05,
        'delay': {'terrain': (0, 2), 'surface': (0, 2)},
    },
    'harsh': {
        'noise': {
            'terrain': 0.12, 'surface': 0.12, 'pose': 0.02, 'velocity': 0.15, 'strain': 0.02,
            'contact': 0.05, 'plan': 0.02, 'goal': 0.1, 'ball': 0.1, 'target_heading': 0.05,
        },
        'bias': {'terrain': 0.05, 'pose': 0.01},
        'terrain_dropout': 0.15,
        'delay': {'terrain': (0, 6), 'surface': (0, 6)},
    },
}  # fmt: skip


def configure(value: Any) -> SensorConfig | None:
    """Returns the options of sensors; see `worlds.configure` for the forms of the value.

    Raises:
      ValueError: unknown names, or values out of range.
    """
    return preset_and_options('sensors', value, SensorConfig, PRESETS)


def fitting(config: SensorConfig, long_steps: bool) -> SensorConfig:
    """Returns options without the delay of a preset, if steps are gait cycles or footsteps.

    The delays of presets are meant for steps of 1/30 s. An explicit delay counts steps, however
    long they are.
    """
    preset = PRESETS.get(config.preset or '', {})
    if long_steps and config.delay == preset.get('delay'):
        return dataclasses.replace(config, delay=0)
    return config


class SensorState(NamedTuple):
    """State of the sensors of each simulation.

    Attributes:
      observation: what is observed, (n, size).
      bias: offset of each number, (n, size).
      noise: current noise of each number, (n, size); 1 for a flag that is wrong.
      missing: whether a number is missing at present, (n, size).
      delay: age of each number, (n, size) steps.
      head: place of the current observation in the history, (n,).
      history: exact observations of the last steps, (n, depth, size); depth 0 without delay.
      stream: random stream, see `trl_suite.util.random.Streams`, (n, 6).
    """

    observation: np.ndarray
    bias: np.ndarray
    noise: np.ndarray
    missing: np.ndarray
    delay: np.ndarray
    head: np.ndarray
    history: np.ndarray
    stream: np.ndarray


class SensorRules(NamedTuple):
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


def rules(config: SensorConfig, blocks: Mapping[str, slice], exact: np.ndarray) -> SensorRules:
    """Allocates sensors.

    Args:
      config: the options; see `check` for which fit the blocks.
      blocks: slices of the blocks of an observation.
      exact: the exact observations, (n, size).
    """
    n, size = exact.shape
    noise, bias, wrong, dropout = np.zeros((4, size))
    shared, delay = np.zeros((2, size), bool), np.zeros((size, 2), int)
    for name, part in blocks.items():
        if name in EXACT:
            continue
        target = wrong if name in FLAGS else noise
        target[part] = _of(config.noise, name, flags=False)
        bias[part] = _of(config.bias, name, flags=False)
        delay[part] = bounds('delay', _of(config.delay, name))
        shared[1, part.start + 1 : part.stop] = True
        if name in MAPS:
            dropout[part] = config.terrain_dropout
            shared[0, part.start + 1 : part.stop] = True
    depth = int(delay.max()) + 1 if delay.any() else 0
    state = SensorState(
        np.zeros((n, size)), np.zeros((n, size)), np.zeros((n, size)), np.zeros((n, size), bool),
        np.zeros((n, size), int), np.zeros(n, int), np.zeros((n, depth, size)),
        np.zeros((n, 6), np.uint64),
    )  # fmt: skip
    return SensorRules(exact, noise, bias, wrong, dropout, shared, delay, state)


def check(config: SensorConfig, blocks: Mapping[str, slice]) -> None:
    """Checks that the options fit the observation blocks of a task.

    Options of a preset may name blocks that the task does not have.

    Raises:
      ValueError: an unknown block, one that is exact, or an option that has no effect.
    """
    preset = PRESETS.get(config.preset or '', {})
    for name in ('noise', 'bias', 'delay'):
        given = getattr(config, name)
        if given == preset.get(name) or not isinstance(given, Mapping):
            continue
        for block in given:
            if block not in blocks:
                raise ValueError(errors.unknown(f'block in {name}', block, blocks))
            if block in EXACT:
                raise ValueError(f'{name} of block {block!r}: {EXACT[block]}, so it is exact')
            if block in FLAGS and name == 'bias':
                raise ValueError(f'bias of block {block!r}: flags have no bias, only noise')
            if block in FLAGS and name == 'noise' and given[block] > 1:
                raise ValueError(f'noise of block {block!r} is {given[block]}; it is a probability')
    own = config.terrain_dropout != preset.get('terrain_dropout', 0.0)
    if own and not any(name in blocks for name in MAPS):
        raise ValueError('terrain_dropout has no effect: the task does not observe the ground')


def _entries(value: Any) -> list[tuple[str, Any]]:
    """Returns names and values of a mapping, or one value without a name."""
    return list(value.items()) if isinstance(value, Mapping) else [('', value)]


def _number(value: Any) -> bool:
    return isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)


def _of(given: Any, name: str, flags: bool = True) -> Any:
    """Returns the value for a block; a number for all blocks is not for flags, unless `flags`."""
    if isinstance(given, Mapping):
        return given.get(name, 0)
    return given if flags or name not in FLAGS else 0


@compiled
def begin(i: int, rules: SensorRules) -> None:
    """Draws bias and delay of an episode, and fills the history with the current observation."""
    state = rules.state
    for k in range(len(rules.noise)):
        if rules.shared[0, k]:
            state.bias[i, k] = state.bias[i, k - 1]
        elif rules.bias[k] > 0.0:
            state.bias[i, k] = rules.bias[k] * standard_normal(i, state.stream)
        low, high = rules.delay[k, 0], rules.delay[k, 1]
        if rules.shared[1, k]:
            state.delay[i, k] = state.delay[i, k - 1]
        elif high > low:
            state.delay[i, k] = low + int(random(i, state.stream) * (high - low + 1))
        else:
            state.delay[i, k] = low
    state.head[i] = 0
    for place in range(state.history.shape[1]):
        for k in range(len(rules.noise)):
            state.history[i, place, k] = rules.exact[i, k]


@compiled
def draw(i: int, rules: SensorRules) -> None:
    """Draws the noise and the missing numbers of a step."""
    state = rules.state
    for k in range(len(rules.noise)):
        if rules.noise[k] > 0.0:
            state.noise[i, k] = rules.noise[k] * standard_normal(i, state.stream)
        elif rules.wrong[k] > 0.0:
            state.noise[i, k] = random(i, state.stream) < rules.wrong[k]
        if rules.dropout[k] > 0.0:
            state.missing[i, k] = random(i, state.stream) < rules.dropout[k]


@compiled
def observe(i: int, rules: SensorRules) -> None:
    """Writes what is observed."""
    state, depth = rules.state, rules.state.history.shape[1]
    for k in range(len(rules.noise)):
        value = rules.exact[i, k]
        if depth > 0:
            state.history[i, state.head[i], k] = value
            value = state.history[i, (state.head[i] - state.delay[i, k]) % depth, k]
        if rules.wrong[k] > 0.0:
            value = 1.0 - value if state.noise[i, k] > 0.0 else value
        else:
            value += state.bias[i, k] + state.noise[i, k]
        state.observation[i, k] = 0.0 if state.missing[i, k] else value


@compiled_loop
def sense_all(env_ids: np.ndarray, kind: int, rules: SensorRules) -> None:
    """Writes what is observed in simulations: `FRESH`, `NEXT` or `AGAIN`. Takes a pack."""
    depth = rules.state.history.shape[1]
    for i in env_ids:
        if kind == FRESH:
            begin(i, rules)
        elif kind == NEXT and depth > 0:
            rules.state.head[i] = (rules.state.head[i] + 1) % depth
        if kind != AGAIN:
            draw(i, rules)
        observe(i, rules)
