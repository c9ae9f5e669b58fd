"""Folders of the suite's data files: inside the package in a wheel, else in the checkout."""

import importlib.resources
import os
import pathlib


def directory(kind: str) -> pathlib.Path:
    """Returns the folder of the data files of one kind: 'xml', 'mocap' or 'trained'.

    `$TRL_SUITE_TRAINED` replaces the last one.
    """
    if kind == 'trained' and os.environ.get('TRL_SUITE_TRAINED'):
        return pathlib.Path(os.environ['TRL_SUITE_TRAINED'])
    inside = pathlib.Path(str(importlib.resources.files('trl_suite'))) / kind
    return inside if inside.is_dir() else pathlib.Path(__file__).resolve().parents[2] / kind
