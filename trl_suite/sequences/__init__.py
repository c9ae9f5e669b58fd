"""Sequences of environments as a benchmark of multi-task and continual learning.

    from trl_suite import sequences

    sequence = sequences.get('plaid_biped')
    result = sequences.run(sequence, MyLearner(sequence, seed=0), path='result.json')
    print(result['metrics'])

or `trl-suite sequences run plaid_biped --learner my_module:MyLearner --output result.json`.

A learner is trained on the environments one after the other and is tested on all of them after
each. All environments of a sequence have the same observation and action spaces, so that one
network fits all of them.

`trl_suite.runs` defines learners, samples, seeds and result files.
"""

from trl_suite.sequences.catalogue import BENCHMARK, BUDGETS, SEEDS, SEQUENCES, Sequence
from trl_suite.sequences.metrics import (
    average_performance,
    backward_transfer,
    forgetting,
    forward_transfer,
    learning_accuracy,
    learning_transfer,
    metrics,
)

get, run, scores = BENCHMARK.get, BENCHMARK.run, BENCHMARK.scores
read, check, departures = BENCHMARK.read, BENCHMARK.check, BENCHMARK.departures

__all__ = [
    'BENCHMARK', 'BUDGETS', 'SEEDS', 'SEQUENCES', 'Sequence', 'average_performance',
    'backward_transfer', 'check', 'departures', 'forgetting', 'forward_transfer', 'get',
    'learning_accuracy', 'learning_transfer', 'metrics', 'read', 'run', 'scores',
]  # fmt: skip
