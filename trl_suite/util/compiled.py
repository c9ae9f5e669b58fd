"""Functions of one simulation that Numba compiles, and the folder where the machine code is kept.

    @compiled
    def has_fallen(i, contacts):
        for k in range(contacts.shape[1]):
            if contacts[i, k] > 0:
                return True
        return False

A compiled function takes numbers, arrays and (named) tuples of them, and returns numbers or tuples of
numbers. It may call other compiled functions and `math`, allocates nothing (Numba refuses to compile
one that does, since arrays are not reference-counted: counting costs more than most functions do, and
threads would wait for each other's counts), and never raises: a division by zero gives infinity or
NaN, as in NumPy. Indices are not checked. It runs without the interpreter's lock.

A small function that is called in an inner loop is decorated with `compiled_inline`: its code takes the
place of every call. Loops over simulations, which Python calls, are decorated with `compiled_loop`.
Tuples of arrays enter them as packs, see `packed`.

Numba is imported and the function is compiled when it is first called; the result is kept on disk.
The folder is `$NUMBA_CACHE_DIR`, or else the user's cache folder, and in it one folder for each state
of the package's sources, since Numba does not notice that a function called from another module has
changed. Where no folder can be written, functions are compiled by every process anew. With
`NUMBA_DISABLE_JIT=1` the same lines run as Python, for debugging.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import os
import pathlib
import shutil
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

PATIENCE = 2.0  # s; compiling that takes longer is announced on a terminal
UNUSED = 30 * 86400.0  # s; folders of other sources that nobody used for so long are removed
_PREFIX = 'trl_suite-'


class Compiled:
    """A function that is compiled when it is first called.

    Attributes:
      function: the Python function.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        native: Callable[[], Callable[..., Any]] | None = None,
        inline: bool = False,
    ) -> None:
        """Wraps a function.

        Args:
          function: what runs if compiling is switched off, and what is compiled otherwise.
          native: returns what is compiled in its place: for what only Numba can express.
          inline: whether its code takes the place of calls.
        """
        functools.update_wrapper(self, function)
        self.function, self._native = function, native
        self._inline = inline
        self._lock = threading.Lock()
        self._made: dict[bool, Callable[..., Any]] = {}

    @property
    def dispatcher(self) -> Callable[..., Any]:
        """What Numba made of the function for compiled callers; the function itself without Numba."""
        return self._made.get(False) or self._make(False)

    @property
    def entry(self) -> Callable[..., Any]:
        """What Python calls."""
        return self._made.get(True) or self._make(True)

    def _make(self, entry: bool) -> Callable[..., Any]:
        with self._lock:
            if entry not in self._made:
                self._made[entry] = self._compile(entry)
            return self._made[entry]

    def _compile(self, entry: bool) -> Callable[..., Any]:
        numba = _numba()
        if numba.config.DISABLE_JIT:
            return self.function
        options = {'nogil': True, 'error_model': 'numpy', 'forceinline': self._inline}
        if not entry:  # what takes arguments from Python is half of the time that compiling takes
            options['no_cpython_wrapper'] = options['no_cfunc_wrapper'] = True
        if self._native is not None:  # a line or two; what calls it is kept on disk
            return numba.njit(self._native(), _nrt=True, **options)
        options['_nrt'] = False
        folder = cache_folder()
        if folder is None:
            return numba.njit(self.function, **options)
        # Numba looks at its setting when a function is decorated; it is the user's otherwise.
        with _setting:
            # Apart, since Numba takes the one with and the one without an entry for the same.
            folder = folder / ('entries' if entry else 'rows')
            before, numba.config.CACHE_DIR = numba.config.CACHE_DIR, str(folder)
            try:
                return numba.njit(self.function, cache=True, **options)
            except RuntimeError:  # no file: a function that was typed in
                return numba.njit(self.function, **options)
            finally:
                numba.config.CACHE_DIR = before

    def __call__(self, *args: Any) -> Any:
        entry = self._made.get(True)
        if entry is not None:
            return entry(*args)
        with _announcer.compiling():  # at the first call
            return self.entry(*args)


