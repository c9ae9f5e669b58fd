"""Ray: the same results on any number of nodes, also when one is lost.

Clusters are processes of this machine: a head node of one core, and a second node of one core that
is killed while it works.
"""

import concurrent.futures
import json
import multiprocessing
import os
import pathlib
import socket
import subprocess
import sys
import tempfile
import threading
import time
from typing import ClassVar
from unittest import mock

import numpy as np
import pytest
from absl.testing import absltest

from trl_suite import evaluation, policies, sequences

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / 'training'))
import ppo
import train_all
from settings import settings_for

# Ray that is started on this machine makes a token, and would then send it to the clusters of these
# tests, which have none.
os.environ['RAY_AUTH_MODE'] = 'disabled'

try:
    import ray
    from ray import cluster_utils

    from trl_suite.adapters.ray import RayExecutor
except ImportError:
    ray = None

ROOT = pathlib.Path(__file__).resolve().parents[1]
GAPS = 'PD_Biped2D_Gaps_Terrain-v0'
PATIENCE = 300  # s; on a busy machine everything takes long
pytestmark = [
    pytest.mark.skipif(ray is None, reason="needs ray: pip install 'trl_suite[cluster]'"),
    pytest.mark.slow,
]


def wait_until(condition, what):
    end = time.monotonic() + PATIENCE
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError(what)
        time.sleep(0.05)


class InBackground(threading.Thread):
    """Calls a function in a thread; `result` waits for it."""

    def __init__(self, function):
        super().__init__(daemon=True)
        self.function, self.value, self.error = function, None, None
        self.start()

    def run(self):
        try:
            self.value = self.function()
        except BaseException as error:
            self.error = error

    def result(self):
        self.join(PATIENCE)
        if self.is_alive():
            raise TimeoutError('the work did not end')
        if self.error is not None:
            raise self.error
        return self.value


class OneProcess(concurrent.futures.ProcessPoolExecutor):
    """Runs each task in a new process of this machine, one at a time."""

    def __init__(self, *_, **__):
        super().__init__(1, multiprocessing.get_context('spawn'), max_tasks_per_child=1)

    def cancel(self):
        self.shutdown(cancel_futures=True)


class TwoNodes(absltest.TestCase):
    def setUp(self):
        super().setUp()
        paths = os.pathsep.join((str(ROOT), str(ROOT / 'training')))
        # In a folder of its own, so that other programs on this machine do not join the cluster.
        folder = self.enterContext(tempfile.TemporaryDirectory(dir='/tmp'))  # paths must be short
        self.enterContext(
            mock.patch.dict(
                os.environ, PYTHONPATH=paths, RAY_TMPDIR=folder, RAY_USAGE_STATS_ENABLED='0'
            )
        )
        memory = {'object_store_memory': 10**8}
        self.cluster = cluster_utils.Cluster(
            initialize_head=True, head_node_args={'num_cpus': 1, **memory}
        )
        self.addCleanup(self.cluster.shutdown)
        self.second = self.cluster.add_node(num_cpus=1, **memory)
        self.cluster.wait_for_nodes()

    def connect(self, **options):
        executor = RayExecutor(self.cluster.address, **options)
        self.addCleanup(executor.close)
        return executor

    def kill_one_of(self, background):
        """Kills the second node while both work."""
        wait_until(lambda: ray.available_resources().get('CPU', 0) == 0, 'no tasks run')
        time.sleep(1)
        self.assertTrue(background.is_alive())
        self.cluster.remove_node(self.second, allow_graceful=False)
        wait_until(lambda: sum(node['Alive'] for node in ray.nodes()) == 1, 'no node was lost')
        self.assertTrue(background.is_alive())


