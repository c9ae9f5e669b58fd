"""Trains the reference policies of all environments, some with three seeds.

    python training/train_all.py                       # all missing runs, two at a time
    python training/train_all.py --filter '*Dog2D*' --jobs 8
    python training/train_all.py --filter PD_Dog2D_Gaps_Terrain-v0 --overwrite
    python training/train_all.py --filter FSM_Goat2D_Terrain_Cliffs-v0
    python training/train_all.py --ray                 # on all cores, or on those of a cluster

Each run is `ppo.py` on one thread, or for most gait environments (FSM_...) `learn_gaits.py` or
`refine_gaits.py`. A run that uses the policy of another environment, as initial policy or as footstep
controller, starts after the runs of that environment. Interrupted runs continue from their checkpoints in RUNS. Finished runs are evaluated and entered
into `trained/ID.json` (settings, learning curve, evaluation), and the best policy of an environment
becomes `trained/ID.npz`. Runs that have been entered with the same settings are not repeated.
The environment variable TRL_SUITE_TRAINED selects another folder than `trained`. By default
the gait environments in `GAITS` are trained; others must be selected by their full ids.

With `--ray` each run is a task of Ray (`docs/cluster.md`) and gives the same numbers. RUNS is then
a folder or a URL that all machines reach; a run whose machine is lost continues on another one.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import contextlib
import dataclasses
import fnmatch
import json
import os
import pathlib
import platform
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Collection, Sequence
from types import ModuleType
from typing import IO, Any, NamedTuple

import learn_gaits
import ppo
import refine_gaits
import runs
import tqdm
from networks import trimmed
from settings import EVERY_PARAMETER

from trl_suite import evaluation, policies
from trl_suite.registry import catalogue
from trl_suite.tasks.task_type import TASK_TYPES
from trl_suite.util import errors, files
from trl_suite.util.digest import digest
from trl_suite.util.options import checked
from trl_suite.util.program import begin_script

EPISODES, SEED = 50, runs.TEST_SEED  # of the published evaluation
# Of its repetition in episodes that had no part in the choice of a policy; no run has these.
OTHER_SEED = runs.EVALUATION_SEED + 3
GAIT_EPISODES = 200  # the standard deviation of the distance before a fall is as large as its mean
SEEDS = (1,)
COMPARED_SEEDS = (1, 2, 3)  # where actuation models are compared
ROW = '{:40} {:>4}  {:20} {:>7} {:>6} {:>8}'  # a row of the table of runs
MEMORY = 1.5e9  # bytes of memory that Ray reserves for a run
GAITS = (  # gait environments that are trained by default
    *(f'FSM_Dog2D_Terrain_{name}-v0' for name in ('Mixed', 'Cliffs', 'Slopes_Mixed', 'Stairs_Rugged')),
    *(f'FSM_Raptor2D_Terrain_{name}-v0' for name in ('Mixed', 'Slopes_Mixed', 'Narrow_Gaps')),
    *(f'FSM_Goat2D_Terrain_{name}-v0' for name in ('Cliffs', 'Variable_Steps')),
    'FSM_Biped2D_Terrain_Slopes_Mixed-v0', 'FSM_Hopper2D_Terrain_Mixed-v0', *EVERY_PARAMETER,
)  # fmt: skip


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
    if catalogue.BY_ID[id_].actuation != 'gait' or id_ in EVERY_PARAMETER:
        return ppo
    return refine_gaits if id_ in refine_gaits.OVERRIDES else learn_gaits


def start_of(id_: str) -> str | None:
    """Returns the initial policy of the training of an environment, if any."""
    own = program(id_).settings_for(id_)
    return getattr(own, 'start', '') or getattr(getattr(own, 'first', own), 'start', None)


def episodes_of(id_: str) -> int:
    """Returns the number of episodes in which the policies of an environment are evaluated."""
    return GAIT_EPISODES if catalogue.BY_ID[id_].actuation == 'gait' else EPISODES


def needed(id_: str) -> list[str]:
    """Returns the environments whose policies a run uses: at its start, by teachers, as controller."""
    spec = catalogue.BY_ID[id_]
    default = getattr(TASK_TYPES[spec.task_type].config(), 'controller', None)
    start = start_of(id_)
    found = (start, spec.options.get('controller', default), *ppo.USED.get(start, ()))
    return [other for other in found if other in catalogue.BY_ID]


def depth(id_: str) -> int:
    """Returns the length of the longest chain of environments that must be trained before this one."""
    return max((1 + depth(other) for other in needed(id_)), default=0)


def entries(id_: str) -> list[dict[str, Any]]:
    """Returns the runs that have been entered for an environment."""
    found = runs.read(f'{id_}.json').get('runs', [])
    default = json.loads(json.dumps(dataclasses.asdict(program(id_).Settings())))
    for run in found:  # new settings get their defaults, removed ones are dropped
        run['settings'] = own = {
            name: run['settings'].get(name, value) for name, value in default.items()
        }
        if 'first' in default:
            first = default['first'].items()
            own['first'] = {name: own['first'].get(name, value) for name, value in first}
    return found


def changes(samples: float | None) -> dict[str, float]:
    """Returns the settings that an option `--samples` changes."""
    return {} if samples is None else {'samples': samples}


def settings(id_: str, samples: float | None = None) -> dict[str, Any]:
    """Returns the settings of an environment as read from JSON."""
    own = program(id_).settings_for(id_, **changes(samples))
    return json.loads(json.dumps(dataclasses.asdict(own)))


class Run(NamedTuple):
    """A run that is finished.

    Attributes:
      entry: settings, learning curve and evaluation, for `trained/ID.json`.
      policy: its policy, for `trained/ID.npz`.
      host: name of the machine.
      seconds: duration of training and evaluation, s; without earlier attempts.
    """

    entry: dict[str, Any]
    policy: policies.Policy
    host: str
    seconds: float


class Children:
    """The processes that train; `stop` ends them, and no further ones are started."""

    def __init__(self) -> None:
        self._running: set[subprocess.Popen] = set()
        self._stopped, self._lock = False, threading.Lock()

    def run(self, command: Sequence[Any], log: IO[str]) -> int:
        """Runs a command; returns its exit status."""
        with self._lock:
            if self._stopped:
                raise RuntimeError('not trained, since the program was stopped')
            child = subprocess.Popen(command, stdout=log, stderr=log)
            self._running.add(child)
        status = child.wait()
        with self._lock:
            self._running.remove(child)
        return status

    def stop(self) -> None:
        with self._lock:
            self._stopped = True
            for child in self._running:
                child.terminate()


def train(
    id_: str, seed: int, output: pathlib.Path, samples: float | None, machine: str,
    children: Children,
) -> Run:  # fmt: skip
    """Trains in a separate process, and evaluates."""
    begin = time.monotonic()
    script = pathlib.Path(program(id_).__file__ or '')
    command = [sys.executable, script, id_, f'--seed={seed}', '--threads=1', f'--output={output}']
    if samples is not None:
        command.append(f'--samples={samples}')
    folder = output / id_ / f'seed_{seed}'
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / 'log.txt', 'a') as log:
        status = children.run(command, log)
    if status:
        *_, last = (folder / 'log.txt').read_text().split('\n')[:-1] or ['']
        raise RuntimeError(f'{script.name} ended with status {status}: {last}')
    return measured(id_, folder, machine, begin)


def train_here(
    id_: str, seed: int, settings: Any, url: str, given: dict[str, bytes], machine: str
) -> Run:
    """Trains in this process, one of Ray's, from the checkpoint in a store; and evaluates.

    Args:
      id_: the environment.
      seed: the seed.
      settings: the settings.
      url: folder or URL where the files of the run are kept.
      given: files of the folder `trained` that the run reads.
      machine: description of the machine, for the results; '' for that of this one.
    """
    import storage  # needs fsspec

    begin = time.monotonic()
    with tempfile.TemporaryDirectory() as scratch:
        folder, trained = (pathlib.Path(scratch, name) for name in ('run', 'trained'))
        for each in (folder, trained):
            each.mkdir()
        for name, content in given.items():
            (trained / name).write_bytes(content)
        os.environ['TRL_SUITE_TRAINED'] = str(trained)
        with (
            storage.kept(folder, url),
            open(folder / 'log.txt', 'a') as log,
            contextlib.redirect_stdout(log),
            contextlib.redirect_stderr(log),
        ):
            how = 'continues' if any(folder.rglob(storage.CHECKPOINT)) else 'begins'
            print(f'{time.asctime()}: {how} on {platform.node()}', flush=True)
            program(id_).train(id_, seed, settings, folder, threads=1)
        return measured(id_, folder, machine, begin)


def given(id_: str) -> dict[str, bytes]:
    """Returns the files of `trained` that a run reads, for `train_here`."""
    shipped = policies.available()
    used = {other: policies.trained_for(other) for other in (*needed(id_), id_) if other in shipped}
    found = {f'{other}.npz': runs.place(f'{other}.npz').read_bytes() for other in used.values()}
    shared = {
        id_: {'policy': other, 'preference': policies.preference_for(id_)}
        for id_, other in used.items()
        if id_ != other
    }
    return {**found, policies.SHARED: json.dumps(shared).encode()}


def measured(id_: str, folder: pathlib.Path, machine: str, begin: float) -> Run:
    """Evaluates a run; `begin` is the time of `time.monotonic` at its start."""
    curve = files.read_json(folder / 'curve.json')
    settings = curve['settings']
    # The last policy is used with curriculum stages, because the curve does not measure all skills,
    # and if it only imitates, because it has learnt from the most data.
    own = {**settings, **(settings.get('further') or [{}])[-1]}  # of the last run
    imitates = own.get('cloned', 0) >= own['samples']
    name = 'last' if own.get('stages') or imitates else 'policy'
    policy = trimmed(policies.load(folder / f'{name}.npz'))
    found = evaluation.evaluate(id_, policy, episodes_of(id_), SEED, num_threads=1)
    entry = {
        **curve,
        'machine': machine or runs.machine(),
        'shipped_at': policy.info['samples'],
        'evaluation': found,
    }
    return Run(entry, policy, platform.node(), time.monotonic() - begin)


def enter(id_: str, seed: int, run: Run, overwrite: bool = False) -> None:
    """Enters a run into the file of its environment, and ships its policy if it is the best.

    A run with other settings than those that are entered replaces them, if its score is higher or with
    `overwrite`.

    The best one, of seeds and of settings, is chosen in the episodes of `evaluation`; a mean over seeds
    is not affected by the choice, but the evaluation of the chosen one is, so it is evaluated once
    more in episodes that had no part in it.
    """
    own, score = run.entry, TASK_TYPES[catalogue.BY_ID[id_].task_type].score
    path = runs.place(f'{id_}.npz')
    with runs.changing(f'{id_}.json') as stored:
        before = entries(id_)
        others = [r for r in before if r['settings'] == own['settings']]
        found = own['evaluation'][score]
        most = max((r['evaluation'][score] for r in before), default=found)
        if not (others or overwrite) and most > found:
            print(
                f'{id_}: not entered, since {score} is {found:.3f}, and {most:.3f} with the shipped policy'
            )
            return
        every = sorted([own, *(r for r in others if r['seed'] != seed)], key=lambda r: r['seed'])
        best = max(every, key=lambda r: r['evaluation'][score])
        if best is not own and stored.get('shipped') == seed:
            every, best = [own], own  # the policy that is replaced is the only one that is stored
        policy = run.policy if best is own else policies.load(path)
        again = evaluation.evaluate(id_, policy, episodes_of(id_), OTHER_SEED, num_threads=1)
        stored.clear()
        stored.update({
            'id': id_, 'shipped': best['seed'], 'of': digest(policy), 'runs': every,
            'shipped_again': again,
        })  # fmt: skip
        if best is own:  # last, since both files are written together
            policies.save(policy, path)
    with runs.changing(policies.SHARED) as used:
        if id_ in used and used[id_]['evaluation'][score] < best['evaluation'][score]:
            del used[id_]  # the policy of another environment, which `share_gaits.py` has entered


def on_ray(
    arguments: argparse.Namespace, executor: evaluation.Executor
) -> Callable[[str, int], Run]:
    """Returns a function that trains by a task of Ray."""
    import storage

    url = storage.absolute(arguments.runs)

    def work(id_: str, seed: int) -> Run:
        place = f'{url}/{id_}/seed_{seed}'
        if arguments.overwrite:
            storage.remove(place)
        own = program(id_).settings_for(id_, **changes(arguments.samples))
        values = id_, seed, own, place, given(id_), arguments.machine
        [run] = executor.map(train_here, *([value] for value in values))
        return run

    return work


def in_processes(arguments: argparse.Namespace, children: Children) -> Callable[[str, int], Run]:
    """Returns a function that trains in a process of this machine."""

    def work(id_: str, seed: int) -> Run:
        output = pathlib.Path(arguments.runs)
        folder = output / id_ / f'seed_{seed}'
        if arguments.overwrite:
            runs.remove(folder)
        return train(id_, seed, output, arguments.samples, arguments.machine, children)

    return work


def parsed(words: Sequence[str] | None) -> argparse.Namespace:
    """Parses the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--filter', default='*', metavar='PATTERN', help='of ids')
    parser.add_argument('--seeds', type=int, nargs='+', default=COMPARED_SEEDS, help='only these')
    parser.add_argument('--jobs', type=int, default=2, help='number of runs at a time, without Ray')
    parser.add_argument('--runs', default='runs', help='folder; with Ray also a URL of fsspec')
    parser.add_argument('--samples', type=float, help='of every run, instead of its own setting')
    parser.add_argument(
        '--overwrite', action='store_true', help='repeat runs that have been entered'
    )
    parser.add_argument('--ray', action='store_true', help='train by tasks of Ray')
    parser.add_argument(
        '--address', help="of Ray: 'auto', or HOST:PORT; default: this machine's cluster, or itself"
    )
    parser.add_argument('--machine', default='', help='description of the machine in the results')
    chosen = parser.parse_args(words)
    checked('--jobs', chosen.jobs, int, at_least=1)
    checked('--samples', chosen.samples, float | None, above=0)
    for seed in chosen.seeds:
        errors.check_known('seed of the runs', map(str, COMPARED_SEEDS), str(seed))
    if chosen.address and not chosen.ray:
        raise ValueError(f'--address is {chosen.address!r}; expected --ray with it')
    if '://' in chosen.runs and not chosen.ray:
        raise ValueError(f'--runs is {chosen.runs!r}; expected a folder, or a URL with --ray')
    return chosen


