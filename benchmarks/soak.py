"""Runs environments for a long time with extreme actions, and accumulates what happened.

    python benchmarks/soak.py --seconds 3600
    python benchmarks/soak.py --show

Environments of all ids are run one after the other, in an order that a seed decides, each with actions
of four kinds: uniform noise, extremes that change in every step, extremes that are held for up to 50
steps, and numbers of up to 1e300, which are clipped. Observations, rewards and the states of the
physics are tested for NaN and infinity after every step. Control steps are those of 1/30 s, in gaits of
1/600 s: a gait cycle or a footstep has many of them. The resident memory is noted after each
environment is closed.

The figures of all runs are accumulated in one file, written after each environment: a later run
continues it, with a new seed. An environment that returned a number that is not finite is named with
its seed, and the run goes on.
"""

import argparse
import ctypes
import gc
import importlib.metadata
import os
import pathlib
import resource
import time

import numpy as np
from tqdm import tqdm

from trl_suite import suite
from trl_suite.tasks.task_type import TASK_TYPES
from trl_suite.util import files, program
from trl_suite.vector import VectorEnvironment

FILE = pathlib.Path(__file__).resolve().parents[1] / 'docs' / 'data' / 'soak.json'
NEW = {'task_types': {}, 'not_finite': [], 'runs': []}  # figures
KINDS = ('uniform', 'changing', 'held', 'huge')
SPECS = (
    *(suite.find(id_) for id_ in suite.ALL_IDS),
    suite.combine('dog', task='walk'),  # task types without an id
    suite.combine('biped3d', task='walk'),
)


def actions(random, shape):
    """Yields actions of each kind in turn, 50 steps each."""
    while True:
        for kind in KINDS:
            held, left = None, 0
            for _ in range(50):
                if kind == 'uniform':
                    yield random.uniform(-1, 1, shape)
                elif kind == 'huge':
                    yield random.choice((-1.0, 1.0), shape) * 10 ** random.uniform(-3, 300, shape)
                else:
                    if kind == 'changing' or not left:
                        held, left = random.choice((-1.0, 1.0), shape), random.integers(1, 51)
                    left -= 1
                    yield held


def order(random):
    """Yields numbers of environments without end, all in each round."""
    while True:
        yield from random.permutation(len(SPECS))


def resident_mb():
    """Returns the memory of this process in MB, after returning what is free."""
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    with open('/proc/self/statm') as file:
        return int(file.read().split()[1]) * resource.getpagesize() / 1e6


def soak(spec, seconds, num_envs, threads, seed):
    """Runs one environment for a time; returns its figures."""
    environments = VectorEnvironment(spec, num_envs, threads, seed=seed)
    world = environments.task.world
    random = np.random.default_rng(seed)
    found = {
        'steps': 0,
        'control_steps': 0,
        'episodes': 0,
        'diverged': 0,
        'not_finite': 0,
        'largest': 0.0,
    }
    environments.reset()
    control = world.engine.timestep * environments.task.steps_per_call  # s
    chosen, end = actions(random, (num_envs, len(environments.action_map))), None
    while end is None or time.monotonic() < end:
        before = world.time[:num_envs].copy()
        step = environments.step(next(chosen))
        passed = world.time[:num_envs] - before
        passed[passed < 0] = 0.0  # a reset
        end = end or time.monotonic() + seconds  # the first step may have to compile
        observation = step.observation
        good = np.isfinite(observation).all(1) & np.isfinite(step.reward)
        for state in (world.qpos, world.qvel):
            # The state of a simulation that diverged is replaced at its next reset.
            good &= np.isfinite(state[:num_envs]).all(1) | step.info['diverged']
        found['steps'] += num_envs
        found['control_steps'] += round(passed.sum() / control)
        found['episodes'] += int((step.terminated | step.truncated).sum())
        found['diverged'] += int((step.info['diverged'] & step.terminated).sum())
        found['not_finite'] += int((~good).sum())
        found['largest'] = max(found['largest'], float(np.abs(observation[good]).max(initial=0)))
    environments.close()
    return found


