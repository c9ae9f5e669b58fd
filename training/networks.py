"""The networks of `ppo.py`, the scales of their inputs, and their exchange with policy files."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import nn

from trl_suite import policies
from trl_suite.terrain.spatial import windows
from trl_suite.util import machine

OBSERVATION_CLIP = 10.0  # in standard deviations
MAPS = ('terrain', 'surface')  # observation blocks with maps of the ground
ACTIVATIONS = {'tanh': nn.Tanh, 'relu': nn.ReLU, 'elu': nn.ELU}
LEAST_STD = 0.01  # lower bound, so that nearly constant observations are not amplified
NEW_COUNT = 2e4  # sample count of the scales of inputs that the initial policy does not have
Blocks = Mapping[str, slice]


class Scales:
    """Running mean and standard deviation of observations.

    The phase is not scaled. All elements of a map of the ground share one scale, which preserves
    its shape and does not amplify noise on flat ground. With `map_bound`, maps are clipped at this
    bound and divided by it; exported policies include `gain`, the factor for this, in their
    weights.
    """

    def __init__(
        self, blocks: Blocks, size: int, columns: np.ndarray | None = None, map_bound: float = 0.0
    ) -> None:
        self.blocks, self.count, self.columns = blocks, np.zeros(size), columns
        self.mean, self.square, self.gain = np.zeros(size), np.ones(size), np.ones(size)
        self.maps = [blocks[name] for name in MAPS if name in blocks]
        self.map_std = map_bound / OBSERVATION_CLIP
        if map_bound:
            for part in self.maps:
                self.square[part], self.gain[part] = self.map_std**2, 1 / OBSERVATION_CLIP

    def update(self, batch: np.ndarray) -> None:
        """Updates mean and deviation with observations (n, size)."""
        weight = len(batch) / (self.count + len(batch))
        self.count += len(batch)
        mean, square = batch.mean(0), (batch**2).mean(0)
        if 'phase' in self.blocks:
            part = self.blocks['phase']
            mean[part], square[part] = 0.0, 1.0
        for part in self.maps:
            mean[part], square[part] = 0.0, self.map_std**2 or square[part].mean()
        self.mean += weight * (mean - self.mean)
        self.square += weight * (square - self.square)

    @property
    def std(self) -> np.ndarray:
        return np.sqrt(np.maximum(self.square - self.mean**2, LEAST_STD**2))

    @property
    def kept(self) -> slice | np.ndarray:
        """Elements of an observation that are inputs of the networks."""
        return slice(None) if self.columns is None else self.columns

    def __call__(self, observation: np.ndarray) -> torch.Tensor:
        scaled = np.clip((observation - self.mean) / self.std, -OBSERVATION_CLIP, OBSERVATION_CLIP)
        scaled *= self.gain
        return torch.from_numpy(scaled[..., self.kept].astype(np.float32))


class Maps(nn.Module):
    """Convolutions over maps, the first inputs of a network; the other inputs follow the outputs.

    Attributes:
      shape: number, rows and columns of the maps.
      line: number of inputs that form the maps.
      outputs: number of outputs of the convolutions.
    """

    def __init__(
        self, shape: tuple[int, int, int], layers: Sequence[tuple[int, int, int]], activation: str
    ) -> None:
        """Makes layers with these numbers of filters, widths and strides."""
        super().__init__()
        self.shape, self.line = shape, int(np.prod(shape))
        parts: list[nn.Module] = []
        channels = shape[0]
        for filters, width, stride in layers:
            layer = nn.Conv2d(channels, filters, width, stride)
            nn.init.orthogonal_(layer.weight, 2**0.5)
            nn.init.zeros_(layer.bias)
            parts += [layer, ACTIVATIONS[activation]()]
            channels = filters
        self.layers = nn.Sequential(*parts)
        self.outputs = self.layers(torch.zeros(1, *shape)).numel()

    @property
    def filters(self) -> list[nn.Conv2d]:
        return [layer for layer in self.layers if isinstance(layer, nn.Conv2d)]

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        found = self.layers(x[:, : self.line].reshape(-1, *self.shape))
        # Position by position, as in policies.
        return torch.cat([found.permute(0, 2, 3, 1).flatten(1), x[:, self.line :]], 1)


def network(
    sizes: tuple[int, ...], last_gain: float, activation: str = 'tanh', maps: Maps | None = None
) -> nn.Sequential:
    """Returns a network with layers of these sizes; the first is the number of inputs."""
    layers: list[nn.Module] = [] if maps is None else [maps]
    first, *others = sizes
    if maps is not None:
        first += maps.outputs - maps.line
    for i, (fan_in, fan_out) in enumerate(itertools.pairwise((first, *others))):
        linear = nn.Linear(fan_in, fan_out)
        last = i == len(sizes) - 2
        nn.init.orthogonal_(linear.weight, last_gain if last else 2**0.5)
        nn.init.zeros_(linear.bias)
        layers += [linear] if last else [linear, ACTIVATIONS[activation]()]
    return nn.Sequential(*layers)


def linear(network_: nn.Module) -> list[nn.Linear]:
    """Returns the fully connected layers of a network."""
    return [layer for layer in network_ if isinstance(layer, nn.Linear)]


def visible(blocks: Blocks, inputs: int, view: tuple[float, float] | None) -> np.ndarray | None:
    """Returns the columns of an observation without elements of maps that are too far away."""
    maps = [name for name in MAPS if name in blocks]
    if view is None or not maps:
        return None
    near = np.logical_and.outer(*_near(view)).ravel()
    seen = np.ones(inputs, bool)
    for name in maps:
        part = blocks[name]
        seen[part] = np.tile(near, (part.stop - part.start) // len(near))
    return np.flatnonzero(seen)


def _near(view: tuple[float, float] | None) -> tuple[np.ndarray, np.ndarray]:
    """Returns the rows and the columns of a map that are in the view, (SAMPLES,) bool each."""
    ahead, aside = view or (np.inf, np.inf)
    return np.abs(windows.RIGHT) <= aside, ahead >= windows.FORWARD


def map_shape(blocks: Blocks, view: tuple[float, float] | None) -> tuple[int, int, int]:
    """Returns number, rows and columns of the maps that are the first inputs.

    Raises:
      ValueError: there is none, or other blocks come before one.
    """
    parts = [blocks[name] for name in MAPS if name in blocks]
    size = sum(part.stop - part.start for part in parts)
    if not parts or max(part.stop for part in parts) != size:
        raise ValueError(
            f'convolutions: the first observations are not maps of the ground: {", ".join(blocks)}'
        )
    rows, columns = (int(part.sum()) for part in _near(view))
    return size // windows.SAMPLES**2, rows, columns


# Policies, the files without PyTorch.


def described(environments: Any, seed: int, samples: int) -> dict[str, Any]:
    """Returns what a policy file says of its training."""
    character = environments.task.character.spec.digest
    return {'seed': seed, 'samples': samples, **machine.made_with(), 'character': character}


def arrays(layers: Iterable[Any], axes: tuple[int, ...]) -> dict[str, tuple[np.ndarray, ...]]:
    """Returns weights, with their axes in another order, and biases of layers."""
    layers = list(layers)
    return {
        'weights': tuple(each.weight.detach().permute(axes).numpy().copy() for each in layers),
        'biases': tuple(each.bias.detach().numpy().copy() for each in layers),
    }


def exported(
    environments: Any, network_: nn.Sequential, scales: Scales, **fields: Any
) -> policies.Policy:
    """Returns a network with the scales of its inputs as a policy with further fields."""
    # The weights of inputs that were always 0 in training are still random: on a slope, where
    # such inputs are not 0, a policy that was trained on level ground would be disturbed.
    gain = np.where(scales.square == 0, 0.0, scales.gain)[scales.kept]
    convolution, maps = None, network_[0]
    if isinstance(maps, Maps):
        parts = arrays(maps.filters, (2, 3, 1, 0))
        parts['weights'][0][:] *= gain[0]
        strides = tuple(layer.stride[0] for layer in maps.filters)
        convolution = policies.Convolution(
            line=maps.line, strides=strides, grid=maps.shape[1:], **parts
        )
        gain = np.concatenate([np.ones(maps.outputs), gain[maps.line :]])
    layers = arrays(linear(network_), (1, 0))
    layers['weights'][0][:] *= gain[:, None]
    return policies.Policy.for_environment(
        environments, mean=scales.mean[scales.kept], std=scales.std[scales.kept],
        columns=scales.columns, clip=OBSERVATION_CLIP, convolution=convolution, **layers, **fields,
    )  # fmt: skip


def begin_with(
    other: policies.Policy, network_: nn.Sequential, scales: Scales, places: np.ndarray | None,
    count: float,
) -> None:  # fmt: skip
    """Copies weights and scales of a policy, by observation blocks.

    Args:
      other: the policy.
      network_: gets its weights; those of inputs and last outputs that the policy lacks become 0.
      scales: get its mean and deviation.
      places: columns of the points whose Cartesian coordinates are inputs; see `policies.placed`.
      count: sample count of the scales that are copied.

    Raises:
      ValueError: the convolutions differ.
    """
    column = np.full(len(scales.mean), -1)  # indices in the other policy's observation
    offset = 0
    for name, size in other.blocks:
        part = scales.blocks.get(name, slice(0))
        if part.stop - (part.start or 0) == size:
            column[part] = offset + np.arange(size)
        offset += size
    others = other.places
    if places is not None and others is not None:
        same_place = (column[places][:, None] == others).all(-1)  # (own, others)
        for i, j in np.argwhere(same_place):
            column[len(column) - places.size + 2 * i + np.arange(2)] = offset + 2 * j + np.arange(2)
    offset += 0 if others is None else others.size
    seen = np.arange(offset) if other.columns is None else other.columns
    entry = np.full(offset + 1, -1)  # indices in the other network's input; the last one is for -1
    entry[seen[other.std > LEAST_STD]] = np.flatnonzero(other.std > LEAST_STD)
    entry = entry[column]
    bounded = scales.maps if scales.map_std else []
    for part in bounded:  # inputs with another bound are not compatible
        same_std = np.isclose(other.std[entry[part]], scales.map_std)
        entry[part] = np.where(same_std, entry[part], -1)
    known = entry >= 0
    scales.count = np.where(known, count, NEW_COUNT)
    scales.mean[known] = other.mean[entry[known]]
    scales.square[:] = LEAST_STD**2
    for part in bounded:
        scales.square[part] = scales.map_std**2
    scales.square[known] = other.std[entry[known]] ** 2 + scales.mean[known] ** 2
    entry, gain = _begin_filters(
        other, network_[0], entry[scales.kept], scales.gain[scales.kept, None]
    )
    first = np.where((entry >= 0)[:, None], other.weights[0][entry] / gain, 0.0)
    *hidden, last = linear(network_)
    more = last.out_features - len(other.biases[-1])
    weights = first, *other.weights[1:-1], np.pad(other.weights[-1], ((0, 0), (0, more)))
    biases = *other.biases[:-1], np.pad(other.biases[-1], (0, more))
    _copy([*hidden, last], weights, biases, (1, 0))


def _copy(layers: Iterable[Any], weights: Any, biases: Any, axes: tuple[int, ...]) -> None:
    with torch.no_grad():
        for layer, weight, bias in zip(layers, weights, biases, strict=True):
            layer.weight.copy_(torch.from_numpy(weight.transpose(axes).copy()))
            layer.bias.copy_(torch.from_numpy(bias.copy()))


def _begin_filters(
    other: policies.Policy, maps: Any, entry: np.ndarray, gain: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Copies the convolutions of a policy, if there are any.

    Args:
      other: the policy.
      maps: `Maps`, or another first layer.
      entry: indices in the other network's inputs, of each input.
      gain: gain of each input, (inputs, 1).

    Returns:
      Indices and gains of the inputs of the first layer after the convolutions.
    """
    theirs = other.convolution
    if theirs is None and not isinstance(maps, Maps):
        return entry, gain
    shapes = [] if theirs is None else [weight.shape for weight in theirs.weights]
    own = list(maps.filters) if isinstance(maps, Maps) else []
    same = shapes == [layer.weight.permute(2, 3, 1, 0).shape for layer in own]
    line = 0 if theirs is None else theirs.line
    if not same or theirs is None or not np.array_equal(entry[:line], np.arange(line)):
        raise ValueError(f'convolutions: those of {other.id} have other maps or layers')
    first, *more = theirs.weights
    _copy(own, (first / gain[0], *more), theirs.biases, (3, 2, 0, 1))
    others = np.where(entry[line:] >= 0, entry[line:] - line + theirs.outputs, -1)
    return (
        np.concatenate([np.arange(theirs.outputs), others]),
        np.concatenate([np.ones((theirs.outputs, 1)), gain[line:]]),
    )


