"""Tells users what a long wait is for: which functions are compiled.

There is one line when compiling begins, and one when it is over; none for code that is loaded from
the cache. They go to stderr, whatever that is: a terminal, the output of a notebook, a log. A program
that shows them elsewhere, too, adds a function of the text to `listeners`; without any there is silence.
"""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator

PATIENCE = 0.5  # s; of less compiling nothing is said
PAUSE = 2.0  # s without compiling, after which it is over
EXPECTED = 'it usually takes 5 to 15 s'


def print_to_stderr(text: str) -> None:
    """Prints a line, above progress bars."""
    if sys.stderr is None:
        return
    line, bars = f'trl_suite: {text}', getattr(sys.modules.get('tqdm'), 'tqdm', None)
    with contextlib.suppress(OSError, ValueError):  # it is closed
        if bars is None:
            print(line, file=sys.stderr, flush=True)
        else:
            bars.write(line, file=sys.stderr)


listeners: list[Callable[[str], object]] = [print_to_stderr]


class Compiling:
    """What is compiled in this process, for one environment after another."""

    def __init__(self) -> None:
        self._subject = ''
        self.begin_anew()

    def begin_anew(self) -> None:
        """Forgets what is going on; in a forked process, where no other thread runs."""
        self._lock = threading.RLock()
        self._timer: threading.Timer | None = None
        self._begun: float | None = None  # time at which the current function was begun
        self._spent = self._waited = 0.0  # s, since compiling was last over
        self._waits = self._told = False

    def about(self, subject: str) -> None:
        """Names the environment of which functions may be compiled from now on."""
        if subject != self._subject:
            self._finish()
            self._subject = subject

    def begin(self) -> None:
        """A function, and those that it calls, are compiled."""
        with self._lock:
            self._begun = time.monotonic()
            self._after(PATIENCE - self._spent, self._tell)

    def end(self) -> None:
        """The function is compiled, or was found in the cache after all."""
        with self._lock:
            if self._begun is not None:
                self._spent += time.monotonic() - self._begun
                self._begun = None
                self._after(PAUSE, self._finish)

    @contextlib.contextmanager
    def waiting(self) -> Iterator[None]:
        """Another process compiles the function."""
        begin, self._waits = time.monotonic(), True
        try:
            yield
        finally:
            self._waited += time.monotonic() - begin
            self._waits = False

    def _after(self, seconds: float, action: Callable[[], None]) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer = threading.Timer(max(seconds, 0.0), action)
        self._timer.daemon = True
        with contextlib.suppress(RuntimeError):  # no thread can be started
            self._timer.start()

    def _tell(self) -> None:
        with self._lock:
            if self._begun is None or self._told:
                return
            self._told = True
            what = f'functions of {self._subject}' if self._subject else 'functions'
            if self._waits:
                _say(f'waiting for another process that compiles {what}; {EXPECTED}')
            else:
                _say(f'compiling {what} for this machine, once; {EXPECTED}')

    def _finish(self) -> None:
        with self._lock:
            if self._begun is not None:
                return
            if self._told:
                others = f', {self._waited:.0f} s of them by another process'
                _say(f'compiled in {self._spent:.0f} s{others if self._waited > PATIENCE else ""}')
            self._spent, self._waited, self._told = 0.0, 0.0, False


def _say(text: str) -> None:
    for listener in list(listeners):
        listener(text)


compiling = Compiling()
if hasattr(os, 'register_at_fork'):
    os.register_at_fork(after_in_child=compiling.begin_anew)
