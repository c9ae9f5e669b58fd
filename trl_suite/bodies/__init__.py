"""Characters bound to their simulations: measurement, observation, placement, reference motion."""
