"""Planar terrain. Importing this package registers the original's terrain types."""

from trl_suite.terrain.planar import features

__all__ = ['features']
