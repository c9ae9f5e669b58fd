"""Saves a model of Stable-Baselines3 with its replay buffer, to continue its training.

    from stable_baselines_state import load, save

Unlike `model.save`, which pickles, the file holds only tensors and numbers, so that reading it runs no code.
"""

import numpy as np
import torch

COUNTERS = ('num_timesteps', '_n_updates')


def arrays(buffer):
    """Returns the arrays of a replay buffer by name."""
    found = {} if buffer is None else vars(buffer)
    return {name: array for name, array in found.items() if isinstance(array, np.ndarray)}


def save(model, path):
    """Writes parameters, optimizers, counters, and what the replay buffer holds."""
    buffer = getattr(model, 'replay_buffer', None)
    state = {
        'parameters': model.get_parameters(),
        'entropy': getattr(model, 'log_ent_coef', None),
        'counters': {name: vars(model)[name] for name in COUNTERS},
        'position': getattr(buffer, 'pos', 0),
        'buffer': {k: torch.tensor(v[: buffer.size()]) for k, v in arrays(buffer).items()},
    }
    torch.save(state, path)


def load(model, path):
    """Restores what `save` has written, in a model that was made with the same arguments."""
    state = torch.load(path, weights_only=True)
    model.set_parameters(state['parameters'])
    vars(model).update(state['counters'])
    if state['entropy'] is not None:  # in place, since an optimizer has it
        model.log_ent_coef.data.copy_(state['entropy'].data)
    buffer = getattr(model, 'replay_buffer', None)
    for name, array in arrays(buffer).items():
        part = state['buffer'][name]
        array[: len(part)] = part
        buffer.pos, buffer.full = state['position'], len(part) == buffer.buffer_size