def merged(total, found):
    """Returns the sum of figures; of the largest observations, the maximum."""
    if not total:
        return dict(found)
    most = max(total['largest'], found['largest'])
    return {**{name: total[name] + found[name] for name in found}, 'largest': most}


def show(figures):
    names = [name for name in TASK_TYPES if name in figures['task_types']]
    for name in names:
        found = figures['task_types'][name]
        print(
            f'{name:20} {found["control_steps"]:>12,} control steps {found["episodes"]:>10,} episodes '
            f'{found["diverged"]:>6} diverged {found["not_finite"]:>4} not finite, largest '
            f'{found["largest"]:.3g}'
        )
    for unit in ('control_steps', 'steps'):
        total = sum(figures['task_types'][name][unit] for name in names)
        print(f'all: {total:,} {unit.replace("_", " ")}')
    for run in figures['runs']:
        memory = [mb for _, _, mb in run['memory']] or [0.0]
        print(
            f'seed {run["seed"]}: {run["environments"]} environments in {run["seconds"] / 3600:.2f} h, '
            f'memory {memory[0]} MB after the first, {memory[-1]} after the last, at most {max(memory)}'
        )
    for each in figures['not_finite']:
        print(f'NOT FINITE: {each}')


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--seconds', type=float, default=600.0, help='of this run')
    parser.add_argument('--each', type=float, default=20.0, help='seconds of each environment')
    parser.add_argument('--num-envs', type=int, default=64)
    parser.add_argument('--threads', type=int, default=1)
    parser.add_argument('--seed', type=int, help='by default, one that no earlier run had')
    parser.add_argument('--file', type=pathlib.Path, default=FILE, help='accumulated figures')
    parser.add_argument('--show', action='store_true', help='print the figures, and run nothing')
    arguments = parser.parse_args()
    path = files.check_path(arguments.file, ('.json',))
    if arguments.show:
        show(files.read_json(path) if path.exists() else NEW)
        return
    begin = time.time()
    run = {
        'seed': arguments.seed, 'date': time.strftime('%Y-%m-%d', time.gmtime(begin)), 'seconds': 0.0,
        'environments': 0, 'num_envs': arguments.num_envs, 'threads': arguments.threads,
        'versions': {name: importlib.metadata.version(name) for name in ('trl_suite', 'mujoco')},
        'memory': [],  # environments closed, control steps, and MB
    }  # fmt: skip
    with files.changing(path, NEW, indent=None) as figures:  # no other run gets the seed
        place = len(figures['runs'])
        if arguments.seed is None:
            run['seed'] = max((each['seed'] for each in figures['runs']), default=-1) + 1
        figures['runs'].append(run)
    seed = run['seed']
    random = np.random.default_rng(seed)
    steps, bar = 0, tqdm(total=round(arguments.seconds), unit='s', mininterval=10)
    for i in order(random):
        spec, own = SPECS[i], int(random.integers(2**32))
        found = soak(spec, arguments.each, arguments.num_envs, arguments.threads, own)
        steps += found['control_steps']
        run['seconds'] = round(time.time() - begin, 1)
        run['environments'] += 1
        run['memory'].append([run['environments'], steps, round(resident_mb(), 1)])
        with files.changing(path, NEW, indent=None) as figures:
            if found['not_finite']:
                figures['not_finite'].append({'id': spec.id, 'seed': own, 'run': seed, **found})
            types = figures['task_types']
            types[spec.task_type] = merged(types.get(spec.task_type), found)
            figures['runs'][place] = run
        bar.set_postfix_str(f'{steps / 1e6:.2f} M control steps, {run["memory"][-1][2]} MB')
        bar.update(min(round(run['seconds']), bar.total) - bar.n)
        if time.time() >= begin + arguments.seconds:
            break
    bar.close()
    show(figures)


if __name__ == '__main__':
    os.environ.setdefault('MUJOCO_GL', 'disable')
    program.begin_script()
    main()
