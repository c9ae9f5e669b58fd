"""Measures how a policy that was trained on few levels does on others, as Procgen does (Cobbe et al. 2020).

    python training/generalisation.py --output runs  # all, one after the other; continues after a stop

Writes the scores on the levels of training and on others to docs/benchmark/levels.json.
"""

import argparse
import dataclasses
import pathlib

from ppo_learner import SuitePPO

from trl_suite import benchmark, evaluation, policies
from trl_suite.runs import Course
from trl_suite.util import files
from trl_suite.util.program import begin_script

IDS = (
    'PD_Biped2D_Mixed_Terrain-v0', 'PD_Dog2D_Mixed_Terrain-v0', 'PD_Biped3D_Imitate-Stairs_Terrain-v0',
)  # fmt: skip
COUNTS = (1, 10, 100, 1000, 2**31)  # levels of training; the last is as good as no limit
OTHERS = (2**31, 2**31)  # levels of tests
EPISODES = 256
FILE = pathlib.Path(__file__).resolve().parents[1] / 'docs' / 'benchmark' / 'levels.json'
RUNS = dataclasses.replace(
    benchmark.BENCHMARK,
    format='trl_suite levels 1',
    courses={id_: Course(id_, (id_,), parts=20) for id_ in IDS},
    measured=lambda course, scores, initial: {'score': scores[-1][0]},
)


def measured(id_, count, seed, folder):
    """Trains a policy, and returns its scores on the levels of training and on others."""
    path = folder / f'{id_}_{count}_s{seed}.json'
    learner = SuitePPO(RUNS.get(id_), seed, task_kwargs={'levels': (0, count)})
    RUNS.run(id_, learner, benchmark.BUDGETS['1M'], path, seed=seed, num_threads=1)
    policy = policies.load(path.with_suffix('.npz'))
    results = [
        evaluation.evaluate(id_, policy, EPISODES, 0, 1, {'levels': levels})
        for levels in ((0, count), OTHERS)
    ]
    return [result['normalized_return'] for result in results]


def main():
    """Measures what levels.json lacks."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--output', type=pathlib.Path, required=True, help='folder of the runs')
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    found = files.read_json(FILE) if FILE.exists() else {}  # scores of the seeds 0, 1, ...
    for seed in benchmark.SEEDS:
        for id_ in IDS:
            for count in COUNTS:
                if len(found.get(id_, {}).get(str(count), [])) == seed:
                    result = measured(id_, count, seed, arguments.output)
                    with files.changing(FILE) as found:
                        scores = found.setdefault(id_, {}).setdefault(str(count), [])
                        if len(scores) == seed:  # else another process has measured it, too
                            scores.append(result)


if __name__ == '__main__':
    begin_script()
    main()
