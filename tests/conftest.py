"""Keeps the garbage collector fast and memory small; lets tests interrupt their processes."""

import collections
import ctypes
import gc
import re
import signal

import helpers
import mujoco
import pytest

from trl_suite.util import notices


def pytest_configure():
    if hasattr(libc := ctypes.CDLL(None), 'mallopt'):  # glibc
        # Large arrays are returned to the system when they are released, and threads share a heap.
        libc.mallopt(-3, 1 << 17)  # M_MMAP_THRESHOLD, which would rise to 32 MB by itself
        libc.mallopt(-8, 1)  # M_ARENA_MAX
    notices.listeners.clear()  # tests compare what is written to stderr
    mujoco.mj_setCacheCapacity(mujoco.mj_getCache(), 0)  # meshes of foreign files, 0.2 GB
    # Background jobs of shell scripts ignore SIGINT, and so would the processes that tests start.
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


# Files that run first, so that two workers end at the same time. One compiles nearly all functions in
# the first file; the other one meanwhile runs what needs few of them, and then the largest meshes,
# while its memory is small. Last come short files.
FIRST = (
    'environment', 'ball_joints', 'characters', 'muscles', 'terrain', 'motion', 'clips', 'package',
    'compiled', 'foreign', 'browser', 'cli', 'vector', 'faults', 'commands', 'suite', 'gait',
    'disturbances',
)  # fmt: skip


def pytest_collection_modifyitems(items):
    rank = {f'{name}_test.py': number for number, name in enumerate(FIRST)}
    sizes = collections.Counter(item.path for item in items)

    def place(item):
        # Tests of a file with the same parameter follow one another, to share its environment.
        parameter = re.search(r'\d*$', item.originalname)[0]
        together = parameter and 'setUpClass' not in vars(item.cls)
        path = item.path
        return (
            rank.get(path.name, len(rank)),
            -sizes[path],
            path,
            int(parameter) if together else -1,
        )

    items.sort(key=place)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    # A file at a time: workers that run parts of one file wait for each other to compile, and
    # each of them keeps the environments and the code of all files in memory.
    from xdist.scheduler import LoadFileScheduling

    config.option.loadscopereorder = False  # in the order above
    return LoadFileScheduling(config, log)


def pytest_collection_finish():
    # Modules and tests are never garbage. The collector would traverse them whenever an
    # environment, which is full of cycles, is released: a sixth of the time of the whole run.
    gc.freeze()


@pytest.fixture(autouse=True, scope='module')
def _memory():
    yield
    helpers.let_go()  # a worker would grow to 3 GB
