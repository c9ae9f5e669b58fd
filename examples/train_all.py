"""Trains the reference policies of all environments, some with three seeds.

    python examples/train_all.py                       # all missing runs, two at a time
    python examples/train_all.py --filter '*Dog2D*' --jobs 8
    python examples/train_all.py --filter PD_Dog2D_Gaps_Terrain-v0 --overwrite
    python examples/train_all.py --filter FSM_Goat2D_Terrain_Cliffs-v0

Each run is `examples/ppo.py` on one thread, or for gait environments (FSM_...)
`examples/learn_gaits.py` or `examples/search_gaits.py`. Runs that start from the policy of another
environment are run after it. Interrupted runs continue from their checkpoints in RUNS. Finished
runs are evaluated and entered into `trained/ID.json` (settings, learning curve, evaluation), and
the best policy of an environment becomes `trained/ID.npz`. Runs that have been entered with the
same settings are not repeated. Five gait environments are trained; another one has to be selected
by its full id.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import dataclasses
import fnmatch
import json
import os
import pathlib
import platform
import shutil
import subprocess
import sys
import threading
from collections.abc import Collection, Iterable
from types import ModuleType
from typing import Any

import learn_gaits
import numpy as np
import ppo
import search_gaits
import tqdm

from trl_suite import evaluation, policies
from trl_suite.registry import catalogue
from trl_suite.util import errors, files, resources
from trl_suite.util.program import begin_script

EPISODES, SEED = 50, 0  # of the published evaluation
GAIT_EPISODES = 200  # the standard deviation of the distance before a fall is as large as its mean
SEEDS = (1,)
COMPARED_SEEDS = (1, 2, 3)  # where actuation models are compared
GAITS = (  # that are compared with their default gaits
    'FSM_Dog2D_Terrain_Mixed-v0', 'FSM_Raptor2D_Terrain_Mixed-v0',
    'FSM_Biped2D_Terrain_Gaps-v0', 'FSM_Hopper2D_Terrain_Gaps-v0',
)  # fmt: skip


LEARNT = ('FSM_Dog2D_Terrain_Mixed-v0', 'FSM_Raptor2D_Terrain_Mixed-v0')  # not searched


def compared(spec: catalogue.EnvSpec) -> bool:
    """Returns whether an environment is part of the comparison of actuation models."""
    return spec.domain == 'imitation' and 'planar' in spec.tags and '_Run_' not in spec.id


def jobs(pattern: str, only_seeds: Collection[int] = COMPARED_SEEDS) -> list[tuple[str, int]]:
    """Returns the runs to do: one per environment first, then further seeds."""
    ids = [
        id_
        for id_, spec in catalogue.BY_ID.items()
        if id_ == pattern
        or (fnmatch.fnmatchcase(id_, pattern) and (spec.actuation != 'gait' or id_ in GAITS))
    ]
    if not ids:
        raise ValueError(errors.unknown('environment', pattern, catalogue.BY_ID))
    seeds = {id_: COMPARED_SEEDS if compared(catalogue.BY_ID[id_]) else SEEDS for id_ in ids}
    found = [(id_, seed) for id_ in ids for seed in seeds[id_] if seed in only_seeds]
    return sorted(found, key=lambda job: (job[1], depth(job[0])))  # sorting is stable


def shipped(entry: dict[str, Any]) -> dict[str, Any]:
    """Returns the run of `trained/ID.json` whose policy is in `trained/ID.npz`."""
    return next(run for run in entry['runs'] if run['seed'] == entry['shipped'])


def program(id_: str) -> ModuleType:
    """Returns the program that trains an environment."""
    if catalogue.BY_ID[id_].actuation != 'gait':
        return ppo
    return learn_gaits if id_ in LEARNT else search_gaits


def start_of(id_: str) -> str | None:
    """Returns the initial policy of the training of an environment, if any."""
    return getattr(program(id_).settings_for(id_), 'start', None)


def depth(id_: str) -> int:
    """Returns the number of environments in which the initial policy was trained before."""
    start = start_of(id_)
    return 1 + depth(start) if start in catalogue.BY_ID else 0


def entries(id_: str) -> list[dict[str, Any]]:
    """Returns the runs that have been entered for an environment."""
    path = resources.directory('trained') / f'{id_}.json'
    if not path.exists():
        return []
    runs = json.loads(path.read_text())['runs']
    default = json.loads(json.dumps(dataclasses.asdict(program(id_).Settings())))
    for run in runs:  # settings added later have their defaults, removed ones are dropped
        own = run['settings']
        run['settings'] = {name: own.get(name, value) for name, value in default.items()}
    return runs


def settings(id_: str) -> dict[str, Any]:
    """Returns the settings of an environment as read from JSON."""
    return json.loads(json.dumps(dataclasses.asdict(program(id_).settings_for(id_))))


def train(id_: str, seed: int, runs: pathlib.Path) -> pathlib.Path:
    """Trains in a separate process; returns the folder of the run."""
    script = pathlib.Path(program(id_).__file__ or '')
    command = [sys.executable, script, id_, f'--seed={seed}', '--threads=1', f'--output={runs}']
    folder = runs / id_ / f'seed_{seed}'
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / 'log.txt', 'a') as log:
        subprocess.run(command, check=True, stdout=log, stderr=log)
    return folder


def trimmed(policy: policies.Policy) -> policies.Policy:
    """Returns the policy for a small file.

    Weights are rounded to half precision, and inputs that are always 0 are removed, for example the
    footstep of the stance foot.
    """
    if policy.convolution is not None:  # the inputs of a convolution cannot be removed
        line = policy.convolution
        line = dataclasses.replace(line, weights=_rounded(line.weights))
        return dataclasses.replace(policy, convolution=line, weights=_rounded(policy.weights))
    kept = (policy.mean != 0) | (policy.std > ppo.LEAST_STD)
    columns = np.arange(len(kept)) if policy.columns is None else policy.columns
    weights = (policy.weights[0][kept], *policy.weights[1:])
    return dataclasses.replace(
        policy, columns=columns[kept], mean=policy.mean[kept], std=policy.std[kept],
        weights=_rounded(weights),
    )  # fmt: skip


def _rounded(weights: Iterable[np.ndarray]) -> tuple[np.ndarray, ...]:
    return tuple(w.astype(np.float16).astype(w.dtype) for w in weights)


def enter(id_: str, seed: int, folder: pathlib.Path, machine: str) -> dict[str, Any]:
    """Evaluates a finished run and enters it into the file of its environment."""
    curve = json.loads((folder / 'curve.json').read_text())
    # With curriculum stages the last policy is used, because the curve does not measure all skills.
    name = 'last' if curve['settings'].get('stages') else 'policy'
    policy = trimmed(policies.load(folder / f'{name}.npz'))
    episodes = GAIT_EPISODES if catalogue.BY_ID[id_].actuation == 'gait' else EPISODES
    found = evaluation.evaluate(id_, policy, episodes, SEED, num_threads=1)
    run = {**curve, 'machine': machine, 'shipped_at': policy.info['samples'], 'evaluation': found}
    others = [r for r in entries(id_) if r['seed'] != seed and r['settings'] == run['settings']]
    every = sorted([run, *others], key=lambda r: r['seed'])
    best = max(every, key=lambda r: r['evaluation']['return'])
    trained = resources.directory('trained')
    if best is run:
        policies.save(policy, trained / f'{id_}.npz')
    with files.replacing(trained / f'{id_}.json') as part:
        part.write_text(json.dumps({'id': id_, 'shipped': best['seed'], 'runs': every}) + '\n')
    return run


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--filter', default='*', metavar='PATTERN', help='of ids')
    parser.add_argument('--seeds', type=int, nargs='+', default=COMPARED_SEEDS, help='only these')
    parser.add_argument('--jobs', type=int, default=2, help='number of runs at a time')
    parser.add_argument('--runs', type=pathlib.Path, default=pathlib.Path('runs'))
    parser.add_argument(
        '--overwrite', action='store_true', help='repeat runs that have been entered'
    )
    parser.add_argument(
        '--machine',
        default=f'{os.cpu_count()} cores, {platform.machine()}, {platform.system()}',
        help='description of this machine in the results',
    )
    arguments = parser.parse_args()
    todo = []
    for id_, seed in jobs(arguments.filter, arguments.seeds):
        entered = any(r['seed'] == seed and r['settings'] == settings(id_) for r in entries(id_))
        if arguments.overwrite:
            shutil.rmtree(arguments.runs / id_ / f'seed_{seed}', ignore_errors=True)
        if arguments.overwrite or not entered:
            todo.append((id_, seed))
    entering = threading.Lock()  # two seeds of one environment

    def work(id_: str, seed: int, before: list[concurrent.futures.Future]) -> dict[str, Any]:
        concurrent.futures.wait(before)
        folder = train(id_, seed, arguments.runs)
        with entering:
            return enter(id_, seed, folder, arguments.machine)

    with (
        concurrent.futures.ThreadPoolExecutor(arguments.jobs) as pool,
        tqdm.tqdm(total=len(todo), unit='run') as bar,
    ):
        running: dict[concurrent.futures.Future, tuple[str, int]] = {}
        for job in todo:  # each waits only for runs that were submitted before
            start = start_of(job[0])
            before = [future for future, (id_, _) in running.items() if id_ == start]
            running[pool.submit(work, *job, before)] = job
        for done in concurrent.futures.as_completed(running):
            id_, seed = running[done]
            try:
                run = done.result()
            except (subprocess.CalledProcessError, OSError, ValueError) as error:
                bar.write(f'{id_} seed {seed}: {error}')  # the others go on
            else:
                found = run['evaluation']
                bar.write(
                    f'{id_} seed {seed}: {found["normalized_return"]:.3f} of the maximum, '
                    f'{found["completion_rate"]:.0%} complete'
                )
            bar.update()


if __name__ == '__main__':
    begin_script()
    main()