def mean_of(parts: Sequence[policies.Policy]) -> policies.Policy:
    """Returns the last policy with the mean weights and scales of all policies."""

    def mean(owners: Sequence[Any], *names: str) -> dict[str, Any]:
        return {name: np.mean([getattr(each, name) for each in owners], axis=0) for name in names}

    def mean_layers(owners: Sequence[Any]) -> dict[str, Any]:
        return {
            name: tuple(
                np.mean(layer, axis=0)
                for layer in zip(*(getattr(each, name) for each in owners), strict=True)
            )
            for name in ('weights', 'biases')
        }

    means = {**mean(parts, 'mean', 'std', 'log_std'), **mean_layers(parts)}
    maps = [part.convolution for part in parts if part.convolution is not None]
    if maps:
        means['convolution'] = dataclasses.replace(maps[-1], **mean_layers(maps))
    return dataclasses.replace(parts[-1], **means)


def trimmed(policy: policies.Policy) -> policies.Policy:
    """Returns the policy for a small file.

    Weights are rounded to half precision, and inputs that are always 0 are removed, for example the
    footstep of the stance foot.
    """
    if policy.convolution is not None:  # the inputs of a convolution cannot be removed
        maps = policy.convolution
        maps = dataclasses.replace(maps, weights=_rounded(maps.weights))
        return dataclasses.replace(policy, convolution=maps, weights=_rounded(policy.weights))
    kept = (policy.mean != 0) | (policy.std > LEAST_STD)
    columns = np.arange(len(kept)) if policy.columns is None else policy.columns
    return dataclasses.replace(
        policy, columns=columns[kept], mean=policy.mean[kept], std=policy.std[kept],
        weights=_rounded((policy.weights[0][kept], *policy.weights[1:])),
    )  # fmt: skip


def _rounded(weights: Iterable[np.ndarray]) -> tuple[np.ndarray, ...]:
    return tuple(w.astype(np.float16).astype(w.dtype) for w in weights)
