"""Tasks: observation, reward, termination and reset, as rules of one simulation."""
