"""The outcome of a step: observation, failure, and reward terms, with the functions that write them.

A task declares its terms as data, once, beside the compiled function that computes them. That
function reads weights and scales by name, as in `score(i, error, data.terms.pose, data.outcome)`;
indices, `info` and the tables of `trl-suite info` and of the pages derive from the declaration.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from trl_suite.bodies.blocks import by_name
from trl_suite.bodies.body import Measurement
from trl_suite.bodies.reference import Reference, TrackTable, feature
from trl_suite.characters import Character
from trl_suite.util.compiled import compiled

COM_ERROR_FACTOR = 0.1  # the com error is this times the squared velocity error
# Falls of tasks with long steps: a fall link often touches the ground, as in the original. The decaying
# average of samples, with contact or without, and that above which it is a fall.
FALL_DECAY, FALL_GAIN, FALL_THRESHOLD = 0.9, 1 / 11, 0.25


class Outcome(NamedTuple):
    """The results of a step, with a leading axis of n simulations.

    Attributes:
      observation: all observation blocks, concatenated, (n, observation size).
      reward: (n,).
      reward_terms: weighted terms of the reward, (n, terms); 0 after a reset.
      failed: whether the episode has ended with discount 0, (n,) bool.
      diverged: whether it failed because the physics diverged, (n,) bool.
      fell: whether it failed for another reason: a fall, a landing error or no progress, (n,) bool.
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


@compiled
def sample_fall(i: int, touches: bool, down: np.ndarray) -> None:
    """Updates the average `down` (n,) of a simulation by a sample."""
    down[i] *= FALL_DECAY
    if touches:
        down[i] += FALL_GAIN


def fall_condition() -> str:
    """Returns the condition in words, after the names of the links."""
    share, count = 0.0, 0
    while share <= FALL_THRESHOLD:
        share, count = FALL_DECAY * share + FALL_GAIN, count + 1
    return (
        f'touches the ground in {count} consecutive samples, or so often that d > {FALL_THRESHOLD:g}, where '
        f'every sample multiplies d by {FALL_DECAY:g} and adds 1/{1 / FALL_GAIN:.0f} if there is contact'
    )


# Of tasks that track a reference motion.


def tracking_terms(
    about: str, average: str, **weights_and_scales: tuple[float, float]
) -> tuple[Term, ...]:
    """Returns the terms that compare a character with its reference motion.

    Args:
      about: origin of end effector positions.
      average: 'mean' or 'sum' over end effectors.
      weights_and_scales: weight of each term, and scale of its error, by name.
    """
    errors = {
        'pose': ('rad^2', 'squared differences of the angles of joints and root, mean with the weights in Links'),
        'velocity': (
            'rad^2/s^2', 'squared differences of their angular velocities, mean with the same weights',
        ),
        'end_effector': (
            'm^2', f'squared differences of the positions of the end effectors from {about} and their heights above '
            f'the ground, {average} over end effectors',
        ),
        'com': (
            'm^2/s^2', f'{COM_ERROR_FACTOR:g} times the squared difference of the velocities of the centre of mass',
        ),
        'root': ('m^2', 'squared difference of the heights of the root above the ground'),
    }  # fmt: skip
    return tuple(
        Term(name, weight, meaning, scale, unit)
        for name, (weight, scale) in weights_and_scales.items()
        for unit, meaning in (errors[name],)
    )


# Source: the imitation scenario of the original; 'Does the choice of action space matter?' (Peng &
# van de Panne 2017) has the same structure.
IMITATION_TERMS = tracking_terms(
    'the centre of mass', 'mean', pose=(0.5, 2.0), velocity=(0.05, 0.005), end_effector=(0.15, 40.0),
    com=(0.2, 10.0), root=(0.1, 10.0),
)  # fmt: skip
# Of footstep controllers, whose end-effector error includes the landing place. Source: the step
# scenario of the original; 'DeepLoco' (Peng, Berseth, Yin, van de Panne 2017).
STEP_TERMS = tracking_terms(
    'the root', 'sum', pose=(0.5 / 1.05, 2.0), velocity=(0.05 / 1.05, 0.005),
    end_effector=(0.2 / 1.05, 5.0), com=(0.1 / 1.05, 10.0), root=(0.1 / 1.05, 10.0),
)  # fmt: skip
HEADING_WEIGHT = 0.1 / 1.05  # of the term heading, which footstep controllers have as well


