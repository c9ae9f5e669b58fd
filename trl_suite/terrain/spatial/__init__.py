"""Three-dimensional terrain."""
