"""Measures training and evaluation with Ray on nodes of one core, as processes of this machine.

    python benchmarks/cluster.py overhead nodes evaluation --repeats 3

Prints the wall time of every repetition and the medians, in s; if the benchmark runs in its own control
group (for example by `systemd-run --scope`), also the processor time. Variants alternate. The start of Ray
is measured separately. Run it twice: the first run includes compilation. `projection` computes how long all runs would take on more
nodes, from the durations in trained/. Needs `pip install 'trl_suite[train,cluster]'`.
"""

from __future__ import annotations

import argparse
import contextlib
import heapq
import os
import pathlib
import pickle
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from ray import cluster_utils

from trl_suite import evaluation, policies
from trl_suite.adapters.ray import RayExecutor
from trl_suite.util.program import begin_script

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / 'training'))
import train_all

LONG = 'PD_Biped2D_Flat-v0'  # the run whose overhead is measured
MANY = 'PD_Biped2D_[FI]*'  # four runs, one of which follows another
GAPS = 'PD_Biped2D_Gaps_Terrain-v0'
PARTS = 'start', 'overhead', 'nodes', 'evaluation', 'projection'


class Spent(NamedTuple):
    """Wall time and processor time of all processes, including Ray's, s; NaN if unknown."""

    wall: float
    cpu: float


def now() -> Spent:
    """Returns the current wall time and processor time."""
    return Spent(time.perf_counter(), cpu_seconds())


def since(begin: Spent) -> Spent:
    """Returns the time spent since `now` returned `begin`."""
    end = now()
    return Spent(end.wall - begin.wall, end.cpu - begin.cpu)


def cpu_seconds() -> float:
    """Returns the processor time of this process's control group, s; NaN without its own group."""
    root = pathlib.Path('/sys/fs/cgroup')
    for line in pathlib.Path('/proc/self/cgroup').read_text().splitlines():
        _, kinds, path = line.split(':', 2)
        if path == '/':
            continue
        if 'cpuacct' in kinds.split(','):
            return int((root / kinds / path[1:] / 'cpuacct.usage').read_text()) / 1e9
        if not kinds and (stat := root / path[1:] / 'cpu.stat').exists():
            return int(stat.read_text().split()[1]) / 1e6
    return float('nan')


@contextlib.contextmanager
def cluster(nodes: int) -> Iterator[str]:
    """Starts nodes of one core each; yields the address."""
    made = cluster_utils.Cluster(initialize_head=True, head_node_args={'num_cpus': 1})
    try:
        for _ in range(nodes - 1):
            made.add_node(num_cpus=1)
        made.wait_for_nodes()
        yield made.address
    finally:
        made.shutdown()


def train(pattern: str, samples: float, *words: str) -> Spent:
    """Runs train_all with one run at a time and node."""
    with tempfile.TemporaryDirectory() as folder:
        command = [
            sys.executable, train_all.__file__, '--filter', pattern, '--seeds', '1',
            '--jobs', '1', f'--samples={samples}', '--runs', f'{folder}/runs', *words,
        ]  # fmt: skip
        begin = now()
        subprocess.run(
            command, check=True, env={**os.environ, 'TRL_SUITE_TRAINED': f'{folder}/trained'},
            stderr=subprocess.DEVNULL,
        )  # fmt: skip
        return since(begin)


def training(pattern: str, samples: float, repeats: int, most: int) -> None:
    """Compares training without Ray, on one node, and on more."""

    def local() -> Spent:
        return train(pattern, samples)

    def on(nodes: int) -> Callable[[], Spent]:
        def run() -> Spent:
            with cluster(nodes) as address:
                return train(pattern, samples, '--ray', '--address', address)

        return run

    variants = {f'{n} node' + 's' * (n > 1): on(n) for n in range(1, most + 1)}
    compare({'without Ray': local, **variants}, repeats)


