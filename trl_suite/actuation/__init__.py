"""How actions become forces: four actuation models, what an action means, and muscles."""

from trl_suite.actuation.models import (
    ACTUATIONS,
    ROTATIONS,
    add,
    character_muscles,
    original_ranges,
)

__all__ = ['ACTUATIONS', 'ROTATIONS', 'add', 'character_muscles', 'original_ranges']
