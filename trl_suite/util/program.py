"""Error handling of programs: bad input is reported in one line, SIGTERM acts as an interrupt."""

from __future__ import annotations

import contextlib
import os
import pathlib
import signal
import sys
import threading
from collections.abc import Callable, Iterator
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
    hook, sys.unraisablehook = sys.unraisablehook, _sending_again(sys.unraisablehook)
    try:
        yield
    finally:
        sys.unraisablehook = hook
        signal.signal(signal.SIGTERM, before)


def _terminate(number: int, frame: object) -> None:
    signal.signal(number, signal.SIG_DFL)  # a second signal ends the process at once
    raise Terminated


def _sending_again(
    hook: Callable[[sys.UnraisableHookArgs], object],
) -> Callable[[sys.UnraisableHookArgs], None]:
    """Returns a hook that sends a signal again if its exception was ignored.

    Python ignores exceptions in destructors and in callbacks of weak references: without this, a
    signal that arrives there would not end the program.
    """

    def handle(ignored: sys.UnraisableHookArgs) -> None:
        if not issubclass(ignored.exc_type, KeyboardInterrupt):
            hook(ignored)
            return
        number = signal.SIGINT
        if issubclass(ignored.exc_type, Terminated):
            number = signal.SIGTERM
            signal.signal(number, _terminate)
        timer = threading.Timer(0.01, os.kill, (os.getpid(), number))  # after this callback
        timer.daemon = True
        timer.start()

    return handle


def begin_script() -> None:
    """Makes a script report errors as the commands do: in one line on stderr.

    Its exit status is 1, as after any exception. With `python -X dev` tracebacks are printed.
    """
    if sys.flags.dev_mode:
        return
    name = pathlib.Path(sys.argv[0]).name
    sys.excepthook = lambda *raised: _report(name, *raised)
    signal.signal(signal.SIGTERM, _terminate)
    sys.unraisablehook = _sending_again(sys.unraisablehook)


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
