"""Compiled functions: supported features, and the cache of their machine code."""

import contextlib
import errno
import hashlib
import io
import itertools
import math
import os
import pathlib
import shutil
import signal
import subprocess
import sys
import tempfile
import textwrap
import time
import types
import unittest
from typing import NamedTuple
from unittest import mock

import numba
import numpy as np
import pytest
from absl.testing import parameterized
from helpers import FolderTest, besides_notices
from numba.core import event

import trl_suite
from trl_suite import suite
from trl_suite.tasks.task_type import TASK_TYPES
from trl_suite.util import compiled as module
from trl_suite.util import files, interrupts, machine_code, notices
from trl_suite.util.compiled import (
    compiled,
    compiled_inline,
    nearest_index,
    packed,
)
from trl_suite.vector import VectorEnvironment

PACKAGE = pathlib.Path(trl_suite.__file__).parent
INNER = """
from trl_suite.util.compiled import compiled

@compiled
def inner(x):
    return {}
"""
OUTER = """
from trl_suite.inner import inner
from trl_suite.util.compiled import compiled

@compiled
def outer(x):
    return inner(x) + 1.0
"""
ASK = 'from trl_suite.outer import outer; print(outer(1.0))'
FOLDER = 'from trl_suite.util.compiled import cache_folder; print(cache_folder())'
TUPLE = 'from typing import NamedTuple\nclass {}(NamedTuple):\n    array: object\n'
FIRST = """
from trl_suite.util.compiled import compiled

@compiled
def first(pack):
    return pack.array[0]
"""
PACKED = (
    'import numpy as np; from trl_suite.own import first; '
    'from trl_suite.util.compiled import packed; '
)


class Pair(NamedTuple):
    first: np.ndarray
    second: np.ndarray


class Whole(NamedTuple):
    pair: Pair
    count: int
    share: float
    flag: bool


@compiled
def mixed(whole):
    first, second = whole.pair.first, whole.pair.second
    return first[-1], second.shape[1], whole.count * whole.share, whole.flag


@compiled_inline
def twice(x):
    return 2.0 * x


@compiled
def scaled(i, pair):
    pair.second[i] = twice(pair.first[i]) / (i - 1)


@compiled
def scale_all(env_ids, pair):
    for i in env_ids:
        scaled(i, pair)


@compiled
def allocates(n):
    return np.zeros(n)


class FunctionTest(parameterized.TestCase):
    """Features of compiled functions."""

    def test_fields_of_packs(self):
        whole = Whole(Pair(np.arange(3.0), np.zeros((2, 3), np.float32)), 7, 0.5, True)
        for pack in (packed(whole), packed(whole)):  # of one type
            self.assertEqual(mixed(pack), (2.0, 3, 3.5, 1))
        frozen = np.arange(4.0)
        frozen.flags.writeable = False
        other = packed(whole._replace(pair=Pair(frozen[::2], np.zeros((1, 1)))))
        self.assertEqual(mixed(other), (2.0, 1, 3.5, 1))

    def test_unsupported_values_cannot_be_packed(self):
        with self.assertRaisesRegex(TypeError, 'Whole.pair.second is list; expected an array, a'):
            packed(Whole(Pair(np.zeros(2), [1.0]), 7, 0.5, True))

    def test_a_division_by_zero_gives_infinity(self):
        pair = Pair(np.ones(3), np.zeros(3))
        scale_all(np.arange(3), packed(pair))
        np.testing.assert_array_equal(pair.second, [-2, np.inf, 2])

    @parameterized.parameters(
        (math.nan, 0), (-math.inf, 0), (-1e300, 0), (-0.5, 0), (0.0, 0), (0.999, 0), (1.0, 1), (6.7, 6),
        (7.0, 7), (7.5, 7), (8.0, 7), (1e19, 7), (1e300, 7), (math.inf, 7),
    )  # fmt: skip
    def test_numbers_become_indices(self, number, index):
        self.assertEqual(nearest_index(number, 8), index)
        self.assertEqual(nearest_index.function(number, 8), index)
        self.assertEqual(nearest_index(number, 1), 0)

    def test_a_pack_keeps_its_arrays(self):
        second = np.zeros(2000)
        pack, others = packed(Pair(np.full(2000, 3.0), second)), []
        for _ in range(20):
            others.append(np.full(2000, 7.0))  # would reuse freed memory
        scale_all(np.array([5]), pack)
        self.assertEqual(second[5], 1.5)

    def test_allocation_is_rejected(self):
        with self.assertRaises(numba.core.errors.NumbaError):
            allocates(3)
        self.assertEqual((twice.function(4), twice.__name__), (8, 'twice'))


