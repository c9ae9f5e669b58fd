"""Environments: a single one with dm_env time steps, or many simulations that step together."""
