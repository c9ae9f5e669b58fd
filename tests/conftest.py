"""Spares the garbage collector."""

import gc


def pytest_collection_finish():
    # Modules and tests are never garbage. The collector would look through them whenever an
    # environment, which is full of cycles, was let go: a sixth of the whole run.
    gc.freeze()
