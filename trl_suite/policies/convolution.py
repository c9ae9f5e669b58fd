"""Convolutions over the first inputs of a network, evaluated with NumPy only."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable

import numpy as np

from trl_suite.policies import checks

MOST = 10**6  # numbers in all windows of a layer, of one simulation


@dataclasses.dataclass(frozen=True, eq=False)
class Convolution:
    """Convolutions over the first l inputs of a network: ground heights along a line, or maps.

    The outputs replace these inputs, position by position, before the other inputs.

    Attributes:
      line: number of these inputs, l.
      strides: strides of each layer along each axis, in positions of its input.
      weights: per layer (width, channels, filters), float32 and read-only, as all arrays; on a grid
        (height, width, channels, filters). The first has one channel, or as many as there are maps,
        each other as many channels as the previous layer has filters. Of the m networks of an
        ensemble, (m, width, channels, filters) or (m, height, width, channels, filters).
      biases: per layer (filters,), or (m, filters).
      origin: index of the input that is subtracted from those of the line, such as the root's
        height, before normalisation; None for none.
      grid: rows and columns of the maps, which follow each other, row by row; None for a line.
      outputs: number of outputs: positions times filters of the last layer.
      members: the convolutions of each network of an ensemble; or only this one.

    Raises:
      ValueError: fields are inconsistent; the message names one.
    """

    line: int
    strides: tuple[int, ...]
    weights: tuple[np.ndarray, ...] = dataclasses.field(repr=False)
    biases: tuple[np.ndarray, ...] = dataclasses.field(repr=False)
    origin: int | None = None
    grid: tuple[int, int] | None = None
    outputs: int = dataclasses.field(init=False)

    def __post_init__(self) -> None:
        put = functools.partial(object.__setattr__, self)
        put('line', int(self.line))
        put('strides', tuple(map(int, self.strides)))
        layers = len(self.strides)
        if not layers or len(self.weights) != layers or len(self.biases) != layers:
            raise ValueError(
                f'strides: {layers} layers with {len(self.weights)} weights and '
                f'{len(self.biases)} biases'
            )
        positions: tuple[int, ...] = (self.line,)
        if self.grid is not None:
            positions = tuple(map(int, self.grid))
            put('grid', positions)
            if len(positions) != 2 or min(positions) < 1 or self.line % math.prod(positions):
                raise ValueError(
                    f'grid: {positions} does not divide {self.line} inputs into maps of rows and '
                    'columns'
                )
        channels, axes = self.line // (math.prod(positions) or 1), len(positions)
        weights, biases = [], []
        stack = checks.stack('filter_0', self.weights[0], axes + 2)
        for i, stride in enumerate(self.strides):
            *window, _, filters = ((0,) * (axes + 2) + np.shape(self.weights[i]))[-axes - 2 :]
            shape = *window, channels, filters
            weights.append(checks.array(f'filter_{i}', self.weights[i], (*stack, *shape)))
            biases.append(checks.array(f'filter_bias_{i}', self.biases[i], (*stack, filters)))
            fits = all(1 <= w <= p for w, p in zip(window, positions, strict=True))
            if stride < 1 or not fits or not filters:
                raise ValueError(
                    f'filter_{i}: {filters} of width {" x ".join(map(str, window))} and stride '
                    f'{stride} on {" x ".join(map(str, positions))} positions'
                )
            positions = tuple((p - w) // stride + 1 for w, p in zip(window, positions, strict=True))
            if (size := math.prod((*positions, *window, channels))) > MOST:
                raise ValueError(
                    f'filter_{i}: its windows have {size:.3g} numbers in all; expected at most {MOST:g}'
                )
            channels = filters
        put('weights', tuple(weights))
        put('biases', tuple(biases))
        put('outputs', math.prod(positions) * channels)

    @functools.cached_property
    def members(self) -> tuple[Convolution, ...]:
        if self.weights[0].ndim == (3 if self.grid is None else 4):
            return (self,)
        arrays = zip(zip(*self.weights, strict=True), zip(*self.biases, strict=True), strict=True)
        return tuple(dataclasses.replace(self, weights=w, biases=b) for w, b in arrays)

    def check(self, inputs: int) -> None:
        """Raises ValueError unless it fits a network with this number of inputs."""
        if not self.line <= inputs:
            raise ValueError(f'line: has {self.line} of {inputs} inputs')
        if self.origin is not None and not 0 <= self.origin < inputs:
            raise ValueError(f'origin: is {self.origin}; expected a number of 0 to {inputs - 1}')

    def relative(self, seen: np.ndarray) -> np.ndarray:
        """Returns inputs (n, c) in which the line is relative to the origin."""
        if self.origin is None:
            return seen
        line = seen[:, : self.line] - seen[:, self.origin, None]
        return np.concatenate([line, seen[:, self.line :]], axis=1)

    def __call__(self, x: np.ndarray, activation: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """Maps normalised inputs (n, c) to outputs and other inputs, (n, outputs + c - l)."""
        positions = self.grid or (self.line,)
        maps = x[:, : self.line].reshape(len(x), -1, math.prod(positions)).swapaxes(1, 2)
        for weight, bias, stride in zip(self.weights, self.biases, self.strides, strict=True):
            *window, _, filters = weight.shape
            places = _windows(positions, tuple(window), stride)
            windows = maps[:, places].reshape(len(x), len(places), -1)
            # One product per simulation, so that results do not depend on the batch size.
            maps = activation(np.matmul(windows, weight.reshape(-1, filters)) + bias)
            positions = tuple((p - w) // stride + 1 for w, p in zip(window, positions, strict=True))
        return np.concatenate([maps.reshape(len(x), -1), x[:, self.line :]], axis=1)


@functools.cache
def _windows(positions: tuple[int, ...], window: tuple[int, ...], stride: int) -> np.ndarray:
    """Returns the indices of the positions in each window, (windows, positions in a window)."""
    axes = [
        np.add.outer(np.arange(0, size - width + 1, stride), np.arange(width))
        for size, width in zip(positions, window, strict=True)
    ]
    if len(axes) == 1:
        return axes[0]
    rows, columns = axes
    places = rows[:, None, :, None] * positions[1] + columns[None, :, None, :]
    return places.reshape(len(rows) * len(columns), -1)
