"""Imports the engine lazily, for commands that need it."""

from __future__ import annotations

import importlib
from typing import Any

from trl_suite.util import interrupts


def load(name: str = 'trl_suite.suite') -> Any:
    """Imports a module that may import the engine; interrupts wait for the end.

    PyOpenGL calls Python in callbacks of ctypes, which would turn one into an error.

    Raises:
      RuntimeError: the OpenGL library that MUJOCO_GL names is missing; the message says so.
      ImportError: another module is missing.
    """
    with interrupts.postponed():
        importlib.import_module('trl_suite.suite')  # names what is missing of the engine
        return importlib.import_module(name)
