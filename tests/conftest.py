"""Chooses how to render before any test imports dm_control."""

import trl_suite  # noqa: F401
