"""Exempts modules and tests from garbage collection."""

import gc


def pytest_collection_finish():
    # Modules and tests are never garbage. The collector would traverse them whenever an
    # environment, which is full of cycles, is released: a sixth of the time of the whole run.
    gc.freeze()
