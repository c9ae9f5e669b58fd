"""Tasks: rules of the families, written over a batch axis of simulations."""

from trl_suite.tasks.imitation.planar import Imitation
from trl_suite.tasks.task import Task

__all__ = ('Imitation', 'Task')
