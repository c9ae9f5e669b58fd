"""Tasks that walk along planned footsteps."""
