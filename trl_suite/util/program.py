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
from typing import Any

# Exceptions that users can cause. Any other one is a defect, and its traceback is printed.
EXPECTED = (ValueError, ImportError, RuntimeError, OSError)
LONGEST = 2000  # characters of a message


class Terminated(KeyboardInterrupt):
    """Raised by SIGTERM: unfinished files are removed, as after an interrupt."""


def printable(text: object) -> str:
    """Returns a text with escapes for line breaks and for what a terminal would obey."""
    return ''.join(each if each.isprintable() else ascii(each)[1:-1] for each in str(text))


def in_one_line(error: object) -> str:
    """Returns the message of an error in one line of at most `LONGEST` characters."""
    line = printable(' '.join(str(error).split()))
    half = LONGEST // 2
    return line if len(line) <= LONGEST else f'{line[:half]} ... {line[-half:]}'


@contextlib.contextmanager
def terminable() -> Iterator[None]:
    """Makes SIGTERM raise `Terminated` inside the context; only in the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = _handle_signals()
    sys.unraisablehook = hook = _SendingAgain(sys.unraisablehook)
    try:
        yield
    except Exception as error:
        if _received is not None:
            raise _received from error
        raise
    finally:
        if not hook.ends:
            sys.unraisablehook = hook.before
        for number, handler in before.items():
            signal.signal(number, handler)


# What the last signal raised. ctypes and other C code may raise an exception of their own in its place.
_received: type[KeyboardInterrupt] | None = None


def _handle_signals() -> dict[signal.Signals, Any]:
    """Handles SIGTERM, and SIGINT unless it is ignored; returns the former handlers."""
    global _received
    _received = None
    numbers = [signal.SIGTERM]
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        numbers.append(signal.SIGINT)
    return {number: signal.signal(number, _raise) for number in numbers}


def _raise(number: int, frame: object) -> None:
    global _received
    if number == signal.SIGTERM:
        signal.signal(number, signal.SIG_DFL)  # a second signal ends the process at once
    _received = Terminated if number == signal.SIGTERM else KeyboardInterrupt
    raise _received


class _SendingAgain:
    """A hook that sends a signal again if its exception was ignored.

    Python ignores exceptions in destructors and in callbacks of weak references: without this, a
    signal that arrives there would not end the program. Later destructors may fail because the
    interrupted one has left their objects half freed; what they raise is not reported.

    Attributes:
      before: the hook for other exceptions.
      ends: whether a signal was sent again.
    """

    def __init__(self, before: Callable[[sys.UnraisableHookArgs], object]) -> None:
        self.before, self.ends = before, False

    def __call__(self, ignored: sys.UnraisableHookArgs) -> None:
        if not issubclass(ignored.exc_type, KeyboardInterrupt):
            if not self.ends:
                self.before(ignored)
            return
        self.ends, number = True, signal.SIGINT
        if issubclass(ignored.exc_type, Terminated):
            number = signal.SIGTERM
            signal.signal(number, _raise)
        timer = threading.Timer(0.01, os.kill, (os.getpid(), number))  # after this callback
        timer.daemon = True
        timer.start()


def begin_script() -> None:
    """Makes a script report errors as the commands do: in one line on stderr.

    Its exit status is 1, as after any exception. With `python -X dev` tracebacks are printed.
    """
    if sys.flags.dev_mode:
        return
    name = pathlib.Path(sys.argv[0]).name
    sys.excepthook = lambda *raised: _report(name, *raised)
    _handle_signals()
    sys.unraisablehook = _SendingAgain(sys.unraisablehook)


def _report(
    name: str, kind: type[BaseException], error: BaseException, traceback: TracebackType | None
) -> None:
    if issubclass(kind, Exception) and _received is not None:
        kind = _received
    if issubclass(kind, KeyboardInterrupt):
        how = 'terminated' if issubclass(kind, Terminated) else 'interrupted'
        print(f'{name}: {how}', file=sys.stderr)
    elif issubclass(kind, EXPECTED):
        print(f'{name}: error: {in_one_line(error)}', file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, traceback)
