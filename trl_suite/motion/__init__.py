"""Reference motions in pure NumPy: clips and step libraries, their sampling, and readers."""

from trl_suite.motion.capture import Capture, read_amc, read_bvh
from trl_suite.motion.clip import Clip, load, names
from trl_suite.motion.layout import Layout, Mirror
from trl_suite.motion.readers import DOG3D, HUMANOID3D, read_deepmimic, read_terrainrl
from trl_suite.motion.steps import FootstepLibrary
from trl_suite.motion.steps import features as step_features
from trl_suite.motion.steps import load as load_steps
from trl_suite.motion.steps import names as steps_names

__all__ = [
    'DOG3D',
    'HUMANOID3D',
    'Capture',
    'Clip',
    'FootstepLibrary',
    'Layout',
    'Mirror',
    'load',
    'load_steps',
    'names',
    'read_amc',
    'read_bvh',
    'read_deepmimic',
    'read_terrainrl',
    'step_features',
    'steps_names',
]
