"""Imports of libraries that may be missing."""

from __future__ import annotations

import importlib
from typing import Any

# pip cannot install dm-control with its requirements on Python 3.13 and later, see setup.py. Without
# them it must be told the version, too: a later one may need another MuJoCo.
DM_CONTROL = '--no-deps dm-control==1.0.50'


def missing(package: str, source: str) -> str:
    """Returns the message for a missing package; see `library` for the arguments."""
    quoted = f"'{source}'" if '[' in source else source
    return f'{package} is required but not installed; pip install {quoted}'


def optional(name: str) -> Any:
    """Returns a module that some systems lack; None if it cannot be imported."""
    try:
        return importlib.import_module(name)
    except ImportError:
        return None


def library(name: str, source: str) -> Any:
    """Imports a module of a library.

    Args:
      name: of the module, e.g. 'PIL.Image'.
      source: what to install with pip, e.g. 'trl_suite[video]' or `DM_CONTROL`.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ImportError(missing(name.partition('.')[0], source)) from error
