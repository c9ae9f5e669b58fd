"""Utilities that every layer may import and that import none of the others."""
