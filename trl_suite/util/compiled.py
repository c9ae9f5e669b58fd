"""Functions of one simulation that Numba compiles, and the cache folder of the machine code.

    @compiled
    def has_fallen(i, contacts):
        for k in range(contacts.shape[1]):
            if contacts[i, k] > 0:
                return True
        return False

A compiled function takes numbers, arrays and (named) tuples of them, and returns numbers or tuples of
numbers. It may call other compiled functions and `math`. It must not allocate memory: Numba raises
an error for a function that does, since reference counting is disabled (it would cost more than
most functions, and threads would contend for the counts). It never raises: a division by zero gives
infinity or NaN, as in NumPy. Indices are not checked. It runs without the global interpreter lock.

A small function that is called in an inner loop is decorated with `compiled_inline`: it is inlined
in every caller. Loops over simulations, which Python calls, are decorated with `compiled_loop`;
tuples of arrays are passed to them as packs, see `packed`.

Numba is imported and a function is compiled when it is first called; the result is cached on disk.
The cache is in `$NUMBA_CACHE_DIR`, or else in the user's cache folder, with one subfolder for each
version of the package's sources, since Numba does not detect changes of functions in other modules.
If no folder can be written, every process compiles the functions again; so it does where files of
the cache are damaged. With `NUMBA_DISABLE_JIT=1`
the same code runs as Python, for debugging.
"""

from __future__ import annotations

import contextlib
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
from collections.abc import Callable
from typing import Any

from trl_suite.util import interrupts

