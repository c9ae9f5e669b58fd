"""Reward terms as data, and the compiled functions that write them.

A task declares its terms once, beside the compiled function that computes them. That function reads
weights and scales by name, as in `score(i, error, rules.terms.pose, rules.outcome)`; indices, `info`
and the tables of `trl-suite info` and of the pages derive from the declaration.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from trl_suite.kinematics.blocks import by_name
from trl_suite.util.compiled import compiled

if TYPE_CHECKING:
    from trl_suite.tasks.task import Outcome


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
    return by_name('Terms', {
        term.name: TermData(k, float(term.weight), float(term.scale or 0.0))
        for k, term in enumerate(terms)
    })  # fmt: skip


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
