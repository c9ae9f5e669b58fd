"""Error handling of programs: bad input is reported in one line, SIGTERM acts as an interrupt."""

from __future__ import annotations

import contextlib
import pathlib
import signal
import sys
import threading
from collections.abc import Iterator
from types import TracebackType

# Exceptions that users can cause. Any other one is a defect, and its traceback is printed.
EXPECTED = (ValueError, ImportError, RuntimeError, OSError)


class Terminated(KeyboardInterrupt):
    """Raised by SIGTERM: unfinished files are removed, as after an interrupt."""


def in_one_line(error: BaseException) -> str:
    """Returns the message of an error in one line."""
    return ' '.join(str(error).split())


@contextlib.contextmanager
def terminable() -> Iterator[None]:
    """Makes SIGTERM raise `Terminated` inside the context; only in the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, _terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _terminate(number: int, frame: object) -> None:
    signal.signal(number, signal.SIG_DFL)  # a second signal ends the process at once
    raise Terminated


@contextlib.contextmanager
def signals_delayed() -> Iterator[None]:
    """Delays SIGINT and SIGTERM to the end of the context; only in the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    # Blocking them would not suffice: another thread may receive them for the main thread.
    received: list[int] = []
    before = {
        number: signal.signal(number, lambda number, frame: received.append(number))
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for one in received:
            signal.raise_signal(one)


def begin_script() -> None:
    """Makes a script report errors as the commands do: in one line on stderr.

    Its exit status is 1, as after any exception. With `python -X dev` tracebacks are printed.
    """
    if sys.flags.dev_mode:
        return
    name = pathlib.Path(sys.argv[0]).name
    sys.excepthook = lambda *raised: _report(name, *raised)
    signal.signal(signal.SIGTERM, _terminate)


def _report(
    name: str, kind: type[BaseException], error: BaseException, traceback: TracebackType | None
) -> None:
    if issubclass(kind, KeyboardInterrupt):
        how = 'terminated' if issubclass(kind, Terminated) else 'interrupted'
        print(f'{name}: {how}', file=sys.stderr)
    elif issubclass(kind, EXPECTED):
        print(f'{name}: error: {in_one_line(error)}', file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, traceback)
