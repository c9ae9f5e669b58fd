"""Many simulations that step together. See `trl_suite.environments.vector`."""

import trl_suite.suite  # noqa: F401  tells what to install if dm_control is missing
from trl_suite.environments.vector import AUTORESET, Step, VectorEnvironment

__all__ = ['AUTORESET', 'Step', 'VectorEnvironment']
