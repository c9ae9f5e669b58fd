"""From actions to forces: four actuation models, action maps, and muscles."""

from trl_suite.actuation.models import (
    ACTUATIONS,
    ROTATIONS,
    add,
    character_muscles,
    original_ranges,
)
from trl_suite.actuation.realism import Actuators

__all__ = ['ACTUATIONS', 'ROTATIONS', 'Actuators', 'add', 'character_muscles', 'original_ranges']
