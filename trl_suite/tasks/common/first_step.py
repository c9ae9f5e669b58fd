"""The single step from which the episodes of a task with footstep plans start."""

from __future__ import annotations

import numpy as np

from trl_suite.motion import FootstepLibrary

TYPICAL_POSES = 31  # poses of a step; their mean is action 0 of position control


def straight_step(steps: FootstepLibrary, length: float) -> int:
    """Returns the straight step of a library whose length is nearest to `length`, m."""
    straight = np.abs(steps.labels[:, 2]) + np.abs(steps.labels - steps.previous).sum(1)
    return int(np.lexsort((np.abs(steps.labels[:, 0] - length), straight))[0])


def pose_of_step(
    steps: FootstepLibrary, step: int, phase: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns poses with x = y = 0, and rates, at phases (m,) of a step and its mirror image."""
    times = (2 * phase - np.floor(2 * phase)) * steps.duration
    poses, rates = (part(step, times, phase >= 0.5) for part in (steps.pose, steps.velocity))
    poses[:, :2] = 0.0
    return poses, rates


def typical_poses(steps: FootstepLibrary, step: int) -> np.ndarray:
    """Returns poses of a step whose mean is action 0, (k, columns of a pose)."""
    return steps.pose(step, np.linspace(0, steps.duration, TYPICAL_POSES))
