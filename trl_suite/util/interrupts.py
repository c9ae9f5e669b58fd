"""Postpones interrupts while Numba compiles, and within a block of code.

Numba and LLVM call Python in callbacks of ctypes and of weak references. An interrupt that arrives in
one of them is printed and lost, or leaves an LLVM module with two owners, which ends the process at
exit. Between two passes of the compiler an interrupt is safe.
"""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator, Mapping
from types import FrameType
from typing import Any

SIGNALS = signal.SIGINT, signal.SIGTERM


def postpone_while_compiling() -> None:
    """Postpones signals to the end of the compiler pass, in all later compilations of the process.

    Then the handler that was installed before, e.g. Python's, which raises `KeyboardInterrupt`, is
    called. Only the main thread handles signals, so compiling in other threads is not affected.
    """
    from numba.core import event

    class Listener(event.Listener):
        def on_start(self, event: Any) -> None:
            if threading.current_thread() is threading.main_thread():
                _compiling.enter()

        def on_end(self, event: Any) -> None:
            if threading.current_thread() is threading.main_thread():
                _compiling.leave()

    for kind in ('numba:compile', 'numba:run_pass'):  # the events are nested
        event.register(kind, Listener())


def deliver() -> None:
    """Calls the handlers of signals that were postponed while Numba compiles; between two passes."""
    if threading.current_thread() is threading.main_thread():
        _compiling.deliver()


@contextlib.contextmanager
def postponed() -> Iterator[None]:
    """Lets signals wait for the end of the block; in other threads than the main one nothing is changed."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    waiting = _Postponed()
    waiting.enter()
    try:
        yield
    finally:
        waiting.leave()


class _Postponed:
    """The signals received since the last end of a compiler pass, or since the begin of a block."""

    def __init__(self) -> None:
        self._depth = 0
        self._handlers: dict[int, Any] = {}
        self._received: dict[int, FrameType | None] = {}

    def enter(self) -> None:
        self._depth += 1
        if self._depth == 1:
            for number in SIGNALS:
                handler = signal.getsignal(number)
                if callable(handler):  # neither ignored nor the default
                    self._handlers[number] = handler
                    signal.signal(number, self._receive)

    def leave(self) -> None:
        self._depth = max(self._depth - 1, 0)  # an interrupt may have come before `enter` counted
        handlers = dict(self._handlers)
        if self._depth == 0:
            for number, handler in handlers.items():
                signal.signal(number, handler)
            self._handlers.clear()
        self._call(handlers)

    def deliver(self) -> None:
        self._call(self._handlers)

    def _call(self, handlers: Mapping[int, Any]) -> None:
        while self._received:
            number, frame = self._received.popitem()
            handlers[number](number, frame)

    def _receive(self, number: int, frame: FrameType | None) -> None:
        self._received[number] = frame


_compiling = _Postponed()
