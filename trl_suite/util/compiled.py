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
infinity or NaN, as in NumPy. Indices are not checked: arrays that users give are checked before, and
an index is computed from a state of the physics by `nearest_index`. With `NUMBA_BOUNDSCHECK=1` a wrong
index raises an IndexError. It runs without the global interpreter lock.

A small function that is called in an inner loop is decorated with `compiled_inline`: it is inlined
in every caller. Python passes tuples of arrays to loops over simulations as packs, see `packed`.

Numba is imported and a function is compiled when it is first called from Python, as one piece of code
with all that it calls. Its machine code is kept in the folder trl_suite/kernels/HASH in
`$NUMBA_CACHE_DIR`, or else in the user's cache folder; HASH depends on all sources of the package,
since compiled functions contain constants and code of other modules. Folders are used only if they
belong to the user and nobody else can write there, because loading machine code runs it; files are
checked, and functions that another process compiles are waited for, as `trl_suite.util.machine_code`
says. Without such a folder every process compiles the functions again, as it does with those that
have free variables or no source file. With `NUMBA_DISABLE_JIT=1` the same code runs as Python, for
debugging.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import importlib.metadata
import os
import pathlib
import re
import stat
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from trl_suite.util import files, interrupts

UNUSED = 30 * 86400.0  # s; machine code of other source versions unused for longer is removed
AS_PYTHON = os.environ.get('NUMBA_DISABLE_JIT', '0') not in ('', '0')


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

    def _make(self, entry: bool) -> Callable[..., Any]:
        with self._lock:
            if entry not in self._made:
                self._made[entry] = self._compile(entry)
            return self._made[entry]

    def _compile(self, entry: bool) -> Callable[..., Any]:
        numba = _numba()
        if numba.config.DISABLE_JIT:
            return self.function
        from trl_suite.util import machine_code

        options: dict[str, Any] = {'nogil': True, 'error_model': 'numpy'}
        options |= {'forceinline': self._inline, 'no_cfunc_wrapper': True}
        if not entry:
            options |= {'no_cpython_wrapper': True, 'pipeline_class': machine_code.PartCompiler}
        function = self.function if self._native is None else self._native()
        own, code = function is self.function, self.function.__code__
        dispatcher = numba.njit(function, _nrt=not own, **options)
        if not entry:
            machine_code.compile_once(dispatcher)
        elif own and not code.co_freevars and os.path.isfile(code.co_filename):
            machine_code.Cache(self.function, cache_folder()).attach(dispatcher)
        return dispatcher

    def __call__(self, *args: Any) -> Any:
        return (self._made.get(True) or self._make(True))(*args)


def compiled(function: Callable[..., Any], inline: bool = False) -> Any:
    """Decorates a function of one simulation, or a loop over simulations."""
    if AS_PYTHON:  # so that a debugger steps from function to function, in classes as well
        return staticmethod(function)
    return Compiled(function, inline=inline)


def compiled_inline(function: Callable[..., Any]) -> Any:
    """Decorates a small function that other compiled functions call in inner loops."""
    return compiled(function, inline=True)


@compiled_inline
def nearest_index(number: float, count: int) -> int:
    """Returns a number rounded down and clamped to 0, 1, ..., count - 1; 0 for NaN.

    In compiled code, `int`, `math.floor` and `math.ceil` of NaN and of huge numbers are undefined.
    """
    if not number > 0.0:
        return 0
    return int(number) if number < count - 1 else count - 1


def packed(value: Any) -> Any:
    """Converts a named tuple of arrays and numbers to one argument; see `trl_suite.util.pack`.

    Compiled functions read its fields by name, as from the tuple. With `NUMBA_DISABLE_JIT=1` the
    tuple itself is returned. The pack keeps the arrays alive.
    """
    if _numba().config.DISABLE_JIT:
        return value
    from trl_suite.util.pack import Pack

    return Pack(value)


# Memory at addresses.


def address(array: np.ndarray) -> int:
    """Returns the address of the first number of an array; the caller keeps the array alive."""
    return array.__array_interface__['data'][0]