def projection(counts: Sequence[int]) -> None:
    """Prints how long all entered runs would take on nodes of one core each, from their own durations.

    Jobs start in the order of train_all as nodes and the policies that they use become available. Starts
    of processes, evaluations and transfers are left out.
    """
    seconds = {
        (id_, run['seed']): sum(run['curve'][-1]['seconds'].values())
        for id_ in policies.available()
        for run in train_all.entries(id_)
    }
    waiting_at_first = [job for job in train_all.jobs('*') if job in seconds]
    for count in counts:
        waiting, ends, running = list(waiting_at_first), {}, []
        clock = 0.0
        while waiting or running:
            for job in list(waiting):
                uses = [(other, 1) for other in train_all.needed(job[0]) if (other, 1) in seconds]
                if len(running) < count and all(
                    ends.get(each, clock + 1.0) <= clock for each in uses
                ):
                    waiting.remove(job)
                    heapq.heappush(running, (clock + seconds[job], job))
            clock, job = heapq.heappop(running)
            ends[job] = clock
        print(f'  {count:3} nodes: {clock / 3600.0:5.1f} h')
    print(f'  {len(seconds)} runs, longest {max(seconds.values()) / 3600.0:.1f} h')


def evaluate(episodes: int, repeats: int) -> None:
    """Compares an evaluation without Ray, on one node, and on two."""
    policy = policies.reference(GAPS)
    found = []

    def local() -> Spent:
        begin = now()
        found.append(evaluation.evaluate(GAPS, policy, episodes, num_threads=1))
        return since(begin)

    def on(nodes: int) -> Callable[[], Spent]:
        def run() -> Spent:
            with cluster(nodes) as address, RayExecutor(address) as executor:
                # Processes have started and imported the suite, as in a longer evaluation.
                evaluation.evaluate(GAPS, policy, nodes * evaluation.PART, executor=executor)
                begin = now()
                found.append(evaluation.evaluate(GAPS, policy, episodes, executor=executor))
                return since(begin)

        return run

    compare({'one thread': local, '1 node': on(1), '2 nodes': on(2)}, repeats)
    print('same results:', all(each == found[0] for each in found))
    print('a policy is sent as', len(pickle.dumps(policy)), 'bytes')


def compare(variants: dict[str, Callable[[], Spent]], repeats: int) -> None:
    """Prints what functions that alternate spend."""
    spent: dict[str, list[Spent]] = {name: [] for name in variants}
    for _ in range(repeats):
        for name, run in variants.items():
            spent[name].append(run())
            print(
                f'  {name:12} {spent[name][-1].wall:7.1f} s, processors {spent[name][-1].cpu:7.1f} s',
                flush=True,
            )
    for kind in Spent._fields:
        for name, each in spent.items():
            values = [getattr(one, kind) for one in each]
            print(
                f'{kind:5} {name:12} median {statistics.median(values):7.1f} s, least {min(values):7.1f} s'
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('parts', nargs='+', choices=PARTS)
    parser.add_argument('--repeats', type=int, default=3)
    parser.add_argument('--samples', type=float, default=2e5, help='of the run of `overhead`')
    parser.add_argument('--few', type=float, default=5e4, help='of each run of `nodes`')
    parser.add_argument('--episodes', type=int, default=768)
    chosen = parser.parse_args()
    for part in chosen.parts:
        print(part)
        if part == 'start':
            begin = time.perf_counter()
            with RayExecutor('local') as executor:
                middle = time.perf_counter()
                list(executor.map(len, ['']))
                end = time.perf_counter()
            print(f'  {middle - begin:.1f} s; first task {end - middle:.1f} s')
        elif part == 'overhead':
            training(LONG, chosen.samples, chosen.repeats, 1)
        elif part == 'nodes':
            training(MANY, chosen.few, chosen.repeats, 2)
        elif part == 'projection':
            projection((1, 2, 16))
        else:
            evaluate(chosen.episodes, chosen.repeats)


if __name__ == '__main__':
    begin_script()
    main()
