"""Tasks as environments: one with dm_env time steps, or many that step together."""
