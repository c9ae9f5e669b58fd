"""Arenas: terrain as collision geometry, without recompiling."""

from trl_suite.arenas.planar import PlanarTerrain
from trl_suite.arenas.spatial import SpatialTerrain

__all__ = ('PlanarTerrain', 'SpatialTerrain')
