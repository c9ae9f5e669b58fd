"""The outcome of a step, and reward terms as data, with the compiled functions that write them.

A task declares its terms once, beside the compiled function that computes them. That function reads
weights and scales by name, as in `score(i, error, data.terms.pose, data.outcome)`; indices, `info`
and the tables of `trl-suite info` and of the pages derive from the declaration.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from trl_suite.bodies.blocks import by_name
from trl_suite.util.compiled import compiled


class Outcome(NamedTuple):
    """The results of a step, with a leading axis of n simulations.

    Attributes:
      observation: all observation blocks, concatenated, (n, observation size).
      reward: (n,).
      reward_terms: weighted terms of the reward, (n, terms); 0 after a reset.
      failed: whether the episode has ended with discount 0, (n,) bool.
      diverged: whether it failed because the physics diverged, (n,) bool.
      fell: whether it failed for another reason, a fall or a landing error, (n,) bool.
    """

    observation: np.ndarray
    reward: np.ndarray
    reward_terms: np.ndarray
    failed: np.ndarray
    diverged: np.ndarray
    fell: np.ndarray


def outcome(n: int, size: int, terms: int = 0) -> Outcome:
    """Allocates the outcome of n simulations, for a size of observations and a number of terms."""
    return Outcome(np.zeros((n, size)), np.zeros(n), np.zeros((n, terms)), *np.zeros((3, n), bool))


@compiled
def begin(i: int, outcome: Outcome) -> None:
    """Resets the outcome of a simulation, except its observation."""
    outcome.reward[i] = 0.0
    outcome.failed[i] = outcome.diverged[i] = outcome.fell[i] = False
    for k in range(outcome.reward_terms.shape[1]):
        outcome.reward_terms[i, k] = 0.0


@compiled
def conclude(i: int, failed: bool, outcome: Outcome) -> None:
    """Sets the reward to the sum of its terms, or both to 0 if the episode has failed."""
    outcome.failed[i] = failed
    outcome.fell[i] = failed and not outcome.diverged[i]
    reward = 0.0
    for k in range(outcome.reward_terms.shape[1]):
        if failed:
            outcome.reward_terms[i, k] = 0.0
        reward += outcome.reward_terms[i, k]
    outcome.reward[i] = reward


@dataclasses.dataclass(frozen=True)
class Term:
    """A term of the reward.

    Attributes:
      name: its name.
      weight: its largest value.
      meaning: what its error, or without a scale its share of the weight, is.
      scale: the term is weight * exp(-scale * error); None: weight * share, a number in [0, 1].
      unit: unit of the error.
    """

    name: str
    weight: float
    meaning: str = ''
    scale: float | None = None
    unit: str = ''


class TermData(NamedTuple):
    """Column, weight and scale of a term, for compiled functions."""

    column: int
    weight: float
    scale: float


def terms_data(terms: Iterable[Term]) -> Any:
    """Returns a named tuple with the `TermData` of each term, by name."""
    return by_name(
        'Terms',
        {
            term.name: TermData(k, float(term.weight), float(term.scale or 0.0))
            for k, term in enumerate(terms)
        },
    )


@compiled
def score(i: int, error: float, term: TermData, outcome: Outcome) -> None:
    """Writes a term: weight * exp(-scale * error)."""
    outcome.reward_terms[i, term.column] = term.weight * math.exp(-term.scale * error)


@compiled
def give(i: int, share: float, term: TermData, outcome: Outcome) -> None:
    """Writes a term: weight * share, a number in [0, 1]."""
    outcome.reward_terms[i, term.column] = term.weight * share


@compiled
def facing(error: float) -> float:
    """Returns ((1 + cos error) / 2)^4 for an error in rad: 1 if it is 0, 0 if it is pi."""
    half = 0.5 + 0.5 * math.cos(error)
    return half * half * half * half


@compiled
def wrapped(angle: float) -> float:
    """Returns an angle in rad wrapped to [-pi, pi]; angles in this range are unchanged."""
    return angle - 2 * math.pi * np.rint(angle / (2 * math.pi))
