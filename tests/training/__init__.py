"""Tests of the programs in `training/`, whose modules they import by name."""

import pathlib
import sys

import torch

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[2] / 'training'))
torch.set_num_threads(1)  # as the programs do; more are many times as slow beside another worker