class Comparison(NamedTuple):
    """Data for a comparison: the reference, columns of its features, and weights.

    Attributes:
      tracks: the reference.
      columns: first column of each feature, by the names of `Reference.columns`.
      poses: number of columns of positions and velocities.
      wrapped: number of angles, the first ones, whose differences are wrapped.
      pose_weights: weights of rotations, then of angles.
      rate_weights: weights of rates.
      terms: the reward terms.
    """

    tracks: TrackTable
    columns: Any
    poses: int
    wrapped: int
    pose_weights: np.ndarray
    rate_weights: np.ndarray
    terms: Any


def comparison(character: Character, reference: Reference, terms: tuple[Term, ...]) -> Comparison:
    """Returns the data for comparing a character with a reference."""
    weights, ball, columns = character.spec.weights, character.spherical, reference.columns
    joints, spatial = np.asarray(weights[1:]), character.spec.spatial
    return Comparison(
        tracks=reference.tracks,
        columns=by_name('Features', {name: part.start for name, part in columns.items()}),
        poses=columns['velocities'].stop - columns['positions'].start,
        wrapped=0 if spatial else 1,  # the pitch of the root
        pose_weights=np.concatenate([weights[:1], joints[ball], joints[~ball]]),
        rate_weights=np.concatenate(
            [np.full(3 if spatial else 1, weights[0]), np.repeat(joints, character.dofs)]
        ),
        terms=terms_data(terms),
    )


# Functions of simulation i and a row and fraction of the reference table (see `moment`).


@compiled
def motion_errors(
    i: int, row: int, fraction: float, comparison: Comparison, measurement: Measurement
) -> tuple[float, float, float]:
    """Returns the errors of rotations and angles, of rates, and of the height of the root.

    The first is the weighted sum of squared angles between rotations and of squared differences of
    angles, rad^2; the others are of squared differences, rad^2/s^2 and m^2.
    """
    columns, tracks, mine = comparison.columns, comparison.tracks, measurement.features
    pose = rates = 0.0
    count = (columns.angles - columns.rotations) // 4
    for joint in range(count):
        column = columns.rotations + 4 * joint
        dot = square = 0.0
        for k in range(column, column + 4):
            other = feature(row, fraction, k, tracks)
            dot += mine[i, k] * other
            square += other * other
        angle = 2 * math.acos(min(abs(dot) / math.sqrt(square), 1.0))  # the shortest rotation
        pose += comparison.pose_weights[joint] * (angle * angle)
    for k in range(columns.rates - columns.angles):
        off = mine[i, columns.angles + k] - feature(row, fraction, columns.angles + k, tracks)
        if k < comparison.wrapped:
            off = wrapped(off)
        pose += comparison.pose_weights[count + k] * (off * off)
    for k in range(columns.effectors - columns.rates):
        off = mine[i, columns.rates + k] - feature(row, fraction, columns.rates + k, tracks)
        rates += comparison.rate_weights[k] * (off * off)
    height = mine[i, columns.height] - feature(row, fraction, columns.height, tracks)
    return pose, rates, height * height


@compiled
def effector_error(
    i: int, row: int, fraction: float, comparison: Comparison, measurement: Measurement
) -> float:
    """Mean over end effectors of the squared distance, m^2."""
    first, stop = comparison.columns.effectors, comparison.columns.com_velocity
    error = 0.0
    for k in range(first, stop):
        off = measurement.features[i, k] - feature(row, fraction, k, comparison.tracks)
        error += off * off
    return error / ((stop - first) // 3)


@compiled
def com_error(
    i: int,
    row: int,
    fraction: float,
    turned: float,
    comparison: Comparison,
    measurement: Measurement,
) -> float:
    """Scaled squared difference of the velocities of the centre of mass, m^2/s^2.

    The velocity of the reference is rotated about z by `turned`, rad.
    """
    cosine, sine = math.cos(turned), math.sin(turned)
    column, tracks = comparison.columns.com_velocity, comparison.tracks
    x = feature(row, fraction, column, tracks)
    y = feature(row, fraction, column + 1, tracks)
    off_x = measurement.com_velocity[i, 0] - (cosine * x - sine * y)
    off_y = measurement.com_velocity[i, 1] - (sine * x + cosine * y)
    off_z = measurement.com_velocity[i, 2] - feature(row, fraction, column + 2, tracks)
    return COM_ERROR_FACTOR * (off_x * off_x + off_y * off_y + off_z * off_z)


@compiled
def score_tracking(
    i: int,
    pose: float,
    velocity: float,
    end_effector: float,
    com: float,
    height: float,
    terms: Any,
    outcome: Outcome,
) -> None:
    """Writes the terms of `tracking_terms` from their errors."""
    score(i, pose, terms.pose, outcome)
    score(i, velocity, terms.velocity, outcome)
    score(i, end_effector, terms.end_effector, outcome)
    score(i, com, terms.com, outcome)
    score(i, height, terms.root, outcome)