class NoticeTest(parameterized.TestCase):
    """What users are told while functions are compiled, and when they are not."""

    COMPILING = 'compiling functions for this machine, once; it usually takes 5 to 15 s'

    def setUp(self):
        super().setUp()
        self.told, self.now, self.timer = [], 0.0, None
        for owner, name, value in (
            (notices, 'listeners', [self.told.append]),
            (notices.threading, 'Timer', self._start),
            (notices.time, 'monotonic', lambda: self.now),
        ):
            self.enter_context(mock.patch.object(owner, name, value))
        self.compiling = notices.Compiling()

    def _start(self, seconds, action):
        self.timer = mock.Mock(due=self.now + seconds, action=action)
        self.timer.cancel = lambda: setattr(self, 'timer', None)
        return self.timer

    def rest(self, seconds):
        until = self.now + seconds
        while self.timer is not None and self.timer.due <= until:
            self.now, timer, self.timer = self.timer.due, self.timer, None
            timer.action()
        self.now = until

    def compile(self, seconds, waited=0.0):
        self.compiling.begin()
        if waited:
            with self.compiling.waiting():
                self.rest(waited)
        self.rest(seconds - waited)
        self.compiling.end()

    @parameterized.parameters(
        ((0.4,), []), ((0.3, 0.3), [COMPILING, 'compiled in 1 s']),
        ((7.0, 0.1, 5.0), [COMPILING, 'compiled in 12 s']), ((0.4, -3.0, 0.4), []),
        ((3.0, -3.0, 4.0), [COMPILING, 'compiled in 3 s', COMPILING, 'compiled in 4 s']),
    )  # fmt: skip
    def test_long_compiling_is_told_of(self, durations, told):
        """Of parts that follow each other at once, and after pauses, the negative numbers."""
        for seconds in durations:
            if seconds < 0.0:
                self.rest(-seconds)
            else:
                self.compile(seconds)
        self.rest(3.0)
        self.assertEqual(self.told, told)

    def test_another_process(self):
        self.compiling.begin()
        self.rest(0.9)
        self.assertEqual(self.told, [self.COMPILING])  # within a second
        self.compiling.end()
        self.rest(3.0)
        self.compile(9.0, waited=5.0)
        self.rest(3.0)
        self.assertEqual(self.told, [
            self.COMPILING, 'compiled in 1 s',
            'waiting for another process that compiles functions; it usually takes 5 to 15 s',
            'compiled in 9 s, 5 s of them by another process',
        ])  # fmt: skip

    def test_environments(self):
        """Also if parts are compiled by `make`, `reset` and `step`, with pauses."""
        for name in ('dog', 'goat'):
            self.compiling.about(name)
            self.compile(4.0)
            self.rest(3.0)
            self.compile(5.0)
        self.rest(3.0)
        told = [
            self.COMPILING.replace('functions', f'functions of {name}') for name in ('dog', 'goat')
        ]
        self.assertEqual(self.told[::2], np.repeat(told, 2).tolist())
        self.assertEqual(self.told[1::2], 2 * ['compiled in 4 s', 'compiled in 5 s'])

    def test_streams(self):
        closed = io.StringIO()
        closed.close()
        for stream in io.StringIO(), closed, None:
            with contextlib.redirect_stderr(stream):
                notices.print_to_stderr('hello')
            if stream and stream is not closed:
                self.assertEqual(stream.getvalue(), 'trl_suite: hello\n')


