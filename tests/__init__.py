"""Tests. `python -m pytest` runs them, and so does `python -m unittest`, in one process.

Before any of them imports dm_control, trl_suite chooses how to render.
"""

import gc
import pathlib
import sys
import unittest
from collections.abc import Iterator

import trl_suite  # noqa: F401

FOLDER = str(pathlib.Path(__file__).parent)
sys.path.insert(0, FOLDER)  # for `helpers`


def load_tests(
    loader: unittest.TestLoader, tests: unittest.TestSuite, pattern: str | None
) -> unittest.TestSuite:
    """Finds the same tests as pytest: those in files *_test.py that are not marked as slow."""
    import conftest

    conftest.pytest_configure()
    found = loader.discover(FOLDER, '*_test.py')
    tests.addTests(test for test in flat(found) if not is_slow(test))
    gc.freeze()  # as in conftest.py
    return tests


def flat(suite: unittest.TestSuite) -> Iterator[unittest.TestCase]:
    for test in suite:
        if isinstance(test, unittest.TestSuite):
            yield from flat(test)
        else:
            yield test


def is_slow(test: unittest.TestCase) -> bool:
    module = sys.modules[type(test).__module__]
    marked = module, type(test), getattr(test, test._testMethodName)
    return any(mark.name == 'slow' for each in marked for mark in getattr(each, 'pytestmark', ()))
