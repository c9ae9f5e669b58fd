"""Runs of learners: stages, tests, result files, and the seeds with which these are comparable.

`trl_suite.sequences` and `trl_suite.benchmark` are two `Benchmark`s, which consist of `Course`s. A
learner is trained in stages and is tested before the first and after each. The state of a learner
that has `save` and `load` is written after every stage, so that a killed run continues with
identical results.

A sample is one control step of one simulation in training (of a gait: one cycle); resets and tests
are free. A learner gets its simulations from a `Stage`, which counts samples, refuses a step that
would exceed the budget, and seeds them with training seeds. Seeds below 2**31 are for training, the
others, below 2**32, for tests: `train_seeds` and `test_seeds` never overlap.
"""

from trl_suite.runs.course import EPISODES, FIRST_TEST_SEED, Course, test_seeds, train_seeds
from trl_suite.runs.running import Benchmark, Learner, Resumable
from trl_suite.runs.stage import BudgetExceededError, Stage

__all__ = [
    'EPISODES', 'FIRST_TEST_SEED', 'Benchmark', 'BudgetExceededError', 'Course', 'Learner',
    'Resumable', 'Stage', 'test_seeds', 'train_seeds',
]  # fmt: skip
