"""Tasks: observation, reward, termination and reset, as compiled functions of one simulation."""
