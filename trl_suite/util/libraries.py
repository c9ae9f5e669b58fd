"""Imports of optional libraries."""

from __future__ import annotations

import importlib
from typing import Any


def library(name: str, source: str) -> Any:
    """Imports a module of an optional library.

    Args:
      name: of the module, e.g. 'PIL.Image'.
      source: what to install with pip, e.g. 'trl_suite[video]'.

    Raises:
      ImportError: it is not installed; the message tells how to install it.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package = name.partition('.')[0]
        quoted = f"'{source}'" if '[' in source else source
        raise ImportError(
            f'{package} is required but not installed; pip install {quoted}'
        ) from error
