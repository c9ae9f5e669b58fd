"""Convolutions over the first inputs of a network, evaluated with NumPy only."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from trl_suite.policies import checks


@dataclasses.dataclass(frozen=True, eq=False)
class Convolution:
    """1-D convolutions over a line, the first l inputs of a network, such as ground heights.

    The outputs replace the line, position by position, before the other inputs.

    Attributes:
      line: number of inputs that form the line, l.
      strides: strides of each layer, in positions of its input.
      weights: per layer (width, channels, filters), float32 and read-only, as all arrays; the first
        has one channel, each other as many channels as the previous layer has filters. Of the m
        networks of an ensemble, (m, width, channels, filters).
      biases: per layer (filters,), or (m, filters).
      origin: index of the input that is subtracted from those of the line, such as the root's
        height, before normalisation; None for none.
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
    outputs: int = dataclasses.field(init=False)

    def __post_init__(self) -> None:
        def put(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        put('line', int(self.line))
        put('strides', tuple(map(int, self.strides)))
        layers = len(self.strides)
        if not layers or len(self.weights) != layers or len(self.biases) != layers:
            raise ValueError(
                f'strides: {layers} layers with {len(self.weights)} weights and '
                f'{len(self.biases)} biases'
            )
        weights, biases, positions, channels = [], [], self.line, 1
        stack = checks.stack('filter_0', self.weights[0], 3)
        for i, stride in enumerate(self.strides):
            width, _, filters = (0, 0, 0, *np.shape(self.weights[i]))[-3:]
            shape = width, channels, filters
            weights.append(checks.array(f'filter_{i}', self.weights[i], (*stack, *shape)))
            biases.append(checks.array(f'filter_bias_{i}', self.biases[i], (*stack, filters)))
            if stride < 1 or not 1 <= width <= positions or not filters:
                raise ValueError(
                    f'filter_{i}: {filters} of width {width} and stride {stride} on {positions} positions'
                )
            positions, channels = (positions - width) // stride + 1, filters
        put('weights', tuple(weights))
        put('biases', tuple(biases))
        put('outputs', positions * channels)

    @functools.cached_property
    def members(self) -> tuple[Convolution, ...]:
        if self.weights[0].ndim == 3:
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
        line = x[:, : self.line, None]
        for weight, bias, stride in zip(self.weights, self.biases, self.strides, strict=True):
            width, channels, filters = weight.shape
            places = np.add.outer(np.arange(0, line.shape[1] - width + 1, stride), np.arange(width))
            windows = line[:, places].reshape(len(x), len(places), width * channels)
            # One product per simulation, so that results do not depend on the batch size.
            line = activation(np.matmul(windows, weight.reshape(-1, filters)) + bias)
        return np.concatenate([line.reshape(len(x), -1), x[:, self.line :]], axis=1)
