"""Motions of the user's own on a character of the suite: read, transferred, cut, and checked."""

from trl_suite.retargeting.transfer import (
    NAMES,
    SUFFIXES,
    counterparts,
    cycle,
    guess_map,
    read,
    retarget,
)

__all__ = ['NAMES', 'SUFFIXES', 'counterparts', 'cycle', 'guess_map', 'read', 'retarget']
