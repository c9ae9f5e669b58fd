"""Trained policies as data: small networks in .npz files, evaluated with NumPy only."""

from trl_suite.policies.convolution import Convolution
from trl_suite.policies.ensemble import ensemble
from trl_suite.policies.files import (
    SHARED,
    VARIANTS,
    available,
    load,
    preference_for,
    reference,
    save,
    trained_for,
)
from trl_suite.policies.network import ACTIVATIONS, Policy, placed

__all__ = [
    'ACTIVATIONS',
    'SHARED',
    'VARIANTS',
    'Convolution',
    'Policy',
    'available',
    'ensemble',
    'load',
    'placed',
    'preference_for',
    'reference',
    'save',
    'trained_for',
]
