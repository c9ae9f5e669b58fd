"""Controllers between agent and joints: gait state machines, and footstep controllers."""

from trl_suite.controllers.gait import Gait
from trl_suite.controllers.gaits import GAIT_TIMESTEP
from trl_suite.controllers.parameters import Parameters, available, load

__all__ = ['GAIT_TIMESTEP', 'Gait', 'Parameters', 'available', 'load']
