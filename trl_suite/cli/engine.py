"""Imports the engine for those commands that need it, when they need it."""

from __future__ import annotations

import importlib
from typing import Any

from trl_suite import rendering


def load(name: str = 'trl_suite.suite') -> Any:
    """Imports a module that may import the engine.

    Raises:
      RuntimeError: the OpenGL library that MUJOCO_GL names is missing; the message says so.
      ImportError: another module is missing.
    """
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError:
        raise
    # What dm_control dies of where the library that MUJOCO_GL names is missing.
    except (AttributeError, ImportError) as error:
        raise RuntimeError(rendering.no_gl(error)) from error