class ConnectionTest(absltest.TestCase):
    """`ray start` notes the address of a cluster; this one has ended without `ray stop`."""

    def setUp(self):
        super().setUp()
        folder = pathlib.Path(self.enterContext(tempfile.TemporaryDirectory(dir='/tmp')))
        self.enterContext(
            mock.patch.dict(os.environ, RAY_TMPDIR=str(folder), RAY_USAGE_STATS_ENABLED='0')
        )
        self.enterContext(
            mock.patch.object(
                ray._private.services, 'find_gcs_addresses', mock.Mock(return_value=set())
            )
        )  # not other clusters of this machine
        os.environ.pop('RAY_ADDRESS', None)
        with socket.create_server(('127.0.0.1', 0)) as server:
            self.address = f'127.0.0.1:{server.getsockname()[1]}'
        (folder / 'ray').mkdir()
        (folder / 'ray' / 'ray_current_cluster').write_text(self.address)

    def test_ray_starts_on_this_machine(self):
        with RayExecutor(num_cpus=0) as executor:
            self.assertEqual(list(executor.map(len, ['text', 'on'])), [4, 2])

    def test_a_cluster_that_was_asked_for(self):
        for address in 'auto', self.address:
            with self.assertRaisesRegex(ConnectionError, 'no cluster .* at .*ray start --head'):
                RayExecutor(address)
        os.environ['RAY_ADDRESS'] = self.address
        with self.assertRaisesRegex(ConnectionError, 'no cluster of Ray answers at '):
            RayExecutor()


class ExecutorTest(TwoNodes):
    def test_evaluation_survives_the_loss_of_a_node(self):
        policy = policies.reference(GAPS)
        expected = evaluation.evaluate(GAPS, policy, 96, 3)
        self.enterContext(mock.patch.object(evaluation, 'PART', 12))
        executor = self.connect()
        again = InBackground(lambda: evaluation.evaluate(GAPS, policy, 96, 3, executor=executor))
        self.kill_one_of(again)
        self.assertEqual(again.result(), expected)

    def test_sequence_survives_the_loss_of_a_node(self):
        sequence = sequences.get('plaid_biped')

        class Walker:
            """Walks with the shipped policy of one environment after the other."""

            now = sequence.ids[0]

            def train(self, stage):
                self.now = stage.id

            def policy(self):
                return policies.reference(self.now)

        folder = pathlib.Path(self.enterContext(tempfile.TemporaryDirectory()))
        options = {'budget': 1, 'episodes': 6}
        expected = sequences.run(sequence, Walker(), path=folder / 'local.json', **options)
        executor = self.connect()
        again = InBackground(
            lambda: sequences.run(
                sequence, Walker(), path=folder / 'ray.json', executor=executor, **options
            )
        )
        self.kill_one_of(again)
        self.assertEqual(again.result()['scores'], expected['scores'])
        self.assertGreater(np.ptp(expected['scores']), 0)

    def test_errors_are_those_of_a_local_call(self):
        executor = self.connect()
        with self.assertRaisesRegex(ValueError, r'actions have shape \(2, 3\)'):
            evaluation.evaluate(
                GAPS, lambda observation: np.zeros((len(observation), 3)), 2, executor=executor
            )

    def test_other_sources_are_refused(self):
        executor = self.connect()
        with (
            mock.patch('trl_suite.util.compiled.fingerprint', lambda: 'of other sources'),
            self.assertRaisesRegex(RuntimeError, 'install the same on all nodes'),
        ):
            list(executor.map(len, ['text']))

    def test_who_waits_for_cancelled_tasks_is_told(self):
        executor = self.connect()
        waiting = InBackground(lambda: list(executor.map(time.sleep, [2 * PATIENCE] * 3)))
        wait_until(lambda: ray.available_resources().get('CPU', 0) == 0, 'no tasks run')
        executor.cancel()
        with self.assertRaises(ray.exceptions.RayError):
            waiting.result()
        wait_until(lambda: ray.available_resources().get('CPU', 0) == 2, 'tasks go on')

    def test_a_task_that_no_node_can_run(self):
        with self.assertWarnsRegex(UserWarning, 'no node has the 64 cores and 0.0 GB'):
            self.connect(num_cpus=64)