def _array_at(kind: str) -> Compiled:
    """Returns a function from an address and a length to an array of that memory."""

    def array_at(address: int, count: int) -> np.ndarray:
        memory: Any = (ctypes.c_byte * (8 * int(count))).from_address(int(address))
        return np.ndarray(int(count), kind, memory)

    def native() -> Callable[..., Any]:
        from numba import carray, types
        from numba.extending import intrinsic

        def pointer(typing: Any, address: Any) -> Any:
            def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
                return builder.inttoptr(args[0], context.get_value_type(signature.return_type))

            return types.CPointer(getattr(types, kind))(types.int64), generate

        to: Any = intrinsic(pointer)
        return lambda address, count: carray(to(address), (count,))

    return Compiled(array_at, native)


floats_at, ints_at = _array_at('float64'), _array_at('int32')


@compiled
def copy_floats(target: int, source: int, count: int) -> None:
    """Copies numbers from one address to another."""
    to, of = floats_at(target, count), floats_at(source, count)
    for k in range(count):
        to[k] = of[k]


@functools.cache
def _numba() -> Any:
    """Imports Numba, postpones interrupts while it compiles, and registers the type of `Compiled`."""
    with interrupts.postponed():
        import numba
        from numba.extending import typeof_impl

    interrupts.postpone_while_compiling()

    @typeof_impl.register(Compiled)
    def type_of(value: Compiled, _: Any) -> Any:
        return numba.types.Dispatcher(value.dispatcher)

    return numba


@functools.cache
def cache_folder() -> pathlib.Path | None:
    """Returns the folder of the machine code of these sources, which is made if necessary.

    If the first choice cannot be used, a warning is issued once; if none can, None is returned.
    """
    refused = []
    for base in filter(None, (os.environ.get('NUMBA_CACHE_DIR'), _user_cache())):
        try:
            folder = _made(pathlib.Path(base).absolute())
        except OSError as error:
            refused.append(str(error))
            continue
        if refused:
            warnings.warn(f'{refused[0]}; compiled code is kept in {folder}', stacklevel=2)
        return folder
    warnings.warn(
        'no folder for compiled code can be used, so every process compiles it again; set '
        f'NUMBA_CACHE_DIR to a folder of your own ({"; ".join(refused)})',
        stacklevel=2,
    )
    return None


def _made(base: pathlib.Path) -> pathlib.Path:
    """Makes the folder below a base.

    Others may write to the base. They could only replace our folder by one that is not ours.
    """
    base.mkdir(0o700, parents=True, exist_ok=True)
    folder = base
    for name in ('trl_suite', 'kernels', fingerprint()):
        folder /= name
        with contextlib.suppress(FileExistsError):
            folder.mkdir(0o700)
        status = folder.lstat()
        if not stat.S_ISDIR(status.st_mode):
            raise NotADirectoryError(f'{folder} is not a folder')
        files.check_own(folder, status)
    with tempfile.TemporaryFile(dir=folder):
        pass
    os.utime(folder)
    _forget(folder)
    return folder


def _user_cache() -> str:
    if sys.platform == 'win32':
        return os.environ.get('LOCALAPPDATA', '')
    if sys.platform == 'darwin':
        return os.path.expanduser('~/Library/Caches')
    found = os.environ.get('XDG_CACHE_HOME') or os.path.expanduser('~/.cache')
    return '' if found.startswith('~') else found  # a user without a home


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


fingerprint()  # of the sources that this process imports, which may change before it compiles


def _forget(folder: pathlib.Path) -> None:
    """Removes the machine code of source versions that were unused for longer than `UNUSED`."""
    for path in folder.parent.iterdir():
        with contextlib.suppress(OSError):  # removed by another process, or not empty
            status = path.lstat()
            own = stat.S_ISDIR(status.st_mode) and re.fullmatch('[0-9a-f]{16}', path.name)
            if own and status.st_mtime < time.time() - UNUSED:
                for file in (*path.glob('*.nbc'), *path.glob('*.lock')):
                    file.unlink()
                path.rmdir()
