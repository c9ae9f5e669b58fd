"""The benchmark: twelve environments, fixed budgets and seeds, and scores that can be measured again.

    from trl_suite import benchmark

    learner = MyLearner(benchmark.get('PD_Biped2D_Gaps_Terrain-v0'), seed=0)
    result = benchmark.run('PD_Biped2D_Gaps_Terrain-v0', learner, path='result.json')
    print(result['metrics']['score'])

or `trl-suite benchmark run --learner my_module:MyLearner`. `trl_suite.runs` defines learners,
samples, seeds and result files.
"""

from trl_suite.benchmark.core import BENCHMARK, BUDGETS, CORE, SEEDS, ends, normalised, scales

get, run, scores = BENCHMARK.get, BENCHMARK.run, BENCHMARK.scores
read, check, departures = BENCHMARK.read, BENCHMARK.check, BENCHMARK.departures
verify = BENCHMARK.verify

__all__ = [
    'BENCHMARK', 'BUDGETS', 'CORE', 'SEEDS', 'check', 'departures', 'ends', 'get', 'normalised', 'read',
    'run', 'scales', 'scores', 'verify',
]  # fmt: skip
