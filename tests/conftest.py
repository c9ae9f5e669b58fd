"""Exempts modules and tests from garbage collection; lets tests interrupt their processes."""

import gc
import signal


def pytest_configure():
    # Background jobs of shell scripts ignore SIGINT, and so would the processes that tests start.
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_finish():
    # Modules and tests are never garbage. The collector would traverse them whenever an
    # environment, which is full of cycles, is released: a sixth of the time of the whole run.
    gc.freeze()
