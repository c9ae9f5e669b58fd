"""Calls a function in a child process with limited time and memory.

It is for files of strangers: the library that reads one may take all memory, run for ever, or crash.
"""

from __future__ import annotations

import math
import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable
from typing import Any

from trl_suite.util.libraries import optional

resource = optional('resource')  # Windows has none
SECONDS = 10  # of processor time, not on Windows
MEMORY = 2 * 10**9  # bytes in addition to those of imported libraries, on Linux
WAIT = 60.0  # s of real time, e.g. for a pipe that nobody writes
MESSAGE = 1000  # characters of a message, which may quote the file
_READY = b'.'  # precedes the result: the child could import the function
_ENVIRONMENT = {'MUJOCO_GL': 'disable', 'OPENBLAS_NUM_THREADS': '1', 'MALLOC_ARENA_MAX': '2'}


def call(function: Callable[..., Any], *arguments: Any) -> Any:
    """Returns `function(*arguments)`, computed in a child process.

    Args:
      function: a function of a module, whose result can be pickled.
      arguments: values that can be pickled.

    Returns:
      The result. It is unpickled: the function is trusted, only its time and memory are not.

    Raises:
      ValueError: the function raised an exception, exceeded a limit, or ended the process.
      RuntimeError: the process does not start.
    """
    code = (
        f'import sys; sys.path[:] = {[str(place) for place in sys.path if place]!r}; from {__name__} import _serve; '
        f'_serve({SECONDS}, {MEMORY})'
    )
    try:
        run = subprocess.run(  # -P, lest a module is imported from the working folder
            [sys.executable, '-P', '-c', code],
            input=pickle.dumps((function, arguments)),
            capture_output=True,
            env={**os.environ, **_ENVIRONMENT},
            timeout=WAIT,
        )
    except subprocess.TimeoutExpired:
        raise ValueError(_beyond(f'no end within {WAIT:g} s')) from None
    if not run.stdout.startswith(_READY):
        lines = run.stderr.decode(errors='replace').splitlines() or [f'status {run.returncode}']
        raise RuntimeError(f'a process of {sys.executable!r} does not start: {lines[-1]}')
    if run.returncode:
        number = run.returncode
        cause = signal.strsignal(-number) if number < 0 else f'status {number}'
        raise ValueError(_beyond(f'reading it failed: {cause}'))
    result, kind, message = pickle.loads(run.stdout.removeprefix(_READY))
    if kind:
        raise ValueError(message if kind == 'ValueError' else _beyond(f'{kind}: {message}'))
    return result


def _beyond(what: str) -> str:
    return f'{what}; expected what can be read in {SECONDS} s with {MEMORY / 1e9:g} GB of memory'


def _serve(seconds: int, memory: int) -> None:
    """Runs in the child: calls the function on stdin, and writes its result to stdout."""
    with os.fdopen(os.dup(1), 'wb') as output:
        os.dup2(2, 1)  # libraries may print
        function, arguments = pickle.load(sys.stdin.buffer)
        output.write(_READY)
        output.flush()
        for number in (1, 2):
            os.dup2(os.open(os.devnull, os.O_WRONLY), number)
        _limit(seconds, memory)
        try:
            result = pickle.dumps((function(*arguments), '', ''))
        except Exception as error:
            message = ' '.join(str(error).split())[:MESSAGE]
            result = pickle.dumps((None, type(error).__name__, message))
        output.write(result)


def _limit(seconds: int, memory: int) -> None:
    """Limits this process where the operating system can."""
    if resource is None:
        return
    used = resource.getrusage(resource.RUSAGE_SELF)
    limits = {
        resource.RLIMIT_CPU: math.ceil(used.ru_utime + used.ru_stime) + seconds,
        resource.RLIMIT_FSIZE: 0,  # no file is written
        resource.RLIMIT_CORE: 0,
    }
    if sys.platform == 'linux':
        with open('/proc/self/statm') as file:
            pages = int(file.read().split()[0])
        limits[resource.RLIMIT_AS] = pages * resource.getpagesize() + memory
    for kind, most in limits.items():
        hard = resource.getrlimit(kind)[1]
        if hard != resource.RLIM_INFINITY:
            most = min(most, hard)
        resource.setrlimit(kind, (most, hard))
