"""Planar terrain."""
