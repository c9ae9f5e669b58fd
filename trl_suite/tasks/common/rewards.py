"""Reward terms of tasks that track a reference motion."""

from __future__ import annotations

from typing import Any

from trl_suite.tasks.terms import Outcome, Term, score
from trl_suite.util.compiled import compiled

COM_ERROR_FACTOR = 0.1  # the com error is this times the squared velocity error


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


@compiled
def score_tracking(
    i: int, pose: float, velocity: float, end_effector: float, com: float, height: float, terms: Any,
    outcome: Outcome,
) -> None:  # fmt: skip
    """Writes the terms of `tracking_terms` from their errors."""
    score(i, pose, terms.pose, outcome)
    score(i, velocity, terms.velocity, outcome)
    score(i, end_effector, terms.end_effector, outcome)
    score(i, com, terms.com, outcome)
    score(i, height, terms.root, outcome)
