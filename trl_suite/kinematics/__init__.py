"""Kinematics of characters for tasks: positions, velocities and contacts relative to the ground."""
