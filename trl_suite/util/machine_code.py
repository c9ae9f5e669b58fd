"""The files of machine code: written by this user, complete, and unchanged since.

A file holds the code of one function for one signature: the SHA-256 of what follows, and a pickle. Its
name is a hash of all that the code depends on, apart from the sources of the package, on which the
name of the folder depends. What is missing, damaged, or may be written by others is compiled again.

Numba's own files have no checksum, and two processes that compile a function for two signatures
can write two entries of its index for one file.
"""

from __future__ import annotations

import errno
import functools
import hashlib
import os
import pathlib
import pickle
import stat
import sys
import warnings
from collections.abc import Callable
from typing import Any, cast

import numba
from numba.core.caching import NullCache
from numba.core.compiler import CompileResult
from numba.core.serialize import dumps

from trl_suite.util import files, interrupts

_FLAGS = sum(getattr(os, name, 0) for name in ('O_NOFOLLOW', 'O_NONBLOCK', 'O_BINARY'))


class Cache(NullCache):
    """What a dispatcher of Numba asks for the code of a function before it compiles it."""

    def __init__(self, function: Callable[..., Any], folder: pathlib.Path, entry: bool) -> None:
        """Prepares the cache of a function without free variables, which is in a file.

        Args:
          function: the Python function.
          folder: where the files are.
          entry: whether the code can be called from Python.
        """
        code, config = function.__code__, cast(Any, numba.config)
        self._folder = folder
        self._key = (
            numba.__version__, config.OPT, config.BOUNDSCHECK, sys.version, entry,
            code.co_filename, _digest(code.co_filename), function.__qualname__,
            [*code.co_positions()],
        )  # fmt: skip

    def _path(self, signature: Any, codegen: Any) -> pathlib.Path:
        key = repr((self._key, str(signature), codegen.magic_tuple()))
        return self._folder / f'{hashlib.sha256(key.encode()).hexdigest()[:32]}.nbc'

    def load_overload(self, sig: Any, target_context: Any) -> CompileResult | None:
        """Returns the code for a signature, or None."""
        target_context.refresh()
        with interrupts.postponed():
            try:
                known, code = pickle.loads(_read(self._path(sig, target_context.codegen())))
                if known != sig:  # types of the same names
                    return None
                return CompileResult._rebuild(target_context, *code)  # noqa: SLF001
            except Exception:  # no such file, a damaged one, or one with types that are gone
                return None

    def save_overload(self, sig: Any, cres: Any) -> None:
        """Writes the code for a signature; if that fails, a warning is issued once."""
        if cres.library.has_dynamic_globals:  # addresses in this process
            return
        path = self._path(sig, cres.codegen)
        with interrupts.postponed():
            content = dumps((sig, cres._reduce()))  # noqa: SLF001
            try:
                with files.replacing(path) as part:
                    part.touch(0o600)
                    part.write_bytes(hashlib.sha256(content).digest() + content)
            except OSError as error:
                # On Windows a file that another process reads cannot be replaced.
                if os.name != 'nt' or error.errno != errno.EACCES:
                    _warn(self._folder, error.strerror)


@functools.cache
def _digest(file: str) -> bytes:
    return hashlib.sha256(pathlib.Path(file).read_bytes()).digest()


def _read(path: pathlib.Path) -> bytes:
    """Returns the content of a file after its checksum.

    Raises:
      OSError: there is none, it is not a regular file, or others can have written it.
      ValueError: it is damaged.
    """
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
