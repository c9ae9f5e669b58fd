"""Simulations as arrays: tasks and controllers call MuJoCo only through this package."""

from trl_suite.engine.world import GRAVITY, BatchWorld, PhysicsWorld, World, light_model

__all__ = ['GRAVITY', 'BatchWorld', 'PhysicsWorld', 'World', 'light_model']
