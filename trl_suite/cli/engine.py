"""Imports the engine lazily, for commands that need it."""

from __future__ import annotations

import importlib
from typing import Any

from trl_suite import rendering
from trl_suite.util import interrupts
from trl_suite.util.libraries import DM_CONTROL, missing


def load(name: str = 'trl_suite.suite') -> Any:
    """Imports a module that may import the engine; interrupts wait for the end.

    PyOpenGL calls Python in callbacks of ctypes, which would turn one into an error.

    Raises:
      RuntimeError: the OpenGL library that MUJOCO_GL names is missing; the message says so.
      ImportError: another module is missing.
    """
    try:
        with interrupts.postponed():
            return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name == 'dm_control':
            raise ImportError(missing(error.name, DM_CONTROL)) from error
        raise
    # Errors of dm_control if the library that MUJOCO_GL names is missing.
    except (AttributeError, ImportError) as error:
        raise RuntimeError(rendering.no_gl(error)) from error
