"""Full disks, and signals at random times: nothing is lost, and nothing is left half-written.

A server process imports the suite once and forks a child for every run, so that a run takes a second. The
slow tests (`-m slow`) interrupt programs by each signal, in FUZZ_EXAMPLES rounds, at times drawn from a seed
that is printed.
"""

import contextlib
import json
import os
import pathlib
import random
import re
import resource
import signal
import subprocess
import sys
import time
import traceback
from unittest import mock

import imageio.v3 as iio
import numpy as np
import pytest
from absl.testing import parameterized
from helpers import FolderTest

from trl_suite import cli, motion, policies, sequences, suite, terrain
from trl_suite.util import files, program

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / 'docs'))
sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / 'training'))
import gallery
import ppo
import runs
from settings import Settings

GAPS = 'PD_Biped2D_Gaps_Terrain-v0'
FLAT = 'PD_Biped2D_LLC_Imitate_Flat-v0'
SLOW = int(os.environ.get('FUZZ_EXAMPLES', '10'))  # rounds
SEQUENCE = sequences.Sequence('two', ('plaid/dog_flat', 'plaid/dog_steps'))
SETTINGS = Settings(
    samples=256, num_envs=8, horizon=8, minibatch=32, hidden=(16, 16), evaluate_every=128,
    evaluation_episodes=2,
)  # fmt: skip
SIGNALS = signal.SIGKILL, signal.SIGINT, signal.SIGTERM
PART = r'\..*\.part(\.\w+)?|\.lock|\..*\.lock|\.trl_suite_state'  # what SIGKILL may leave


class Learner:
    """Its policy depends on all rewards so far."""

    def __init__(self, total=0.0):
        self.total = total

    def train(self, stage):
        environments = stage.environments(4, num_threads=1)
        environments.reset()
        for _ in range(5):
            self.total += float(environments.step(np.full((4, 20), 0.1)).reward.sum())

    def policy(self):
        return lambda observation: np.tanh(self.total * observation[:, :20])

    def save(self, folder):
        (folder / 'total.json').write_text(json.dumps(self.total))

    def load(self, folder):
        self.total = json.loads((folder / 'total.json').read_text())


# The programs. Each works in the current folder, and returns the exit status.


def as_script(run):
    """As `program.begin_script` has it, but the exit status tells how it ended."""

    def script(*arguments):
        try:
            with program.terminable():
                run(*arguments)
        except KeyboardInterrupt as error:
            terminated = isinstance(error, program.Terminated)
            print('terminated' if terminated else 'interrupted', file=sys.stderr)
            return 143 if terminated else 130
        except program.EXPECTED as error:
            print(f'error: {program.in_one_line(error)}', file=sys.stderr)
            return 2
        return 0

    return script


def command(*arguments):
    return cli.main(arguments)


@as_script
def train(stop=None):
    """Trains; interrupts itself before an update, if that is given."""
    learn, calls = ppo.Trainer.learn, []

    def stopped(trainer, batch):
        calls.append(trainer)
        if len(calls) == stop:
            raise KeyboardInterrupt
        return learn(trainer, batch)

    with mock.patch.object(ppo.Trainer, 'learn', stopped):
        ppo.train(FLAT, 3, SETTINGS, pathlib.Path('run'), threads=1, progress=False)


@as_script
def draw():
    for error in gallery.make('g', 'terrains/gaps')[1].values():
        raise error


@as_script
def learn():
    sequences.run(SEQUENCE, Learner(), 20, 'result.json', episodes=1, num_threads=1)


ROLLOUT = (
    'rollout', GAPS, '--steps', '30', '--policy', 'zero', '--trajectory', 'a.npz', '--strip', 'a.png',
    '--columns', '3', '--video', 'a.mp4', '--size', '64x48',
)  # fmt: skip
PROGRAMS = {'command': command, 'train': train, 'learn': learn, 'draw': draw}


def serve():
    """Runs a program in a forked child for each line of stdin; answers with how it ended."""
    environment = suite.make(GAPS, {'random': 0})  # loads the compiled code for all children
    environment.reset()
    environment.step(np.zeros(11))
    terrain.SpatialGround(terrain.load('hills3d'), 0).height(0.0, 0.0)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for line in sys.stdin:
        task = json.loads(line)
        begin, child = time.monotonic(), os.fork()
        if not child:
            work(task)
        with contextlib.suppress(OSError):  # it has ended
            os.setpgid(child, child)
        number, after = task['signal'], task['after']
        status = None
        while status is None:
            ended, found = os.waitpid(child, os.WNOHANG)
            if ended:
                status = os.waitstatus_to_exitcode(found)
            elif number and (
                any(name.startswith('.') for name in os.listdir(task['folder']))
                if after == 'hidden file'
                else time.monotonic() > begin + after
            ):
                # An interrupt from the keyboard reaches the whole group.
                (os.killpg if number == signal.SIGINT else os.kill)(child, number)
                number = 0
            else:
                time.sleep(0.002)
        answer = {'status': status, 'seconds': time.monotonic() - begin}
        print(json.dumps(answer), flush=True)


