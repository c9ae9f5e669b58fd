"""Simulations as arrays: the only place that calls MuJoCo for tasks."""

from trl_suite.engine.world import BatchWorld, PhysicsWorld, World, light_model

__all__ = ['BatchWorld', 'PhysicsWorld', 'World', 'light_model']
