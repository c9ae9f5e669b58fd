"""Measures the scores that are 0 and 1 on the benchmark's scale: trl_suite/benchmark/scales.json.

    python benchmarks/core_scales.py [ID ...] [--episodes N]

Episodes have seeds that no run uses. A row names what its numbers depend on, the digest of the shipped
policy included, and stays as it is when that policy is replaced: another number needs another version of
the format of results, in trl_suite/benchmark/core.py.
"""

from __future__ import annotations

import argparse

from trl_suite import evaluation, policies, runs
from trl_suite.benchmark import core
from trl_suite.environments import named_policies
from trl_suite.util import files, machine
from trl_suite.util.digest import digest
from trl_suite.util.program import begin_script

SEED = 1_000_000  # of test seeds; runs have smaller ones


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('ids', nargs='*', default=list(core.CORE), metavar='ID')
    parser.add_argument('--episodes', type=int, default=256)
    arguments = parser.parse_args()
    for id in arguments.ids:
        course = core.BENCHMARK.get(id)
        row = {
            'episodes': arguments.episodes, **machine.made_with(),
            'policy': digest(policies.reference(id)),
        }  # fmt: skip
        for name in ('zero', 'random', 'shipped'):
            baseline = named_policies.BASELINES.get(name)
            result = evaluation.evaluate(
                course.spec(id), baseline or policies.reference(id), arguments.episodes,
                runs.test_seeds(arguments.episodes, SEED), factory=baseline is not None,
            )  # fmt: skip
            row[name] = round(result['normalized_return'], 4)
            half = result['return_interval'] / result['step_limit']
            print(f'{id} {name} {row[name]} +- {half:.4f}', flush=True)
        with files.changing(core.SCALES) as found:  # other processes may write other rows
            scores = {**found.get('scores', {}), id: row}
            order = {id: scores[id] for id in core.CORE if id in scores}
            found |= {'format': core.BENCHMARK.format, 'scores': order}


if __name__ == '__main__':
    begin_script()
    main()
