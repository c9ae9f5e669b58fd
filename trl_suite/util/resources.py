"""Folders of the suite's data files: inside the package in a wheel, else in the checkout."""

import importlib.resources
import importlib.util
import os
import pathlib

POLICIES = 'trl_suite_policies'  # the distribution with the trained policies, see setup.py


def directory(kind: str) -> pathlib.Path:
    """Returns the folder of the data files of one kind: 'xml', 'mocap' or 'trained'.

    The environment variable `TRL_SUITE_TRAINED` selects another folder for 'trained'.
    """
    if kind == 'trained' and os.environ.get('TRL_SUITE_TRAINED'):
        return pathlib.Path(os.environ['TRL_SUITE_TRAINED'])
    inside = _inside(kind)
    if not inside.is_dir():
        return pathlib.Path(__file__).resolve().parents[2] / kind
    if kind == 'trained' and (spec := importlib.util.find_spec(POLICIES)):
        return pathlib.Path(next(iter(spec.submodule_search_locations or ())))
    return inside


def lacks_policies() -> bool:
    """Returns whether only the footstep controllers are installed, which are part of the wheel."""
    return directory('trained') == _inside('trained')


def _inside(kind: str) -> pathlib.Path:
    return pathlib.Path(str(importlib.resources.files('trl_suite'))) / kind
