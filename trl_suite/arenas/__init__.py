"""Arenas: terrain as collision geometry, without recompiling."""

from trl_suite.arenas.planar import PlanarTerrain

__all__ = ('PlanarTerrain',)
