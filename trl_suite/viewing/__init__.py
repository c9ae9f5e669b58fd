"""Interactive viewing."""