def compiled(function: Callable[..., Any]) -> Compiled:
    """Decorates a function of one simulation, or a loop over simulations."""
    return Compiled(function)


def compiled_inline(function: Callable[..., Any]) -> Compiled:
    """Decorates a small function that other compiled functions call in inner loops."""
    return Compiled(function, inline=True)


def compiled_loop(function: Callable[..., Any]) -> Compiled:
    """Decorates a loop over simulations, which Python calls; it takes packs, see `packed`."""
    return Compiled(function)


def packed(value: Any) -> Any:
    """Returns a named tuple of arrays and numbers as one argument; see `trl_suite.util.pack`.

    Compiled functions read its fields by name, as they would of the tuple, which stands for itself
    where functions run as Python. The arrays stay alive as long as the pack.

    Raises:
      TypeError: a field is neither an array, nor a number, nor such a tuple.
    """
    if _numba().config.DISABLE_JIT:
        return value
    from trl_suite.util.pack import Pack

    return Pack(value)


_setting = threading.Lock()


@functools.cache
def _numba() -> Any:
    """Numba, which is told how to treat `Compiled` objects that compiled functions refer to."""
    import numba
    from numba.extending import typeof_impl

    @typeof_impl.register(Compiled)
    def type_of(value: Compiled, _: Any) -> Any:
        return numba.types.Dispatcher(value.dispatcher)

    return numba


@functools.cache
def cache_folder() -> pathlib.Path | None:
    """Returns the folder of the machine code of these sources, made if need be; None if it cannot be.

    A warning is issued once if there is none.
    """
    for base in (os.environ.get('NUMBA_CACHE_DIR'), _user_cache()):
        if not base:
            continue
        folder = pathlib.Path(base) / f'{_PREFIX}{fingerprint()}'
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                pass
        except OSError:
            continue
        os.utime(folder)
        _forget(folder)
        return folder
    warnings.warn(
        'no folder for compiled code can be written, so every process compiles anew; set '
        'NUMBA_CACHE_DIR to one that can',
        stacklevel=2,
    )
    return None


def _user_cache() -> str:
    if sys.platform == 'win32':
        return os.environ.get('LOCALAPPDATA', '')
    if sys.platform == 'darwin':
        return os.path.expanduser('~/Library/Caches')
    return os.environ.get('XDG_CACHE_HOME') or os.path.expanduser('~/.cache')


@functools.cache
def fingerprint() -> str:
    """Returns a name for all that the machine code depends on: the package's sources, and MuJoCo.

    All sources, since compiled functions hold constants from modules that have none of their own.
    """
    digest = hashlib.sha256(importlib.metadata.version('mujoco').encode())
    root = pathlib.Path(__file__).parents[1]
    for path in sorted(root.rglob('*.py')):
        digest.update(f'\0{path.relative_to(root)}\0'.encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def _forget(folder: pathlib.Path) -> None:
    """Removes the folders of other sources that were not used for long."""
    for path in folder.parent.glob(f'{_PREFIX}*'):
        try:
            unused = path.stat().st_mtime < time.time() - UNUSED
        except OSError:  # another process was faster
            continue
        if unused:
            shutil.rmtree(path, ignore_errors=True)


class _Announcer:
    """Says on a terminal, once in a process, that compiling takes long."""

    def __init__(self) -> None:
        self.spent, self.told = 0.0, False
        self._lock = threading.Lock()

    @contextmanager
    def compiling(self) -> Iterator[None]:
        """Counts the time that is spent inside; tells of it once it is longer than `PATIENCE`."""
        timer = threading.Timer(max(PATIENCE - self.spent, 0.0), self._tell)
        timer.daemon = True
        begun = time.monotonic()
        timer.start()
        try:
            yield
        finally:
            timer.cancel()
            self.spent += time.monotonic() - begun

    def _tell(self) -> None:
        with self._lock:
            told, self.told = self.told, True
        if not told and sys.stderr.isatty():
            print(
                'trl_suite: compiling for this machine, once; the first steps of each kind of '
                'environment take some seconds',
                file=sys.stderr,
                flush=True,
            )


_announcer = _Announcer()
