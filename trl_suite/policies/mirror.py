"""Reflection of observations and actions in left stance to those of right stance.

A symmetric walker needs to learn only right stance. `Mirror` is data: it reflects a policy's
observations in left stance, and reflects the resulting actions back.
"""

from __future__ import annotations

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True)
class Mirror:
    """The reflection of observations (n, size) and actions (n, k).

    Attributes:
      observation_index, observation_sign: a reflected observation is `o[:, index] * sign`, with its
        phase shifted by half a cycle; (size,).
      action_index, action_sign: a reflected action is `a[:, index] * sign`, (k,).
      phase: column of the phase of the cycle; left stance is from 0.5 to 1.
      feet: if there is no such column, those of the forward positions of the right and the left
        foot: at the start of a step, the stance foot is the one ahead.
    """

    observation_index: np.ndarray
    observation_sign: np.ndarray
    action_index: np.ndarray
    action_sign: np.ndarray
    phase: int | None = None
    feet: tuple[int, int] | None = None

    def check(self, observations: int, actions: int) -> None:
        """Checks that the fields fit these numbers of observations and actions."""
        for kind, size in (('observation', observations), ('action', actions)):
            index, sign = getattr(self, f'{kind}_index'), getattr(self, f'{kind}_sign')
            if np.shape(index) != (size,) or (np.sort(index) != np.arange(size)).any():
                raise ValueError(f'mirror_{kind}_index: expected each of 0 to {size - 1} once')
            if np.shape(sign) != (size,) or not np.isin(sign, (-1, 1)).all():
                raise ValueError(f'mirror_{kind}_sign: expected {size} numbers, each 1 or -1')
        if (self.phase is None) == (self.feet is None):
            raise ValueError('mirror_phase, mirror_feet: expected one of them')
        if self.phase is not None and not 0 <= self.phase < observations:
            raise ValueError(f'mirror_phase: {self.phase} is not one of {observations} columns')
        if self.feet is not None:
            right, left = self.feet if len(self.feet) == 2 else (-1, -1)
            if not 0 <= right < observations or self.observation_index[right] != left:
                raise ValueError(
                    f'mirror_feet: {tuple(self.feet)}; expected two of {observations} columns that '
                    'the reflection exchanges'
                )

    def left(self, observation: np.ndarray) -> np.ndarray:
        """Returns which observations are of left stance, (n,) bool."""
        if self.feet is not None:
            return observation[:, self.feet[1]] > observation[:, self.feet[0]]
        return observation[:, self.phase] >= 0.5

    def observation(self, observation: np.ndarray) -> np.ndarray:
        """Reflects observations (n, size)."""
        reflected = observation.take(self.observation_index, 1) * self.observation_sign
        if self.phase is not None:
            phase = reflected[:, self.phase]
            reflected[:, self.phase] = np.where(phase >= 0.5, phase - 0.5, phase + 0.5)
        return reflected

    def action(self, action: np.ndarray) -> np.ndarray:
        """Reflects actions (n, k)."""
        return action.take(self.action_index, 1) * self.action_sign

    def canonical(self, observation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns observations, reflected if in left stance, and which were in left stance."""
        left = self.left(observation)
        if left.all():
            return self.observation(observation), left
        if left.any():
            observation = np.where(left[:, None], self.observation(observation), observation)
        return observation, left

    def unmirror_action(self, action: np.ndarray, left: np.ndarray) -> np.ndarray:
        """Returns actions, reflected where `left`."""
        if left.all():
            return self.action(action)
        if left.any():
            action = np.where(left[:, None], self.action(action), action)
        return action


def exchanged(count: int, pairs: list[tuple[int, int]]) -> np.ndarray:
    """Returns the indices 0 to count - 1 with those of each pair exchanged."""
    index = np.arange(count)
    for a, b in pairs:
        index[a], index[b] = b, a
    return index


def blocks(index: np.ndarray, signs: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Returns index and sign, (b * c,), of columns that form blocks of equal size.

    `index` is the source block of each block, (b,); `signs` are those of the c columns of a block.
    """
    width = len(signs)
    return (index[:, None] * width + np.arange(width)).ravel(), np.tile(signs, len(index))