class LockTest(FolderTest):
    """A function that another process compiles is waited for; see `trl_suite.util.machine_code`."""

    def setUp(self):
        super().setUp()
        self.busy, hash_ = lambda: False, self.folder / 'hash'
        locks = types.SimpleNamespace(LOCK_EX=2, LOCK_NB=4, flock=self._flock)
        for owner, name, value in (
            (files, 'fcntl', locks), (module, 'cache_folder', lambda: hash_),
        ):  # fmt: skip
            self.enter_context(mock.patch.object(owner, name, value))
        hash_.mkdir()

    def _flock(self, file, operation):
        if self.busy():
            raise BlockingIOError

    def assert_ended(self):
        """No lock is held."""
        self.assertEmpty(machine_code._held._exit_callbacks)

    def test_an_interrupt_ends_the_wait(self):
        """Interrupts are postponed otherwise."""
        function, before = fresh(), signal.getsignal(signal.SIGINT)
        self.busy = lambda: signal.raise_signal(signal.SIGINT) or True
        with self.assertRaises(KeyboardInterrupt):
            function(1.0)
        self.assert_ended()
        self.assertIs(signal.getsignal(signal.SIGINT), before)
        self.busy = lambda: False
        self.assertEqual(function(1.0), 7.0)

    def test_a_wait_has_a_limit(self):
        """A process that was stopped keeps its locks. Only the first is waited for."""
        self.enter_context(mock.patch.object(machine_code, 'limit', 8 * machine_code._TICK))
        clock = self.enter_context(mock.patch.object(machine_code, 'time'))
        clock.now = 0.0
        clock.monotonic = lambda: clock.now
        clock.sleep = lambda seconds: setattr(clock, 'now', clock.now + seconds)
        self.busy = mock.Mock(return_value=True)
        self.assertEqual(fresh()(1.0), 7.0)
        self.assertEqual(machine_code.limit, 0.0)
        self.assertBetween(self.busy.call_count, 8, 10)
        # This disk has no locks.
        self.busy = mock.Mock(side_effect=OSError(errno.ENOLCK, 'no locks'))
        self.assertEqual(fresh()(1.0), 7.0)
        self.busy = lambda: False
        with self.assertRaises(numba.core.errors.NumbaError):
            compiled(allocates.function)(3)
        self.assert_ended()


@compiled
def double(x):
    return 2.0 * x


@compiled
def triple(x):
    return 3.0 * x


@compiled
def more(x):
    return triple(x) + 4.0


def fresh():
    """Returns a function that has yet to be compiled, as has the one that it calls."""
    triple._made.clear()
    return compiled(more.function)


class InterruptTest(parameterized.TestCase):
    """Signals that arrive while Numba compiles; see `trl_suite.util.interrupts`."""

    def setUp(self):
        super().setUp()
        self.enter_context(mock.patch.object(module, 'cache_folder', lambda: None))

    def _compile_and_signal(self, number, kind='numba:run_pass', outer=None):
        """Returns a function that calls another; a signal arrives while it is compiled."""
        outer = outer or compiled(lambda x: double(x) + 1.0)
        after = []

        class Sender(event.Listener):
            def on_start(self, _):
                if not after:
                    signal.raise_signal(number)
                    after.append('still running')

            def on_end(self, _):
                pass

        module._numba()
        with event.install_listener(kind, Sender()):
            try:
                outer(1.0)
            finally:
                self.assertEqual(after, ['still running'])
        return outer

    @parameterized.parameters('numba:run_pass', 'numba:compile')
    def test_an_interrupt_waits_for_the_end_of_a_pass(self, kind):
        before = signal.getsignal(signal.SIGINT)
        function = compiled(lambda x: double(x) + 1.0)
        with self.assertRaises(KeyboardInterrupt):
            self._compile_and_signal(signal.SIGINT, kind, function)
        self.assertIs(signal.getsignal(signal.SIGINT), before)
        self.assertEqual(function(2.0), 5.0)  # is compiled at the next call

    @parameterized.parameters(*interrupts.SIGNALS)
    def test_a_users_handler_is_called_once(self, number):
        received = []
        before = signal.signal(number, lambda number, frame: received.append(number))
        try:
            self.assertEqual(self._compile_and_signal(number)(2.0), 5.0)
        finally:
            signal.signal(number, before)
        self.assertEqual(received, [number])