def main(words: Sequence[str] | None = None) -> None:
    arguments = parsed(words)
    todo = []
    for id_, seed in jobs(arguments.filter, arguments.seeds):
        own = settings(id_, arguments.samples)
        entered = any(r['seed'] == seed and r['settings'] == own for r in entries(id_))
        if arguments.overwrite or not entered:
            todo.append((id_, seed))
    # Two seeds of one environment write the same file, which is not locked on all systems.
    entering = {id_: threading.Lock() for id_, _ in todo}
    failed = 0
    with contextlib.ExitStack() as stack:
        if arguments.ray:
            from trl_suite.adapters.ray import RayExecutor

            executor = stack.enter_context(
                RayExecutor(arguments.address, num_cpus=1, memory=int(MEMORY), fresh=True)
            )
            done_by, stop = on_ray(arguments, executor), executor.cancel
        else:
            children = Children()
            done_by, stop = in_processes(arguments, children), children.stop
        # Ray decides how many runs there are at a time.
        number = max(len(todo), 1) if arguments.ray else arguments.jobs
        pool = stack.enter_context(concurrent.futures.ThreadPoolExecutor(number))
        # After an interrupt, before the pool waits for its threads.
        stack.callback(stop)
        stack.callback(pool.shutdown, wait=False, cancel_futures=True)
        bar = stack.enter_context(tqdm.tqdm(total=len(todo), unit='run'))

        def work(id_: str, seed: int, before: list[concurrent.futures.Future]) -> Run:
            concurrent.futures.wait(before)
            if any(future.exception() for future in before):
                raise RuntimeError('not trained, since a run failed whose policy it uses')
            run = done_by(id_, seed)
            with entering[id_]:
                enter(id_, seed, run, arguments.overwrite)
            return run

        running: dict[concurrent.futures.Future, tuple[str, int]] = {}
        for job in todo:  # each waits only for runs that were submitted before
            others = needed(job[0])
            before = [future for future, (id_, _) in running.items() if id_ in others]
            running[pool.submit(work, *job, before)] = job
        bar.write(ROW.format('environment', 'seed', 'machine', 'minutes', 'return', 'complete'))
        for done in concurrent.futures.as_completed(running):
            id_, seed = running[done]
            try:
                run = done.result()
            except Exception as error:  # the other runs continue
                failed += 1
                bar.write(f'{id_:40} {seed:4}  {type(error).__name__}: {error}')
            else:
                found = run.entry['evaluation']
                values = f'{found["normalized_return"]:.3f}', f'{found["completion_rate"]:.0%}'
                bar.write(ROW.format(id_, seed, run.host, f'{run.seconds / 60:.1f}', *values))
            bar.update()
    if failed:
        raise RuntimeError(f'{failed} of {len(todo)} runs failed')


if __name__ == '__main__':
    begin_script()
    main()
