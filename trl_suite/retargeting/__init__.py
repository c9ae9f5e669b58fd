"""Users' own motions for a character: reading, retargeting, cutting to a cycle, and checks."""

from trl_suite.retargeting.transfer import (
    FORMATS,
    NAMES,
    counterparts,
    cycle,
    guess_map,
    read,
    retarget,
)

__all__ = ['FORMATS', 'NAMES', 'counterparts', 'cycle', 'guess_map', 'read', 'retarget']
