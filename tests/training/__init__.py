"""Tests of the programs in `training/`, whose modules they import by name."""

import pathlib
import sys

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[2] / 'training'))
