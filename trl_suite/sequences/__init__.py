"""Sequences of environments as a benchmark of multi-task and continual learning.

    from trl_suite import sequences

    sequence = sequences.get('plaid_biped')
    result = sequences.run(sequence, MyLearner(sequence, seed=0), path='result.json')
    print(result['metrics'])

or `trl-suite sequences run plaid_biped --learner my_module:MyLearner --output result.json`.

A learner is trained on the environments one after the other and is tested on all of them after
each. All environments of a sequence have the same observation and action spaces, so that one
network fits all of them.

A sample is one control step of one simulation in training; resets and tests are free. A learner
gets its simulations from a `Stage`, which counts samples, refuses a step that would exceed the
budget, and seeds them with training seeds. Seeds below 2**31 are for training, the others, below
2**32, for tests: `train_seeds` and `test_seeds` never overlap.
"""

from trl_suite.sequences.catalogue import (
    BUDGETS,
    EPISODES,
    FIRST_TEST_SEED,
    SEEDS,
    SEQUENCES,
    Sequence,
    get,
    test_seeds,
    train_seeds,
)
from trl_suite.sequences.metrics import (
    average_performance,
    backward_transfer,
    forgetting,
    forward_transfer,
    learning_accuracy,
    learning_transfer,
    metrics,
)
from trl_suite.sequences.results import check, departures, read
from trl_suite.sequences.running import Learner, Resumable, run, scores
from trl_suite.sequences.stage import BudgetExceededError, Stage

__all__ = [
    'BUDGETS', 'EPISODES', 'FIRST_TEST_SEED', 'SEEDS', 'SEQUENCES', 'BudgetExceededError', 'Learner',
    'Resumable', 'Sequence', 'Stage', 'average_performance', 'backward_transfer', 'check',
    'departures', 'forgetting', 'forward_transfer', 'get', 'learning_accuracy', 'learning_transfer',
    'metrics', 'read', 'run', 'scores', 'test_seeds', 'train_seeds',
]  # fmt: skip