def work(task):
    """Runs a program, and ends this process."""
    os.chdir(task['folder'])
    log = os.open(task['log'], os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for stream in (1, 2):
        os.dup2(log, stream)
    status = 1
    try:
        if task['limit']:
            resource.setrlimit(resource.RLIMIT_FSIZE, (task['limit'], task['limit']))
        try:
            status = PROGRAMS[task['program']](*task['arguments'])
            sys.stdout.flush()
        finally:
            signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS[1:])
    except KeyboardInterrupt as error:  # after the program has ended
        status = 143 if isinstance(error, program.Terminated) else 130
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(status)


# What the programs leave, in a form that can be compared.


def arrays(path):
    with np.load(path) as archive:
        return {name: archive[name].tolist() for name in archive}


def policy(path):
    found = policies.load(path)
    return [each.tolist() for each in (*found.weights, *found.biases, found.mean, found.std)]


def content(path):
    """What a whole file holds; raises an exception for others. Durations are left out."""
    if path.name == 'curve.json':
        found = json.loads(path.read_text())
        for point in found['curve']:
            del point['seconds']
        return found
    if path.name == 'result.json':
        found = sequences.read(path, complete=False)
        return {name: found[name] for name in found if name not in ('seconds', 'digest')}
    if path.name == 'checkpoint.pt':
        return runs.load(path)['samples']
    if path.suffix == '.npz':
        return (policy if path.parent.name == 'run' else arrays)(path)
    if path.suffix == '.mp4':
        return len(iio.imread(path, plugin='FFMPEG'))
    if path.suffix in ('.png', '.jpg'):
        return iio.imread(path).tolist()
    return path.read_bytes()


