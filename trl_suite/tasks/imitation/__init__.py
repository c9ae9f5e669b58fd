"""Tasks that track a motion clip."""
