"""Reference motions: clips, their sampling, and readers for two JSON formats. Pure NumPy."""

from trl_suite.motion.clip import Clip, load, names
from trl_suite.motion.readers import (
    DOG3D,
    HUMANOID3D,
    read_deepmimic,
    read_terrainrl,
    write_terrainrl,
)

__all__ = [
    'DOG3D',
    'HUMANOID3D',
    'Clip',
    'load',
    'names',
    'read_deepmimic',
    'read_terrainrl',
    'write_terrainrl',
]
