"""Arenas: terrain as collision geometry, without recompiling."""

from trl_suite.arenas.planar import PlanarArena
from trl_suite.arenas.spatial import SpatialArena

__all__ = ('PlanarArena', 'SpatialArena')
