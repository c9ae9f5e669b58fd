"""Metrics of continual learning.

They take a matrix R, where R[i, j] is the score on task j after training on tasks 0 to i.

Lopez-Paz & Ranzato: Gradient Episodic Memory for Continual Learning. NeurIPS 2017. Chaudhry,
Dokania, Ajanthan & Torr: Riemannian Walk for Incremental Learning. ECCV 2018. Riemer et al.:
Learning to Learn without Forgetting by Maximizing Transfer and Minimizing Interference. ICLR 2019.
Wolczyk, Zajac, Pascanu, Kucinski & Milos: Continual World. NeurIPS 2021.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from trl_suite.util import errors

LARGEST = 1e100  # score; sums and differences of larger ones may be infinite


def average_performance(scores: ArrayLike) -> float:
    """Mean score over all tasks after the last stage (Lopez-Paz & Ranzato 2017, ACC).

    All metrics of `scores` take them in this form and raise the same errors.

    Args:
      scores: R, (T, T); entries that a metric does not use may be NaN.

    Raises:
      ValueError: R is not square, has fewer than two tasks, or an entry that is used is not finite;
        or any entry is larger than `LARGEST`.
    """
    return _mean(_matrix(scores)[-1])


def learning_accuracy(scores: ArrayLike) -> float:
    """Mean score on each task directly after it was learnt (Riemer et al. 2019, LA).

    The mean over j of R[j, j].
    """
    return _mean(np.diag(_matrix(scores)))


def backward_transfer(scores: ArrayLike) -> float:
    """Effect of learning later tasks on earlier ones (Lopez-Paz & Ranzato 2017, BWT).

    Negative values mean forgetting. The mean over j < T - 1 of R[T-1, j] - R[j, j].
    """
    found = _matrix(scores)
    return _mean((found[-1] - np.diag(found))[:-1])


def forward_transfer(scores: ArrayLike, initial: ArrayLike) -> float:
    """Effect of earlier tasks on a task not yet learnt (Lopez-Paz & Ranzato 2017, FWT).

    The mean over j > 0 of R[j-1, j] - initial[j].

    Args:
      scores: R.
      initial: scores before any training, (T,).
    """
    found, begin = _matrix(scores), _numbers('initial', initial)
    if begin.shape != found.shape[:1]:
        raise ValueError(f'initial: shape is {begin.shape}; expected {found.shape[:1]}')
    return _mean(np.diag(found, 1)) - _mean(begin[1:], 'initial')


def forgetting(scores: ArrayLike) -> float:
    """Mean drop of the final score below the best earlier one (Chaudhry et al. 2018).

    The mean over j < T - 1 of (max over i < T - 1 of R[i, j]) - R[T-1, j]; usually >= 0.
    """
    found = _matrix(scores)
    return _mean((found[:-1].max(0) - found[-1])[:-1])


def metrics(scores: ArrayLike, initial: ArrayLike) -> dict[str, float]:
    """Returns by name all metrics that need no other run."""
    return {
        'average_performance': average_performance(scores),
        'learning_accuracy': learning_accuracy(scores),
        'forgetting': forgetting(scores),
        'backward_transfer': backward_transfer(scores),
        'forward_transfer': forward_transfer(scores, initial),
    }


def learning_transfer(curve: ArrayLike, reference: ArrayLike) -> float:
    """How much faster a task is learnt than in a reference run (Wolczyk et al. 2021, FT).

    (A - B) / (1 - B), where A is the mean of the learning curve and B that of the reference, both
    in shares of the maximum: 0 for no effect, 1 for the maximum from the first sample.

    Args:
      curve: scores during training, (k,), as in `result['curves']`; NaN and None are left out of
        both.
      reference: those of training from scratch, (k,).

    Raises:
      ValueError: a score is no number, the shapes differ, no point is in both, or the reference has
        the maximum throughout.
    """
    both = _numbers('curve', curve), _numbers('reference', reference)
    if both[0].shape != both[1].shape or both[0].ndim != 1:
        raise ValueError(f'curve: shape is {both[0].shape}; expected {both[1].shape}, (k,)')
    known = np.isfinite(both[0]) & np.isfinite(both[1])
    if not known.any():
        raise ValueError('curve: has no point in common with the reference')
    a, b = both[0][known].mean(), both[1][known].mean()
    if b >= 1:
        raise ValueError(f'reference: mean is {b}; expected less than 1')
    return float((a - b) / (1 - b))


def _matrix(scores: ArrayLike) -> np.ndarray:
    found = _numbers('scores', scores)
    if found.ndim != 2 or found.shape[0] != found.shape[1] or len(found) < 2:
        raise ValueError(f'scores: shape is {found.shape}; expected (T, T) with T >= 2')
    return found


def _numbers(name: str, values: ArrayLike) -> np.ndarray:
    return errors.floats(name, values, most=LARGEST, missing=True)


def _mean(values: np.ndarray, name: str = 'scores') -> float:
    if not np.isfinite(values).all():
        raise ValueError(f'{name}: the metric uses an entry that is not finite: {values.tolist()}')
    return float(values.mean())
