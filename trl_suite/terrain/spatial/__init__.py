"""Three-dimensional terrain. Importing this package registers the original's terrain types."""

from trl_suite.terrain.spatial import features

__all__ = ['features']
