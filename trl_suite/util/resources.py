"""Where the suite's data files lie: in the wheel inside the package, in a checkout beside it."""

import importlib.resources
import pathlib


def directory(kind: str) -> pathlib.Path:
    """Returns the folder of the data files of one kind, 'xml', 'mocap' or 'trained'."""
    inside = pathlib.Path(str(importlib.resources.files('trl_suite'))) / kind
    return inside if inside.is_dir() else pathlib.Path(__file__).resolve().parents[2] / kind