class FaultsTest(FolderTest):
    @classmethod
    def setUpClass(cls):
        super().setUpClass()
        command = [sys.executable, __file__]
        pipes = {'stdin': subprocess.PIPE, 'stdout': subprocess.PIPE, 'text': True}
        cls.server = cls.enterClassContext(subprocess.Popen(command, **pipes))

    @classmethod
    def tearDownClass(cls):
        cls.server.stdin.close()
        super().tearDownClass()

    def setUp(self):
        super().setUp()
        self.place, self.folder = self.folder, self.folder / 'folder'
        self.folder.mkdir()

    def new(self, name):
        folder = self.place / name
        folder.mkdir()
        return folder

    def run_program(self, folder, name, *arguments, number=0, after=0.0, limit=0):
        """Returns exit status, what was printed, and the duration."""
        log = self.place / 'log'
        task = {
            'program': name, 'arguments': arguments, 'folder': str(folder), 'log': str(log),
            'signal': number, 'after': after, 'limit': limit,
        }  # fmt: skip
        print(json.dumps(task), file=self.server.stdin, flush=True)
        answer = json.loads(self.server.stdout.readline())
        text = log.read_text()
        self.assertNotIn('Traceback', text)
        return answer['status'], text, answer['seconds']

    def files(self, folder, hidden=''):
        """The contents by path; files with other names than `hidden` have to be whole."""
        found = {}
        for path in folder.rglob('*'):
            name = path.relative_to(folder).as_posix()
            inside = [part for part in path.relative_to(folder).parts if part.startswith('.')]
            if inside:
                self.assertRegex(inside[0], f'^({hidden})$' if hidden else 'no hidden file')
            elif path.is_file():
                found[name] = content(path)
        return found

    def interrupted(self, seed, signals, name, *arguments):
        """Ends a program by signals at random times; at last it does what it does undisturbed."""
        whole = self.new(f'whole{seed}')
        status, _, seconds = self.run_program(whole, name, *arguments)
        self.assertEqual(status, 0)
        expected = self.files(whole)
        self.assertNotEmpty(expected)
        draw = random.Random(seed)
        for number in signals:
            after = draw.uniform(0, 1.1 * seconds)
            how = {'number': number, 'after': after}
            status, text, _ = self.run_program(self.folder, name, *arguments, **how)
            with self.subTest(name=name, seed=seed, **how):
                ends = {
                    signal.SIGKILL: (0, -9),
                    signal.SIGINT: (0, 130),
                    signal.SIGTERM: (0, 143, -15),  # -15: before the program was ready
                }
                self.assertIn(status, ends[number], text)
                found = self.files(self.folder, PART)
                for path, held in found.items():
                    if path in expected and name == 'command':
                        self.assertEqual(held, expected[path], path)
        status, text, _ = self.run_program(self.folder, name, *arguments)
        self.assertEqual(status, 0, text)
        found = self.files(self.folder, PART)
        self.assertCountEqual(found, expected)
        for path, held in found.items():
            self.assertEqual(held, expected[path], path)

    @parameterized.named_parameters(
        ('rollout', 'command', *ROLLOUT), ('gallery', 'draw'), ('training', 'train'),
        ('sequence', 'learn'),
    )  # fmt: skip
    @pytest.mark.slow
    def test_many_signals(self, *arguments):
        first = int(os.environ.get('FUZZ_SEED', random.SystemRandom().randrange(2**31)))
        print(f'FUZZ_SEED={first} FUZZ_EXAMPLES={SLOW}', flush=True)
        for seed in range(first, first + SLOW):
            self.interrupted(seed, SIGNALS, *arguments)
            for path in sorted(self.folder.rglob('*'), reverse=True):
                path.rmdir() if path.is_dir() else path.unlink()

    def test_writers_of_one_file_do_not_meet(self):
        """Also if their processes have the same number, as in containers that share a folder."""
        path = self.folder / 'file'
        with files.replacing(path) as one:
            one.write_text('one')
            with files.replacing(path) as two:
                two.write_text('two')
            self.assertEqual((path.read_text(), one.read_text()), ('two', 'one'))
        self.assertEqual(self.files(self.folder), {'file': b'one'})

    @pytest.mark.slow
    def test_a_signal_leaves_no_hidden_files(self):
        """Unlike SIGKILL, an interrupt and SIGTERM give a program the time to remove them."""
        for number, status in ((signal.SIGINT, 130), (signal.SIGTERM, 143)):
            folder = self.new(number.name)
            how = {'number': number, 'after': 'hidden file'}
            self.assertEqual(self.run_program(folder, 'command', *ROLLOUT, **how)[0], status)
            self.files(folder)

    @parameterized.named_parameters(
        ('trajectory', ('a.npz',), 'rollout', GAPS, '--steps', '100', '--trajectory', 'a.npz'),
        ('strip', ('a.png',), 'rollout', GAPS, '--steps', '5', '--strip', 'a.png'),
        ('video', ('a.mp4',), 'rollout', GAPS, '--steps', '30', '--video', 'a.mp4'),
        ('gif', ('a.gif',), 'rollout', GAPS, '--steps', '30', '--video', 'a.gif'),
        ('replay', ('a.html',), 'rollout', GAPS, '--steps', '5', '--html', 'a.html'),
        ('evaluation', ('a.json',), 'evaluate', GAPS, '--policy', 'zero', '--episodes', '50',
         '--threads', '1', '--json', 'a.json'),
        ('plot', ('a.png',), 'terrain', 'gaps', '--output', 'a.png'),
        ('mesh', ('a.obj',), 'terrain', 'hills3d', '--output', 'a.obj'),
        ('clip', ('a.npz',), 'clip', 'walk.npz', '--character', 'biped2d', '--output', 'a.npz'),
    )  # fmt: skip
    def test_a_full_disk(self, names, *arguments):
        if 'walk.npz' in arguments:
            motion.load('biped2d_walk').save(self.folder / 'walk.npz')
        for name in names:
            (self.folder / name).write_text('old')
        before = {path.name: path.read_bytes() for path in self.folder.iterdir()}
        status, text, _ = self.run_program(self.folder, 'command', *arguments, limit=1000)
        self.assertEqual(status, 2, text)
        message = rf'trl-suite: error: [^\n]*{re.escape(names[0])}[^\n]*\n$'
        self.assertRegex(text, message)
        after = {path.name: path.read_bytes() for path in self.folder.iterdir()}
        self.assertEqual(after, before)

    def test_a_full_disk_under_the_gallery(self):
        status, text, _ = self.run_program(self.folder, 'draw', limit=1000)
        self.assertEqual(status, 2)
        self.assertRegex(text, r'^error: .*File too large')
        self.assertEqual(self.files(self.folder), {})

    def test_a_full_disk_under_a_sequence(self):
        expected = self.new('whole')
        self.run_program(expected, 'learn')
        status, text, _ = self.run_program(self.folder, 'learn', limit=100)
        self.assertEqual(status, 2, text)
        self.assertRegex(text, r"(^|\n)error: .*File too large: 'result\.json'\n$")
        self.assertEqual(self.files(self.folder), {})
        self.assertEqual(self.run_program(self.folder, 'learn')[0], 0)
        self.assertEqual(self.files(self.folder), self.files(expected))

    def test_a_full_disk_in_training(self):
        """The checkpoint stays that of the last evaluation before, from which training goes on."""
        expected = self.new('whole')
        self.assertEqual(self.run_program(expected, 'train')[0], 0)
        self.assertEqual(self.run_program(self.folder, 'train', 4)[0], 130)
        before = self.files(self.folder)
        self.assertEqual(before['run/checkpoint.pt'], 128)
        status, text, _ = self.run_program(self.folder, 'train', limit=4000)
        self.assertEqual(status, 2, text)
        self.assertRegex(text, r"(^|\n)error: .*File too large: 'run/[a-z]+\.[a-z]+'\n$")
        self.assertEqual(self.files(self.folder)['run/checkpoint.pt'], 128)
        self.assertEqual(self.run_program(self.folder, 'train')[0], 0)
        self.assertEqual(self.files(self.folder), self.files(expected))


if __name__ == '__main__':
    serve()
