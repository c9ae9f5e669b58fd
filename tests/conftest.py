"""Keeps the garbage collector fast and memory small; lets tests interrupt their processes."""

import ctypes
import gc
import signal

import pytest


def pytest_configure():
    # Background jobs of shell scripts ignore SIGINT, and so would the processes that tests start.
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    # A file at a time: workers that run parts of one file compile the same functions at once, and
    # each of them keeps the environments and the code of all files in memory.
    from xdist.scheduler import LoadFileScheduling

    return LoadFileScheduling(config, log)


def pytest_collection_finish():
    # Modules and tests are never garbage. The collector would traverse them whenever an
    # environment, which is full of cycles, is released: a sixth of the time of the whole run.
    gc.freeze()


@pytest.fixture(autouse=True, scope='module')
def _memory():
    # Environments are full of cycles, and their models are not counted by the collector; the C
    # library keeps freed memory unless told otherwise: a worker would grow to 3 GB.
    yield
    gc.collect()
    if hasattr(libc := ctypes.CDLL(None), 'malloc_trim'):  # glibc
        libc.malloc_trim(0)