class CacheTest(FolderTest):
    """The cache folder of the machine code, in separate processes."""

    def setUp(self):
        super().setUp()
        self.cache, self.package = self.folder / 'cache', self.folder / 'trl_suite'
        (self.package / 'util').mkdir(parents=True)
        (self.package / '__init__.py').touch()
        for path in (PACKAGE / 'util').glob('*.py'):
            shutil.copy(path, self.package / 'util')
        self.write('x * 10.0')
        (self.package / 'outer.py').write_text(OUTER)

    def write(self, expression):
        (self.package / 'inner.py').write_text(INNER.format(expression))

    def environ(self, **variables):
        kept = {k: v for k, v in os.environ.items() if not k.startswith('NUMBA_')}
        paths = {'PYTHONPATH': str(self.folder), 'HOME': str(self.folder / 'home')}
        variables = {'NUMBA_CACHE_DIR': str(self.cache), **paths, **variables}
        return {**kept, 'XDG_CACHE_HOME': '', **variables}

    def start(self, script, **variables):
        return subprocess.Popen(
            [sys.executable, '-c', textwrap.dedent(script)], stdout=subprocess.PIPE,
            stderr=subprocess.PIPE, text=True, env=self.environ(**variables), cwd=self.folder,
        )  # fmt: skip

    def ask(self, script=ASK, **variables):
        """Runs a script; returns what it prints and what it warns of."""
        running = self.start(script, **variables)
        out, told = running.communicate()
        self.assertEqual(running.returncode, 0, told)
        return out.split(), besides_notices(told)

    def folders(self, base=None):
        return sorted((base or self.cache).glob('trl_suite/kernels/*/'))

    def test_code_is_cached_per_state_of_the_sources(self):
        """Numba, which a call imports, would reuse the code of `outer`, whose file does not change."""
        loaded = 'import sys; print("numba" in sys.modules)'
        found = self.ask(
            f'from trl_suite.outer import outer; {loaded}; print(outer(1.0)); {loaded}'
        )
        self.assertEqual(found, (['False', '11.0', 'True'], ''))
        (first,) = self.folders()
        files = {path: path.stat().st_mtime_ns for path in first.iterdir()}
        self.assertNotEmpty(files)
        self.assertEqual(self.ask()[0], ['11.0'])
        self.assertEqual(files, {path: path.stat().st_mtime_ns for path in first.iterdir()})
        self.write('x * 20.0')
        self.assertEqual(self.ask()[0], ['21.0'])
        self.write('x * 10.0')
        self.assertEqual(self.ask()[0], ['11.0'])
        self.assertLen(self.folders(), 2)
        # Compiled functions hold constants of modules that have no compiled functions.
        (self.package / 'plain.py').write_text('VALUE = 1\n')
        self.ask(FOLDER)
        self.assertLen(self.folders(), 3)

    def test_only_compiling_is_told_of(self):
        """Loading code from the cache is not, nor what other users of Numba compile."""
        script = f"""
            import time, numba
            from trl_suite.util import notices
            notices.PATIENCE, notices.PAUSE = 0.0, 0.1
            {ASK}
            numba.njit(lambda x: x + 1.0)(1.0)
            time.sleep(0.5)"""
        out, told = self.start(script).communicate()
        self.assertEqual(out, '11.0\n')
        begin = f'trl_suite: {NoticeTest.COMPILING}'
        self.assertRegex(told, f'^{begin}\ntrl_suite: compiled in [0-9]+ s\n$')
        self.assertEqual(self.start(script).communicate(), ('11.0\n', ''))

    def test_the_users_cache_folder(self):
        base = self.folder / 'xdg'
        found, warned = self.ask(FOLDER, NUMBA_CACHE_DIR='', XDG_CACHE_HOME=str(base))
        self.assertEmpty(warned)
        if sys.platform == 'linux':
            self.assertEqual(found, [str(path) for path in self.folders(base)])
        self.assertFalse(self.cache.exists())

    def test_without_a_writable_folder(self):
        file = self.folder / 'file'
        file.touch()
        nowhere = dict.fromkeys(('NUMBA_CACHE_DIR', 'XDG_CACHE_HOME', 'HOME'), str(file / 'cache'))
        both = 'from trl_suite.inner import inner; print(outer(1.0), inner(2.0))'
        found, warned = self.ask(f'from trl_suite.outer import outer; {both}', **nowhere)
        self.assertEqual(found, ['11.0', '20.0'])
        self.assertEqual(warned.count('no folder for compiled code can be used'), 1)

    def test_a_full_disk(self):
        """The folder can be made, and no file be written: the code is compiled, and not kept."""
        found, warned = self.ask("""
            import resource
            from trl_suite.util import compiled
            compiled.cache_folder()
            resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
            from trl_suite.outer import outer
            print(outer(1.0))
        """)
        self.assertEqual(found, ['11.0'])
        self.assertEqual(warned.count('compiled code cannot be kept in'), 1)
        self.assertEmpty([*self.cache.rglob('*.nbc')])

    def test_damaged_files(self):
        """They are compiled and written again; see also `test_files_with_another_checksum`."""
        self.ask()
        (path,) = (path for folder in self.folders() for path in folder.iterdir())
        content = path.read_bytes()
        path.write_bytes(content[: len(content) // 2])
        self.assertEqual(self.ask(), (['11.0'], ''))
        self.assertGreater(path.stat().st_size, 0.9 * len(content))

    def test_foreign_types_are_not_cached(self):
        """A process without the module of a type could not read the index that contains it."""
        (self.folder / 'foreign.py').write_text(TUPLE.format('Foreign'))
        (self.package / 'own.py').write_text(TUPLE.format('Own') + FIRST)
        self.ask(f'{PACKED} from foreign import Foreign; print(first(packed(Foreign(np.ones(2)))))')
        (self.folder / 'foreign.py').unlink()
        self.ask(f'{PACKED} from trl_suite.own import Own; print(first(packed(Own(np.ones(2)))))')

    def test_processes_that_compile_at_once(self):
        """Each function is compiled once, also if all have one number, as in several containers."""
        script = """
            import os, pathlib, time
            os.getpid = lambda: 7
            from numba.core import event
            from trl_suite.util import compiled
            from trl_suite.outer import outer
            compiled._numba(), compiled.cache_folder()
            pathlib.Path(f'ready{time.perf_counter_ns()}').touch()
            while len(list(pathlib.Path().glob('ready*'))) < 3:
                time.sleep(0.001)
            with event.install_recorder('numba:compile') as found:
                print(outer(1.0), len(found.buffer) // 2)
        """
        ended = [each.communicate() for each in [self.start(script) for _ in range(3)]]
        self.assertEqual([out.split()[0] for out, _ in ended], ['11.0'] * 3)
        # `outer`, and `inner` as a part of it.
        self.assertEqual(sum(int(out.split()[1]) for out, _ in ended), 2)
        (path,) = (path for folder in self.folders() for path in folder.iterdir())
        self.assertEqual(path.suffix, '.nbc')
        machine_code._read(path)

    @unittest.skipIf(files.fcntl is None, 'needs locks')
    def test_a_process_that_is_killed_while_it_compiles(self):
        self.ask(FOLDER)
        holder = self.start("""
            import signal
            from numba.core import event
            from trl_suite.outer import outer

            class Compiling(event.Listener):
                def on_start(self, _):
                    print('locked', flush=True)
                    signal.pause()

                def on_end(self, _):
                    pass

            event.register('numba:run_pass', Compiling())
            outer(1.0)
        """)
        self.assertEqual(holder.stdout.readline(), 'locked\n')
        waiting = self.start(f"""
            from trl_suite.util import notices
            notices.PATIENCE = 0.1
            {ASK}
            import time; time.sleep(3)
        """)
        self.assertStartsWith(waiting.stderr.readline(), 'trl_suite: waiting for another process')
        self.assertIsNone(waiting.poll())
        holder.kill()
        holder.communicate()
        out, told = waiting.communicate()
        self.assertEqual(out, '11.0\n')
        self.assertRegex(
            told, r'^trl_suite: compiled in \d+ s, \d+ s of them by another process\n$'
        )

    @parameterized.parameters(
        *[('fork', True), ('fork', False)][: 2 * hasattr(os, 'fork')], ('spawn', True)
    )
    def test_child_processes(self, method, before):
        program = self.folder / 'program.py'
        program.write_text(textwrap.dedent(f"""
            import multiprocessing, sys
            from trl_suite.outer import outer
            def call(x):
                return outer(x)
            if __name__ == "__main__":
                value = outer(3.0) if {before} else None
                with multiprocessing.get_context({method!r}).Pool(2) as pool:
                    print(*pool.map(call, [1.0, 2.0]))
        """))  # fmt: skip
        done = subprocess.run(
            [sys.executable, program], capture_output=True, text=True, timeout=120, cwd=self.folder,
            env=self.environ(),
        )  # fmt: skip
        self.assertEqual((done.stdout.split(), done.returncode), (['11.0', '21.0'], 0), done.stderr)


class SafetyTest(FolderTest):
    """Nothing is loaded that others can have written; nothing is removed but machine code."""

    @contextlib.contextmanager
    def spoiled(self, path, how):
        """A file or a folder that others can have written."""
        if how == 'other':
            with mock.patch.object(os, 'geteuid', lambda: path.stat().st_uid + 1):
                yield
            return
        if how == 'link':
            path.symlink_to(path.rename(self.folder / 'moved'))
        elif how == 'fifo':
            path.unlink()
            os.mkfifo(path, 0o600)
        else:
            path.chmod(how)
        yield

    @parameterized.product(
        name=('trl_suite', 'trl_suite/kernels', 'trl_suite/kernels/*'),
        how=('other', 'link', 0o777, 0o730, 0o1777),
    )
    @unittest.skipUnless(hasattr(os, 'geteuid'), 'needs user ids')
    def test_folders_of_others_are_not_used(self, name, how):
        bases = first, second = self.folder / 'first', self.folder / 'second'
        umask = os.umask(0o002)
        self.addCleanup(os.umask, umask)
        for base in bases:
            for made in (base, *module._made(base).relative_to(base).parents):
                self.assertEqual((base / made).stat().st_mode & 0o777, 0o700)
            base.chmod(0o1777)  # like /tmp
        variables = {'NUMBA_CACHE_DIR': str(first), 'XDG_CACHE_HOME': str(second)}
        with (
            mock.patch.dict(os.environ, variables),
            mock.patch.object(module, '_user_cache', lambda: str(second)),
            self.spoiled(next(first.glob(name)), how),
            self.assertWarnsRegex(
                UserWarning, 'another user|by other users|is not a folder'
            ) as found,
        ):
            folder = module.cache_folder.__wrapped__()
        self.assertIn(str(first), str(found.warning))
        if how == 'other':  # owns the second one, too
            self.assertIsNone(folder)
            self.assertIn('no folder for compiled code can be used', str(found.warning))
        else:
            self.assertEqual(folder, next(second.glob('trl_suite/kernels/*')))
            self.assertIn(f'kept in {folder}', str(found.warning))

    @parameterized.parameters('other', 'link', 'fifo', 0o666, 0o620)
    @unittest.skipUnless(hasattr(os, 'geteuid'), 'needs user ids')
    def test_files_of_others_are_not_loaded(self, how):
        path = self.folder / 'code.nbc'
        path.write_bytes(hashlib.sha256(b'code').digest() + b'code')
        path.chmod(0o644)
        self.assertEqual(machine_code._read(path), b'code')
        with self.spoiled(path, how), self.assertRaises(OSError):
            machine_code._read(path)

    def test_files_with_another_checksum_are_not_loaded(self):
        path, whole = self.folder / 'code.nbc', hashlib.sha256(b'code').digest() + b'code'
        for content in (b'', whole[:20], b'x' + whole[1:], whole[:-1], whole[:-1] + b'x'):
            path.write_bytes(content)
            with self.assertRaisesRegex(ValueError, 'is damaged'):
                machine_code._read(path)

    def test_unused_code_is_removed_and_nothing_else(self):
        folder = module._made(self.folder)
        kernels, elsewhere = folder.parent, self.folder / 'elsewhere'
        old = [kernels / f'{number:016x}' for number in range(4)]
        kept = [
            self.folder / 'trl_suite-results', self.folder / f'trl_suite-{0:016x}', elsewhere,
            kernels / 'results', kernels / f'{0:017x}', kernels / f'{9:016x}',
        ]  # fmt: skip
        for path in (*old[:2], *kept):
            path.mkdir()
            (path / f'{0:032x}.nbc').touch()
        (old[1] / 'notes.txt').touch()
        old[2].symlink_to(elsewhere)
        old[3].touch()
        for path in (*old, *kept):
            unused = 0.9 if path == kept[-1] else 1.1  # the last one is in use
            os.utime(path, (0, time.time() - unused * module.UNUSED))
        module._made(self.folder)
        self.assertFalse(old[0].exists())
        self.assertEqual([path.name for path in old[1].iterdir()], ['notes.txt'])
        self.assertTrue(old[2].is_symlink() and old[3].is_file())
        for path in kept:
            self.assertLen([*path.iterdir()], 1, path)

        # The folder does not move with the process.
        self.enterContext(contextlib.chdir(self.folder))
        with mock.patch.dict(os.environ, NUMBA_CACHE_DIR='.'):
            self.assertTrue(module.cache_folder.__wrapped__().is_relative_to(os.getcwd()))

    def test_keys(self):
        """Functions and settings that give different code have different files."""
        one, two = (lambda x: x + 1.0), (lambda x: x + 2.0)  # in one line
        keys = [str(machine_code.Cache(each, self.folder)._key) for each in (one, two)]
        with mock.patch.object(numba.config, 'BOUNDSCHECK', 1):
            keys.append(str(machine_code.Cache(two, self.folder)._key))
        self.assertLen(set(keys), 3)


class DisabledTest(parameterized.TestCase):
    """Environments return the same numbers if their rules run as Python."""

    SCRIPT = """
        import hashlib, sys
        import numpy as np
        from trl_suite import suite
        from trl_suite.vector import VectorEnvironment
        def digest(id_):
            environment = suite.make(id_, {'random': 3, 'step_limit': 3}, {'flat_observation': True})
            many = VectorEnvironment(id_, 2, 1, 7, step_limit=3)
            draw, size = np.random.default_rng(0), len(many.action_map)
            found = [environment.reset().observation['observations'], many.reset()]
            for _ in range(5):
                time_step = environment.step(draw.uniform(-1, 1, size))
                found += [time_step.observation['observations'], np.float64(time_step.reward or 0)]
                found += many.step(draw.uniform(-1, 1, (2, size)))[:4]
            return hashlib.sha256(b''.join(array.tobytes() for array in found)).hexdigest()
    """

    IDS = (
        'PD_Biped2D_Gaps_Terrain-v0', 'PD_Biped2D_LLC_Flat_Step-v0', 'FSM_Hopper2D_Terrain_Gaps-v0',
        'PD_Biped3D_Imitate-Hills_Terrain-v0', 'PD_Biped3D_LLC_Symetric_Step-v0',
        'PD_Biped3D_HLC_DynamicsObstacles-v0', 'PD_Biped3D_Terrain_Soccer_Hard-v0',
    )  # fmt: skip

    def test_results_are_equal_without_compilation(self):
        script, here = textwrap.dedent(self.SCRIPT), {}
        exec(script, here)  # compiled, in this process
        found = subprocess.run(
            [sys.executable, '-c', f'{script}print(*map(digest, {self.IDS}))'], capture_output=True,
            text=True, check=True, env={**os.environ, 'NUMBA_DISABLE_JIT': '1'},
        ).stdout.split()  # fmt: skip
        self.assertLen(found, len(self.IDS))
        for id_, digest in zip(self.IDS, found, strict=True):
            with self.subTest(id_):
                self.assertEqual(digest, here['digest'](id_))


MOTORS = {
    'actuators': {'torque_speed': True, 'torque_pose': True, 'delay': (0, 40), 'noise': 0.1},
}
WORLDS = {'randomize': 'harsh', 'sensors': {'preset': 'harsh', 'delay': (0, 4)}}
# An environment of each task type, and options that have compiled functions of their own.
EXTREME = {
    'planar_imitation': ('PD_Dog2D_Mixed_Terrain-v0', {}),
    'spatial_imitation': ('PD_Biped3D_Imitate-Stairs_Terrain-v0', WORLDS),
    'planar_footsteps': ('PD_Biped2D_LLC_Flat_Step-v0', MOTORS),
    'spatial_footsteps': ('PD_Biped3D_LLC_Trail_Step-v0', MOTORS),
    'goal_navigation': ('PD_Biped3D_HLC_DynamicsObstacles-v0', WORLDS),
    'soccer': ('PD_Biped3D_HLC_Soccer-v0', {}),
    'direct_navigation': ('PD_Biped3D_Terrain_Forest_Hard-v0', {}),
    'direct_soccer': ('PD_Biped3D_Terrain_Soccer_Hard-v0', {}),
    'gait': ('FSM_Biped2D_Terrain_Stairs_Rugged-v0', WORLDS),
    'planar_walk': (('dog', 'mixed'), {'terrain_observation': 50}),
    'spatial_walk': (('biped3d', 'conveyor3d'), {'terrain_observation': 'height'}),
}
VALUES = (1e3, -9999.0, 999_999.0, -1e6, 1e9, -1e300, np.nan, np.inf)


def extreme_states(task):
    """Yields the arrays, columns and values of extreme states."""
    world, figure, spatial = task.world, task.body, task.character.spec.spatial
    position, velocity = 7 if spatial else 3, 6 if spatial else 3  # columns of the root
    turn = figure.pose_qpos[3:7] if spatial else figure.pose_qpos[2:3]
    yield world.qpos, turn, (0, 1, 0, 0) if spatial else np.pi  # upside down
    for value in VALUES:
        yield world.qpos, figure.pose_qpos[:1], value  # x
        yield world.qpos, figure.pose_qpos[1:2], value  # y, in the plane z
        yield world.qpos, figure.pose_qpos[:2], value
        yield world.qpos, turn, value
        yield world.qpos, figure.pose_qpos[position:], value
        yield world.qvel, figure.pose_dof[:1], value
        yield world.qvel, figure.pose_dof[:velocity], value
        yield world.qvel, slice(None), value
        yield world.ctrl, slice(None), value


def survive(task_type):
    """Sets extreme states in one of two simulations; what comes back must be finite."""
    which, options = EXTREME[task_type]
    if isinstance(which, tuple):
        which = suite.combine(which[0], terrain=which[1], task='walk')
    many = VectorEnvironment(
        which, 2, 1, 3, autoreset='disabled', flat_observation=True, task_kwargs=options
    )
    idle = np.zeros((2, len(many.action_map)))
    states = itertools.product((True, False), list(extreme_states(many.task)))
    for forward, (array, columns, value) in states:
        assert np.isfinite(many.reset()).all()
        array[1, columns] = value
        if forward:
            many.task.world.forward(many.task.world.all_ids)
        for _ in range(2):
            step = many.step(idle)
            finite = np.isfinite(step.observation).all() and np.isfinite(step.reward).all()
            assert finite, (columns, value, forward)
            many.reset(step.terminated | step.truncated)


@pytest.mark.slow
class BoundsCheckTest(parameterized.TestCase):
    """No index of compiled code depends on a state of the physics without being checked."""

    @classmethod
    def setUpClass(cls):
        super().setUpClass()
        folder = cls.enterClassContext(tempfile.TemporaryDirectory())
        cls.environ = {
            **os.environ, 'NUMBA_BOUNDSCHECK': '1', 'NUMBA_CACHE_DIR': folder,
            'PYTHONPATH': os.pathsep.join([*sys.path, str(pathlib.Path(__file__).parent)]),
        }  # fmt: skip

    def ended(self, script):
        """Returns status and messages of a process that checks indices."""
        script = f'import warnings; warnings.simplefilter("ignore"); from compiled_test import *; {script}'
        found = subprocess.run(
            [sys.executable, '-c', script], capture_output=True, text=True, env=self.environ
        )
        return found.returncode, found.stderr

    def test_a_wrong_index_raises_an_error(self):
        status, messages = self.ended(
            'scale_all(np.array([0, 3]), packed(Pair(*np.zeros((2, 3)))))'
        )
        self.assertIn('IndexError: index is out of bounds', messages)
        self.assertEqual(status, 1)

    @parameterized.parameters(*TASK_TYPES)
    def test_extreme_states(self, task_type):
        status, messages = self.ended(f'survive({task_type!r})')
        self.assertEqual(status, 0, messages)
