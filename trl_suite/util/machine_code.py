"""Machine code of functions that Python calls, and its files: of this user, complete, unchanged.

The functions that they call become parts of their code: these are optimised together, once, and have
no machine code and no files of their own.

A file holds the code of one function for one signature: the SHA-256 of what follows, and a pickle. Its
name is a hash of what the code depends on: its file, Numba and Python, apart from the sources of the
package, on which the name of the folder depends. Other files of a user are not in it. What is missing,
damaged, or may be written by others is compiled again.

Two processes that need the same code at the same time do not both compile it: one holds a lock, which
the operating system releases when the process ends in any way, and the other waits. There are no
locks on Windows, and none on file systems without them.

Numba's own files have no checksum, and two processes that compile a function for two signatures
can write two entries of its index for one file.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import gc
import hashlib
import os
import pathlib
import pickle
import stat
import sys
import time
import types
import warnings
from collections.abc import Callable
from typing import Any, cast

import numba
from numba.core.caching import NullCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, CompileResult
from numba.core.compiler_lock import global_compiler_lock
from numba.core.serialize import dumps

from trl_suite.util import files, interrupts, notices

limit = 120.0  # s; a process that waits longer for a function compiles it, and waits for no other
_TICK = 0.05  # s between two looks at a lock
_FLAGS = sum(getattr(os, name, 0) for name in ('O_NOFOLLOW', 'O_NONBLOCK', 'O_BINARY'))


class _Part(JITCodeLibrary):
    """Code that becomes part of the code of callers: it is neither optimised nor executed alone."""

    codegen = types.SimpleNamespace(set_env=lambda name, environment: None)

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        return 0


class PartCompiler(Compiler):
    """Compiles functions that only compiled functions call."""

    def __init__(self, typing_context: Any, target_context: Any, library: Any, *rest: Any) -> None:
        library = library or _Part(target_context.codegen(), 'part')
        super().__init__(typing_context, target_context, library, *rest)


def compile_once(dispatcher: Any) -> None:
    """Makes a dispatcher use the same code for all constants of a type in calls.

    Numba would compile `f(i, True)` and `f(i, False)` separately.
    """
    compile_ = dispatcher.compile
    dispatcher.compile = lambda signature: compile_(tuple(map(numba.types.unliteral, signature)))


class Cache(NullCache):
    """What a dispatcher of Numba asks for the code of a function before it compiles it."""

    def __init__(self, function: Callable[..., Any], folder: pathlib.Path | None) -> None:
        """Prepares the cache of a function without free variables, which is in a file.

        Args:
          function: the Python function.
          folder: where the files are; None if code is not kept.
        """
        code, config = function.__code__, cast(Any, numba.config)
        self._folder = folder
        compiler = numba.__version__, config.OPT, config.BOUNDSCHECK, sys.version
        place = code.co_filename, _digest(code.co_filename), function.__qualname__
        self._key = (*compiler, *place, [*code.co_positions()])

    def attach(self, dispatcher: Any) -> None:
        """Makes a dispatcher use this cache."""
        dispatcher._cache = self  # noqa: SLF001
        dispatcher.compile = functools.partial(_loaded_or_compiled, dispatcher.compile)

    def _path(self, signature: Any, codegen: Any) -> pathlib.Path | None:
        if self._folder is None:
            return None
        key = repr((self._key, str(signature), codegen.magic_tuple()))
        return self._folder / f'{hashlib.sha256(key.encode()).hexdigest()[:32]}.nbc'

    def load_overload(self, sig: Any, target_context: Any) -> CompileResult | None:
        """Returns the code for a signature, or None, after which Numba compiles it."""
        target_context.refresh()
        path = self._path(sig, target_context.codegen())
        found = _load(path, sig, target_context)
        if found is None:
            _begin(path)
            found = _load(path, sig, target_context)  # another process may have compiled it
        return found

    def save_overload(self, sig: Any, cres: Any) -> None:
        """Writes the code for a signature; if that fails, a warning is issued once."""
        path = self._path(sig, cres.codegen)
        if path is None or cres.library.has_dynamic_globals:  # addresses in this process
            return
        with interrupts.postponed():
            content = dumps((sig, cres._reduce()))  # noqa: SLF001
            try:
                with files.replacing(path) as part:
                    part.touch(0o600)
                    part.write_bytes(hashlib.sha256(content).digest() + content)
            except OSError as error:
                # On Windows a file that another process reads cannot be replaced.
                if os.name != 'nt' or error.errno != errno.EACCES:
                    _warn(path.parent, error.strerror)


def _load(path: pathlib.Path | None, signature: Any, target_context: Any) -> CompileResult | None:
    if path is None:
        return None
    with interrupts.postponed():
        try:
            known, code = pickle.loads(_read(path))
            if known != signature:  # types of the same names
                return None
            return CompileResult._rebuild(target_context, *code)  # noqa: SLF001
        except Exception:  # no such file, a damaged one, or one with types that are gone
            return None


# What ends with the compilation of a function: its lock, and the notice.
_held = contextlib.ExitStack()


def _loaded_or_compiled(compile_: Callable[[Any], Any], signature: Any) -> Any:
    """Calls the method `compile` of a dispatcher, and ends what it has begun."""
    with global_compiler_lock:  # only one thread compiles
        collects = gc.isenabled()
        try:
            gc.disable()  # collections take a sixth of the time, and find little
            return compile_(signature)
        finally:
            if collects:
                gc.enable()
            _held.close()


def _begin(path: pathlib.Path | None) -> None:
    notices.compiling.begin()
    _held.callback(notices.compiling.end)
    if path is not None:
        _wait(path.with_suffix('.lock'))


def _wait(path: pathlib.Path) -> None:
    """Locks a function, as soon as no other process has the lock."""
    global limit
    until = time.monotonic() + limit
    while True:
        try:
            _held.enter_context(files.locked(path, 'compiles it'))
            return
        except OSError:  # the file cannot be written
            return
        except RuntimeError:
            if time.monotonic() >= until:
                limit = 0.0
                return
        with notices.compiling.waiting():
            time.sleep(_TICK)
        interrupts.deliver()


@functools.cache
def _digest(file: str) -> bytes:
    return hashlib.sha256(pathlib.Path(file).read_bytes()).digest()


def _read(path: pathlib.Path) -> bytes:
    """Returns the content of a file after its checksum."""
    with open(os.open(path, os.O_RDONLY | _FLAGS), 'rb') as file:
        status = os.fstat(file.fileno())  # of the file that is read, whatever the path leads to now
        if not stat.S_ISREG(status.st_mode):
            raise OSError(f'{path} is not a regular file')
        files.check_own(path, status)
        digest, content = file.read(32), file.read()
    if hashlib.sha256(content).digest() != digest:
        raise ValueError(f'{path} is damaged')
    return content


@functools.cache
def _warn(folder: pathlib.Path, reason: str | None) -> None:
    warnings.warn(
        f'compiled code cannot be kept in {folder}, so every process compiles it again: {reason}',
        stacklevel=2,
    )
