
from trl_suite.motion.clip import Clip, load, names

__all__ = ['Clip', 'load', 'names']
