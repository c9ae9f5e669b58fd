"""Many simulations that step together. See `trl_suite.environments.vector`."""

from trl_suite.environments.vector import AUTORESET, Step, VectorEnvironment

__all__ = ['AUTORESET', 'Step', 'VectorEnvironment']
