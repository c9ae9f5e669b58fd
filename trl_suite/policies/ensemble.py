"""The mean of several policies as one policy."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np

from trl_suite.policies.network import Policy


def ensemble(members: Sequence[Policy]) -> Policy:
    """Returns the policy with the mean outputs of policies, whose errors are smaller than theirs.

    Args:
      members: policies that differ only in weights and biases, those of convolutions included, each
        of one network; the result has the other fields of the first.

    Raises:
      ValueError: there is none, or they have networks of different shapes, several networks, or
        different blocks, actions, scales, columns, choices, mirrors or convolutions.
    """
    if not members:
        raise ValueError('members: expected at least one policy')
    first = members[0]
    if len(members) == 1:
        return first
    for name in ('blocks', 'actions', 'quantity', 'clip', 'activation', 'layer_norm'):
        if any(getattr(each, name) != getattr(first, name) for each in members):
            raise ValueError(f'members: have different {name}')
    for name in ('mean', 'std', 'places', 'columns', 'choices', 'largest_change'):
        if not all(np.array_equal(getattr(each, name), getattr(first, name)) for each in members):
            raise ValueError(f'members: have different {name}')
    if any(len(each.networks) > 1 for each in members):
        raise ValueError('members: expected policies of one network each')
    if not all(_same(each.mirror, first.mirror) for each in members):
        raise ValueError('members: have different mirrors')
    arrays = 'weights', 'biases'
    if not all(_same(each.convolution, first.convolution, arrays) for each in members):
        raise ValueError('members: have different convolutions')
    lines, weights, biases = zip(*(each.networks[0] for each in members), strict=True)
    line = first.convolution
    if line is not None:
        line = dataclasses.replace(
            line,
            weights=_stacked([each.weights for each in lines]),
            biases=_stacked([each.biases for each in lines]),
        )
    return dataclasses.replace(
        first, weights=_stacked(weights), biases=_stacked(biases), convolution=line
    )


def _same(one: Any, other: Any, but: Collection[str] = ()) -> bool:
    """Returns whether two dataclasses, or None, have equal fields, except for those in `but`."""
    if one is None or other is None:
        return one is other
    names = {each.name for each in dataclasses.fields(one)} - {*but}
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in names)


def _stacked(members: Sequence[Sequence[np.ndarray]]) -> tuple[np.ndarray, ...]:
    """Returns the arrays of each layer, with a first axis of the members."""
    try:
        return tuple(np.stack(layer) for layer in zip(*members, strict=True))
    except ValueError as error:
        raise ValueError(f'members: have networks of different shapes ({error})') from None
