"""Navigation to goals in three dimensions, by joint targets or by footstep plans."""
