"""Observation blocks as data: size, unit, meaning, noise and reflection.

A block is declared once, beside the compiled function that writes it. Columns, mirrored observations,
the presets of sensors, and the tables of `trl-suite info` and of the pages derive from it.
"""

from __future__ import annotations

import collections
import dataclasses
import itertools
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from trl_suite.actuation.action_map import ActionMap
from trl_suite.characters import Character
from trl_suite.motion.layout import SPIN

LEVELS = ('mild', 'robot', 'harsh')  # presets of sensors
ANGLE_AXIS = (1.0, -1.0, -1.0, 1.0)  # angle; forward, up, right


CLOCK = "the phase is the controller's own clock"  # why a phase is exact


class Noise(NamedTuple):
    """How sensors measure a block: three values each, in the presets mild, robot and harsh.

    Uniform noise of +-a has the standard deviation a / sqrt(3). legged_gym (`legged_robot_config.py`;
    Rudin et al. 2022) has +-0.1 m for heights of the ground and +-0.1 m/s for velocities of the base;
    +-0.01 rad for joint angles, in MuJoCo Playground 0.03 rad, which are 5 to 15 mm at the end of a
    leg of 0.5 m. These make 'robot'. Bias and delays are chosen, and so are the other presets: about
    a third of 'robot', and twice as much.

    Attributes:
      noise: standard deviations in every step, in the units of the block; of flags, the probability
        that one is wrong.
      bias: standard deviations of an offset that is constant within an episode.
      delay: largest ages in steps of 1/30 s.
      kind: 'numbers'; 'flags', zeros and ones; or 'map', numbers that describe the ground.
    """

    noise: tuple[float, float, float] = (0.0, 0.0, 0.0)
    bias: tuple[float, float, float] = (0.0, 0.0, 0.0)
    delay: tuple[int, int, int] = (0, 0, 0)
    kind: str = 'numbers'


NO_NOISE = Noise()
HEIGHTS = Noise((0.02, 0.06, 0.12), (0.005, 0.02, 0.05), (0, 2, 6), 'map')
PLACES = Noise((0.003, 0.01, 0.02), (0.002, 0.005, 0.01))
SPEEDS = Noise((0.02, 0.06, 0.15))


class Reflection(NamedTuple):
    """The reflection of k numbers in the x-z plane: `x[source] * sign`; see `policies.mirror`.

    Attributes:
      source, sign: (k,).
    """

    source: np.ndarray
    sign: np.ndarray


def signs(values: Iterable[float]) -> Reflection:
    """Returns the reflection that multiplies each number by a sign."""
    sign = np.array([*values])
    return Reflection(np.arange(len(sign)), sign)


@dataclasses.dataclass(frozen=True, eq=False)
class Block:
    """A part of an observation.

    Attributes:
      name: its name.
      size: how many numbers it has; 0: it is not observed.
      unit: their units.
      meaning: what they are, in one line.
      noise: how sensors measure them; a string says why they are exact.
      reflection: their reflection; None if there is none.
      kept: columns that mirrored observations keep; None: all of them.
      kept_meaning: what these are, if it is something else.
    """

    name: str
    size: int
    unit: str = ''
    meaning: str = ''
    noise: Noise | str = NO_NOISE
    reflection: Reflection | None = None
    kept: tuple[int, ...] | None = None
    kept_meaning: str = ''

    def observed_if(self, condition: bool) -> Block:
        """Returns the block, or an empty one of this name."""
        return self if condition else dataclasses.replace(self, size=0)

    def mirrored(self) -> Block:
        """Returns the block as mirrored observations have it."""
        size = self.size if self.kept is None or not self.size else len(self.kept)
        return dataclasses.replace(self, size=size, meaning=self.kept_meaning or self.meaning)


def layout(blocks: Iterable[Block]) -> dict[str, slice]:
    """Returns the slices of consecutive blocks, by name; empty blocks are left out."""
    return slices({block.name: block.size for block in blocks if block.size})


def slices(sizes: Mapping[str, int]) -> dict[str, slice]:
    """Returns the slices of consecutive parts with these sizes, by name."""
    stops = itertools.accumulate(sizes.values())
    return {
        name: slice(stop - size, stop)
        for (name, size), stop in zip(sizes.items(), stops, strict=True)
    }


def columns(blocks: Iterable[Block], of: Iterable[Block] | None = None) -> Any:
    """Returns the first column of each block for compiled functions; -1: it is empty.

    Args:
      blocks: consecutive blocks.
      of: the blocks that are asked for; by default all of them.
    """
    blocks = tuple(blocks)
    starts = {name: part.start for name, part in layout(blocks).items()}
    names = [block.name for block in (blocks if of is None else of)]
    return by_name('Columns', {name: starts.get(name, -1) for name in names})


def by_name(kind: str, values: Mapping[str, Any]) -> Any:
    """Returns a named tuple of type `kind` with these fields, for compiled functions."""
    return collections.namedtuple(kind, values)(**values)  # type: ignore[misc]


def reflected(blocks: Iterable[Block]) -> Reflection:
    """Returns the reflection of consecutive blocks.

    Raises:
      ValueError: a block has no reflection.
    """
    index, sign, start = [], [], 0
    for block in blocks:
        if not block.size:
            continue
        if block.reflection is None:
            raise ValueError(f'block {block.name!r} has no reflection')
        index.append(start + block.reflection.source)
        sign.append(block.reflection.sign)
        start += block.size
    return Reflection(np.concatenate(index), np.concatenate(sign))


def action_reflection(character: Character, action_map: ActionMap) -> Reflection:
    """Returns the reflection of actions, i.e. joint targets or torques."""
    spec = character.spec
    joints = list(spec.joints)
    ball = ANGLE_AXIS if action_map.has_axes else SPIN
    starts: list[int] = []
    signs: list[float] = []
    for spherical in character.spherical.tolist():
        starts.append(len(signs))
        signs += ball if spherical else (1.0,)
    index = np.arange(len(signs))
    for a, b in spec.mirror:
        i, j = (starts[joints.index(name)] for name in (a, b))
        width = len(ball) if character.spherical[joints.index(a)] else 1
        index[i : i + width] = np.arange(j, j + width)
        index[j : j + width] = np.arange(i, i + width)
    return Reflection(index, np.array(signs))
