"""Controllers between agent and joints: gait state machines and the dynamics they need."""

from trl_suite.controllers.gait import CONTROL_TIMESTEP, Gait
from trl_suite.controllers.gaits import GAITS, make
from trl_suite.controllers.parameters import Parameters, load

__all__ = ['CONTROL_TIMESTEP', 'GAITS', 'Gait', 'Parameters', 'load', 'make']