PATIENCE = 2.0  # s; if compiling takes longer, a message is printed if stderr is a terminal
UNUSED = 30 * 86400.0  # s; folders of other source versions that were unused for longer are removed
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
          function: compiled, or called as Python if compiling is disabled.
          native: returns a function that is compiled instead, e.g. one that uses Numba intrinsics.
          inline: whether callers inline the function.
        """
        functools.update_wrapper(self, function)
        self.function, self._native = function, native
        self._inline = inline
        self._lock = threading.Lock()
        self._made: dict[bool, Callable[..., Any]] = {}

    @property
    def dispatcher(self) -> Callable[..., Any]:
        """The Numba dispatcher for compiled callers; the function itself if compiling is disabled."""
        return self._made.get(False) or self._make(False)

    @property
    def entry(self) -> Callable[..., Any]:
        """The compiled function for Python callers."""
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
        if not entry:  # wrappers for calls from Python take half of the compile time
            options['no_cpython_wrapper'] = options['no_cfunc_wrapper'] = True
        if self._native is not None:  # not cached, since it is short; its callers are cached
            return numba.njit(self._native(), _nrt=True, **options)
        options['_nrt'] = False
        folder = cache_folder()
        if folder is None:
            return numba.njit(self.function, **options)
        # Numba reads CACHE_DIR when a function is decorated; afterwards the user's value is
        # restored.
        with _setting:
            # Two folders, since Numba cannot distinguish functions with and without wrappers.
            folder = folder / ('entries' if entry else 'rows')
            before, numba.config.CACHE_DIR = numba.config.CACHE_DIR, str(folder)
            try:
                return _forgiving(numba.njit(self.function, cache=True, **options))
            except RuntimeError:  # the function has no source file, e.g. in an interactive session
                return numba.njit(self.function, **options)
            finally:
                numba.config.CACHE_DIR = before

    def __call__(self, *args: Any) -> Any:
        return self.entry(*args)


def compiled(function: Callable[..., Any]) -> Compiled:
    """Decorates a function of one simulation, or a loop over simulations."""
    return Compiled(function)


def compiled_inline(function: Callable[..., Any]) -> Compiled:
    """Decorates a small function that other compiled functions call in inner loops."""
    return Compiled(function, inline=True)


def compiled_loop(function: Callable[..., Any]) -> Compiled:
    """Decorates a loop over simulations that Python calls with packs; see `packed`."""
    return Compiled(function)


def packed(value: Any) -> Any:
    """Converts a named tuple of arrays and numbers to one argument; see `trl_suite.util.pack`.

    Compiled functions read its fields by name, as from the tuple. With `NUMBA_DISABLE_JIT=1` the
    tuple itself is returned. The pack keeps the arrays alive.

    Raises:
      TypeError: a field is not an array, a number, or a named tuple of these.
    """
    if _numba().config.DISABLE_JIT:
        return value
    from trl_suite.util.pack import Pack

    return Pack(value)


def _forgiving(function: Any) -> Any:
    """Lets a function of Numba compile where its cache is damaged or cannot be written.

    Numba would raise: `OSError` on a full disk, and errors of unpickling after a file was cut off.
    """
    cache = function._cache  # noqa: SLF001
    load, save = cache.load_overload, cache.save_overload

    def load_or_compile(*args: Any) -> Any:
        try:
            return load(*args)
        except Exception:  # unpickling a damaged file raises many types of exceptions
            with contextlib.suppress(OSError):
                cache.flush()
            return None

    def save_if_possible(*args: Any) -> None:
        try:
            save(*args)
        except OSError as error:
            _warn_of_cache(str(error))

    cache.load_overload, cache.save_overload = load_or_compile, save_if_possible
    return function


@functools.cache
def _warn_of_cache(reason: str) -> None:
    warnings.warn(
        f'compiled code cannot be kept in {cache_folder()}, so every process compiles it again: '
        f'{reason}',
        stacklevel=2,
    )


_setting = threading.Lock()


@functools.cache
def _numba() -> Any:
    """Imports Numba, postpones interrupts while it compiles, and registers the type of `Compiled`."""
    import numba
    from numba.core import event
    from numba.extending import typeof_impl

    interrupts.postpone_while_compiling()
    announcer = _Announcer()

    def is_own(event: Any) -> bool:  # or else it is of another user of Numba in this process
        return event.data['dispatcher'].py_func.__module__.startswith('trl_suite.')

    class Listener(event.Listener):
        def on_start(self, event: Any) -> None:
            if is_own(event):
                announcer.begin()

        def on_end(self, event: Any) -> None:
            if is_own(event):
                announcer.end()

    event.register('numba:compile', Listener())  # none for code that is loaded from the cache

    @typeof_impl.register(Compiled)
    def type_of(value: Compiled, _: Any) -> Any:
        return numba.types.Dispatcher(value.dispatcher)

    return numba


@functools.cache
def cache_folder() -> pathlib.Path | None:
    """Returns the cache folder for these sources, creating it if necessary.

    If no folder can be written, returns None and issues a warning once.
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
        'no folder for compiled code is writable, so every process compiles it again; set '
        'NUMBA_CACHE_DIR to a writable folder',
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
    """Returns a hash of everything that the machine code depends on: sources and MuJoCo's version.

    All sources count, since compiled functions contain constants from other modules.
    """
    digest = hashlib.sha256(importlib.metadata.version('mujoco').encode())
    root = pathlib.Path(__file__).parents[1]
    for path in sorted(root.rglob('*.py')):
        digest.update(f'\0{path.relative_to(root)}\0'.encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def _forget(folder: pathlib.Path) -> None:
    """Removes folders of other source versions that were unused for longer than `UNUSED`."""
    for path in folder.parent.glob(f'{_PREFIX}*'):
        try:
            unused = path.stat().st_mtime < time.time() - UNUSED
        except OSError:  # removed by another process
            continue
        if unused:
            shutil.rmtree(path, ignore_errors=True)


class _Announcer:
    """Prints a message, once per process, if compiling takes long and stderr is a terminal."""

    def __init__(self) -> None:
        self._spent, self._begun, self._depth, self._told = 0.0, 0.0, 0, False
        self._timer: threading.Timer | None = None

    def begin(self) -> None:
        """A function is about to be compiled; calls may be nested."""
        self._depth += 1
        if self._depth > 1 or self._told:
            return
        self._begun = time.monotonic()
        self._timer = threading.Timer(max(PATIENCE - self._spent, 0.0), self._tell)
        self._timer.daemon = True
        self._timer.start()

    def end(self) -> None:
        """The function is compiled; its time is added to that of earlier ones."""
        self._depth = max(self._depth - 1, 0)  # an interrupt may have come before `begin` counted
        if self._depth == 0 and self._timer is not None:
            self._timer.cancel()
            self._timer = None
            self._spent += time.monotonic() - self._begun

    def _tell(self) -> None:
        self._told = True
        if sys.stderr.isatty():
            print(
                'trl_suite: compiling for this machine, once; the first steps of each kind of '
                'environment take some seconds',
                file=sys.stderr,
                flush=True,
            )