class TrainingTest(TwoNodes):
    """Four runs, one of which starts from the policy of another."""

    PATTERN = 'PD_Biped2D_[FI]*'
    SETTINGS: ClassVar = {
        'samples': 24576, 'num_envs': 16, 'minibatch': 128, 'hidden': (32, 32),
        'evaluate_every': 2048, 'evaluation_episodes': 2, 'value_first': 2048,
    }  # fmt: skip

    def folder(self):
        return pathlib.Path(self.enterContext(tempfile.TemporaryDirectory()))

    def train(self, folder, *arguments):
        """Runs train_all in this process; returns what it has entered."""
        trained = {'TRL_SUITE_TRAINED': str(folder / 'trained')}
        with mock.patch.dict(os.environ, trained):
            words = '--filter', self.PATTERN, '--ray', '--runs', str(folder / 'runs'), *arguments
            train_all.main(words)
        return entered(folder / 'trained')

    def test_runs_survive_the_loss_of_a_node(self):
        short = lambda id_, **_: settings_for(id_, **self.SETTINGS)  # noqa: E731
        self.enterContext(mock.patch.object(ppo, 'settings_for', short))
        local, remote = self.folder(), self.folder()
        with mock.patch('trl_suite.adapters.ray.RayExecutor', OneProcess):
            expected = self.train(local)
        self.assertLen(expected, 2 * 4)
        again = InBackground(lambda: self.train(remote, '--address', self.cluster.address))
        # Both nodes are in the middle of a run: later, the last run has to wait for another.
        wait_until(
            lambda: len(list((remote / 'runs').glob('*/*/checkpoint.pt'))) >= 2, 'no checkpoints'
        )
        self.kill_one_of(again)
        self.assertEqual(again.result(), expected)
        logs = [path.read_text() for path in (remote / 'runs').glob('*/*/log.txt')]
        self.assertLen(logs, 4)
        self.assertEqual(sum('continues on' in log for log in logs), 1)

    def test_a_stop_ends_the_runs_and_enters_nothing(self):
        folder = self.folder()
        running = subprocess.Popen(
            [
                sys.executable, ROOT / 'training' / 'train_all.py', '--filter', 'PD_Biped2D_Flat-v0',
                '--samples', '1e9', '--runs', folder / 'runs', '--ray', '--address', self.cluster.address,
            ],
            env={**os.environ, 'TRL_SUITE_TRAINED': str(folder / 'trained')}, cwd=folder,
        )  # fmt: skip
        self.addCleanup(running.kill)
        self.connect()
        wait_until(lambda: ray.available_resources().get('CPU', 0) == 1, 'no run has begun')
        running.terminate()
        self.assertEqual(running.wait(PATIENCE), 1)
        wait_until(lambda: ray.available_resources().get('CPU', 0) == 2, 'the run goes on')
        self.assertFalse((folder / 'trained').exists())

    def test_programs_give_the_same_results_with_and_without_ray(self):
        found = []
        for name, words in (('local', ()), ('ray', ('--ray', '--address', self.cluster.address))):
            folder = self.folder()
            subprocess.run(
                [
                    sys.executable, ROOT / 'training' / 'train_all.py', '--filter', 'PD_Biped2D_Flat-v0',
                    '--samples', '4096', '--runs', folder / 'runs', *words,
                ],
                env={**os.environ, 'TRL_SUITE_TRAINED': str(folder / name)},
                cwd=folder, check=True, timeout=PATIENCE,
            )  # fmt: skip
            found.append(entered(folder / name))
        self.assertLen(found[0], 2)
        self.assertEqual(*found)


def entered(folder):
    """Returns what a folder of trained policies holds, without times and machines."""
    found = {path.name: path.read_bytes() for path in folder.glob('*.npz')}
    for path in folder.glob('*.json'):
        content = json.loads(path.read_text())
        for run in content['runs']:
            del run['machine']
            for point in run['curve']:
                del point['seconds']
        found[path.name] = content
    return found
