"""A policy: a small network from observations to actions, evaluated with NumPy only."""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from trl_suite.policies import checks
from trl_suite.policies.convolution import Convolution
from trl_suite.policies.mirror import Mirror
from trl_suite.util import errors

ACTIVATIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    'tanh': np.tanh,
    'relu': lambda x: np.maximum(x, 0),
    'elu': lambda x: np.where(x > 0, x, np.expm1(np.minimum(x, 0))),
}
_Arrays = tuple[np.ndarray, ...]
_Network = tuple[Convolution | None, _Arrays, _Arrays]  # convolution, weights, biases
_FLAT = 'observations'  # key of the flat vector, if an environment returns one
_LEAST_VARIANCE = 1e-5  # added to the variance in layer normalisation
REACH = 1.0  # m; `placed` keeps the positions of nearer places, and the directions of others


@dataclasses.dataclass(frozen=True, eq=False)
class Policy:
    """A network from observations to actions in [-1, 1].

    Each action of a batch is bitwise equal to that of the single observation.

    Attributes:
      id: environment in which the policy was trained.
      blocks: name and size of the observation blocks, in order; k numbers in all.
      actions: names of the a actions, in order.
      quantity: quantity that an action controls, as in `ActionMap.quantity`.
      mean: mean of the inputs, for normalisation, (c,) float32; all arrays are read-only.
      std: standard deviation of the inputs, for normalisation, (c,).
      clip: bound of the normalised observation.
      weights: per layer (inputs, outputs); of an ensemble of m networks, whose outputs are averaged,
        (m, inputs, outputs).
      biases: per layer (outputs,), or (m, outputs).
      activation: activation of all layers but the last, convolutions included, one of `ACTIVATIONS`.
      log_std: logarithm of the exploration noise's standard deviation, (a,).
      info: how the policy was trained; a JSON object.
      mirror: the reflection of left stance to right stance; None for none.
      places: columns of bearing and distance of places for which `placed` adds Cartesian inputs,
        (p, 2); None for none.
      columns: columns of the observation, after reflection and with these inputs, that the network
        uses, (c,); None for all.
      choices: actions of which the one with the largest of the first b outputs is selected, (b, a);
        further outputs are changes that are added: b a, of each action, or a, of all; None: the
        outputs are the action.
      largest_change: the changes are this times the hyperbolic tangent of these outputs, (); None:
        they are the outputs.
      convolution: convolutions of the first inputs, whose outputs are then inputs of `weights[0]`,
        followed by the other inputs; None for none.
      layer_norm: whether each fully connected layer but the last has layer normalisation before
        the activation.

    Raises:
      ValueError: a field is malformed, or fields are inconsistent; the message names one.
    """

    id: str
    blocks: tuple[tuple[str, int], ...]
    actions: tuple[str, ...]
    quantity: str
    mean: np.ndarray = dataclasses.field(repr=False)
    std: np.ndarray = dataclasses.field(repr=False)
    clip: float
    weights: tuple[np.ndarray, ...] = dataclasses.field(repr=False)
    biases: tuple[np.ndarray, ...] = dataclasses.field(repr=False)
    activation: str
    log_std: np.ndarray = dataclasses.field(repr=False)
    info: dict[str, Any] = dataclasses.field(default_factory=dict, repr=False)
    mirror: Mirror | None = dataclasses.field(default=None, repr=False)
    places: np.ndarray | None = dataclasses.field(default=None, repr=False)
    columns: np.ndarray | None = dataclasses.field(default=None, repr=False)
    choices: np.ndarray | None = dataclasses.field(default=None, repr=False)
    largest_change: np.ndarray | None = None
    convolution: Convolution | None = dataclasses.field(default=None, repr=False)
    layer_norm: bool = False

    def __post_init__(self) -> None:
        put = functools.partial(object.__setattr__, self)
        put('id', str(self.id))
        put('blocks', tuple((str(name), int(size)) for name, size in self.blocks))
        put('actions', tuple(map(str, self.actions)))
        put('quantity', str(self.quantity))
        for name, items in (('blocks', [n for n, _ in self.blocks]), ('actions', self.actions)):
            if not items or len(set(items)) < len(items) or '' in items:
                raise ValueError(f'{name}: expected at least one name, each once; got {items}')
        if min(size for _, size in self.blocks) < 1:
            raise ValueError(f'blocks: expected positive sizes; got {_words(self.blocks)}')
        errors.check_known('activation', ACTIVATIONS, self.activation)
        k, a = self.observation_size, len(self.actions)
        seen = k
        if self.places is not None:
            put('places', checks.columns('places', self.places, 2, k))
            if self.places.shape[1] != 2:
                raise ValueError(f'places: has shape {self.places.shape}; expected (p, 2)')
            seen += self.places.size
        if self.columns is not None:
            put('columns', checks.columns('columns', self.columns, 1, seen))
            seen = len(self.columns)
        put('mean', checks.array('mean', self.mean, (seen,)))
        put('std', checks.array('std', self.std, (seen,)))
        if not (self.std > 0).all():
            raise ValueError('std: expected positive numbers')
        put('log_std', checks.array('log_std', self.log_std, (a,)))
        put('clip', float(checks.array('clip', self.clip, ())))
        if not self.clip > 0:
            raise ValueError(f'clip: expected a positive number; got {self.clip}')
        last = a
        if self.choices is not None:
            last = len(self.choices)
            put('choices', checks.array('choices', self.choices, (last, a)))
            outputs = (
                np.shape(self.biases[-1])[-1] if self.biases and np.ndim(self.biases[-1]) else 0
            )
            if outputs in (last + a, last * (1 + a)):
                last = outputs
            if not last or np.abs(self.choices).max() > 1:
                raise ValueError('choices: expected at least one action, in [-1, 1]')
            if self.mirror is not None:
                raise ValueError('choices: a policy with a mirror cannot have them')
        if self.largest_change is not None:
            put('largest_change', checks.array('largest_change', self.largest_change, ()))
            if not self.largest_change > 0:
                raise ValueError(
                    f'largest_change: expected a positive number; got {self.largest_change}'
                )
            if self.choices is None or last == len(self.choices):
                raise ValueError('largest_change: expected choices, and outputs that change them')
        layers = len(self.weights)
        if not layers or len(self.biases) != layers:
            raise ValueError(f'weights: {layers} layers with {len(self.biases)} biases')
        inputs, stack = seen, checks.stack('weight_0', self.weights[0], 2)
        if self.convolution is not None:
            self.convolution.check(seen)
            inputs += self.convolution.outputs - self.convolution.line
            own, count = len(self.convolution.members), stack[0] if stack else 1
            if own != count:
                raise ValueError(f'line: convolutions of {own} networks; expected those of {count}')
        put('layer_norm', bool(self.layer_norm))
        weights, biases = [], []
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            outputs = last if i == layers - 1 else np.shape(weight)[-1] if np.ndim(weight) else 0
            weights.append(checks.array(f'weight_{i}', weight, (*stack, inputs, outputs)))
            biases.append(checks.array(f'bias_{i}', bias, (*stack, outputs)))
            inputs = outputs
        put('weights', tuple(weights))
        put('biases', tuple(biases))
        for network in self.networks:
            self._check_sums(*network)
        try:
            put('info', json.loads(json.dumps(self.info, allow_nan=False)))
        except (TypeError, ValueError) as error:
            raise ValueError(f'info: not representable as JSON ({error})') from None
        if not isinstance(self.info, dict):
            raise ValueError(f'info: expected a dict; got {type(self.info).__name__}')
        if self.mirror is not None:
            self.mirror.check(k, a)

    @classmethod
    def for_environment(
        cls,
        environment: Any,
        weights: Sequence[np.ndarray],
        biases: Sequence[np.ndarray],
        **fields: Any,
    ) -> Policy:
        """Makes a policy with the observations and actions of an environment.

        Args:
          environment: a `VectorEnvironment`.
          weights: those of the layers, as the attribute.
          biases: those of the layers.
          fields: further attributes; by default inputs are not scaled, and `activation` is 'tanh'.

        Raises:
          ValueError: as the class.
        """
        blocks = tuple((name, part.stop - part.start) for name, part in environment.blocks.items())
        size, actions = sum(count for _, count in blocks), environment.action_map
        return cls(**{
            'id': environment.spec.id, 'blocks': blocks, 'actions': tuple(actions.names),
            'quantity': actions.quantity, 'mean': np.zeros(size), 'std': np.ones(size), 'clip': 1e6,
            'weights': tuple(weights), 'biases': tuple(biases), 'activation': 'tanh',
            'log_std': np.zeros(len(actions)), **fields,
        })  # fmt: skip

    @functools.cached_property
    def networks(self) -> tuple[_Network, ...]:
        """Convolution (or None), weights and biases of each network: of all of an ensemble, or of one."""
        if self.weights[0].ndim == 2:
            return ((self.convolution, self.weights, self.biases),)
        arrays = tuple(zip(*self.weights, strict=True)), tuple(zip(*self.biases, strict=True))
        lines = (None,) * len(arrays[0]) if self.convolution is None else self.convolution.members
        return tuple(zip(lines, *arrays, strict=True))

    def _check_sums(self, line: Convolution | None, weights: _Arrays, biases: _Arrays) -> None:
        """Raises an error if a sum may overflow, since an action could then be NaN."""
        bound = self.clip
        if line is not None:
            for i, layer in enumerate(zip(line.weights, line.biases, strict=True)):
                bound = self._hidden(checks.largest_sum(f'filter_{i}', *layer, bound))
            bound = max(bound, self.clip)
        for i, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
            bound = checks.largest_sum(f'weight_{i}', weight, bias, bound)
            if i < len(weights) - 1:
                if self.layer_norm:
                    checks.largest_sum(
                        f'weight_{i}', np.full((len(bias), 1), bound), np.zeros(1), bound
                    )
                    bound = len(bias) ** 0.5
                bound = self._hidden(bound)

    def _hidden(self, bound: float) -> float:
        """Returns a bound of the activation's outputs for inputs with a bound."""
        return min(bound, 1.0) if self.activation == 'tanh' else max(bound, 1.0)

    @property
    def observation_size(self) -> int:
        """Size of an observation, k."""
        return sum(size for _, size in self.blocks)

    def __call__(self, observation: Any) -> np.ndarray:
        """Returns the action without noise, in [-1, 1].

        Args:
          observation: (k,) or (n, k); or a mapping with all blocks, each (size,) or (n, size); its
            other entries are ignored.

        Returns:
          (a,) or (n, a), float64.

        Raises:
          ValueError: an observation of another size, or a missing block.
        """
        return _bounded(self._output(self._flat(observation)), 1.0)

    def sample(self, observation: Any, random: np.random.Generator) -> np.ndarray:
        """Returns the action with exploration noise, clipped to [-1, 1].

        Arguments, results and errors are those of calling the policy.
        """
        output = self._output(self._flat(observation))
        noise = random.standard_normal(output.shape)
        return np.clip(output + np.exp(self.log_std.astype(float)) * noise, -1, 1)

    def with_preference(self, preference: float) -> Policy:
        """Returns the policy that selects its action of zeros, the default gait, more often.

        Where actions differ little, errors of their estimated values decide which one is selected.

        Args:
          preference: number that is added to the value of the action of zeros.

        Raises:
          ValueError: the policy does not select one of several actions, or none is of zeros; or the
            preference is not a finite number.
        """
        added = checks.array('preference', preference, ())
        zeros = () if self.choices is None else np.flatnonzero(~self.choices.any(1))
        if len(zeros) != 1:
            raise ValueError('choices: expected one action of zeros, which can be preferred')
        last = self.biases[-1].copy()
        last[..., zeros] += added
        return dataclasses.replace(self, biases=(*self.biases[:-1], last))

    def check(self, environment: Any) -> None:
        """Checks that an environment has the policy's observations and actions.

        Args:
          environment: an `Environment` or `VectorEnvironment`.

        Raises:
          ValueError: they differ; the message has both.
        """
        blocks = tuple((name, part.stop - part.start) for name, part in environment.blocks.items())
        if blocks != self.blocks:
            raise ValueError(
                f'the policy of {self.id!r} observes {_words(self.blocks)}; the environment gives '
                f'{_words(blocks)}'
            )
        actions, quantity = tuple(environment.action_map.names), environment.action_map.quantity
        if (actions, quantity) != (self.actions, self.quantity):
            raise ValueError(
                f'the policy of {self.id!r} sets the {self.quantity} of {", ".join(self.actions)}; '
                f'the environment takes the {quantity} of {", ".join(actions)}'
            )

    def _flat(self, observation: Any) -> np.ndarray:
        names = [name for name, _ in self.blocks]
        if isinstance(observation, Mapping):
            if _FLAT in observation and _FLAT not in names:
                return self._flat(observation[_FLAT])
            missing = [name for name in names if name not in observation]
            if missing:
                raise ValueError(
                    f'the observation lacks {", ".join(missing)}; expected {_words(self.blocks)}'
                )
            parts = [np.asarray(observation[name], dtype=float) for name in names]
            for (name, size), part in zip(self.blocks, parts, strict=True):
                if part.ndim not in (1, 2) or part.shape != (*parts[0].shape[:-1], size):
                    raise ValueError(
                        f'observation block {name!r} has shape {part.shape}; expected ({size},) or '
                        f'(n, {size}), with the same n in all blocks'
                    )
            return np.concatenate(parts, axis=-1)
        if hasattr(observation, 'step_type'):
            raise TypeError(
                'a time step was given; expected its observation: policy(time_step.observation)'
            )
        flat = np.asarray(observation, dtype=float)
        k = self.observation_size
        if flat.ndim not in (1, 2) or flat.shape[-1] != k:
            raise ValueError(
                f'the observation has shape {flat.shape}; expected ({k},) or (n, {k}): '
                f'{_words(self.blocks)}'
            )
        return flat

    @functools.cached_property
    def _scales(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean and standard deviation as doubles, so that calls need not convert them."""
        return self.mean.astype(float), self.std.astype(float)

    def _output(self, flat: np.ndarray) -> np.ndarray:
        seen, left = np.atleast_2d(flat), None
        if not len(seen):
            return np.zeros((0, len(self.actions)))
        if self.mirror is not None:
            seen, left = self.mirror.canonical(seen)
        if self.places is not None:
            seen = placed(seen, self.places)
        if self.columns is not None:
            seen = seen.take(self.columns, 1)
        if self.convolution is not None:
            seen = self.convolution.relative(seen)
        mean, std = self._scales
        inputs = _bounded((seen - mean) / std, self.clip).astype(np.float32, order='C')
        x, *others = (self._run(inputs, *network) for network in self.networks)
        if others:
            x = sum(others, x.astype(float)) / len(self.networks)
        if self.choices is not None:
            number = len(self.choices)
            chosen, changes = x[:, :number].argmax(1), x[:, number:]
            x = self.choices[chosen]
            if changes.size:
                changes = changes.reshape(len(x), -1, len(self.actions))
                own = np.minimum(chosen, changes.shape[1] - 1)  # 0 if all have the same
                changes = changes[np.arange(len(x)), own]
                if self.largest_change is not None:
                    changes = self.largest_change * np.tanh(changes)
                x = _bounded(x + changes, 1.0)
        if self.mirror is not None and left is not None:
            x = self.mirror.unmirror_action(x, left)
        return x.astype(float).reshape(*flat.shape[:-1], len(self.actions))

    def _run(
        self, x: np.ndarray, line: Convolution | None, weights: _Arrays, biases: _Arrays
    ) -> np.ndarray:
        """Maps normalised inputs (n, c) to the outputs of one network."""
        activation = ACTIVATIONS[self.activation]
        if line is not None:
            x = line(x, activation)
        for i, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
            # One product per row, so that an action does not depend on the batch size.
            x = (x @ weight if len(x) == 1 else np.matmul(x[:, None], weight)[:, 0]) + bias
            if i < len(weights) - 1:
                if self.layer_norm:
                    x = x - x.mean(1, keepdims=True)
                    x /= np.sqrt((x * x).mean(1, keepdims=True) + np.float32(_LEAST_VARIANCE))
                x = activation(x)
        return x


def _bounded(x: np.ndarray, bound: float) -> np.ndarray:
    """Returns numbers clipped to [-bound, bound]; for few numbers faster than `numpy.clip`."""
    return np.minimum(np.maximum(x, -bound), bound)


def placed(observation: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Appends forward and left coordinates of places to observations (n, k), (n, k + 2p).

    A bearing is discontinuous behind the character, and after normalisation, small distances have a
    low resolution. Therefore the position of a place within `REACH` is appended in units of
    `REACH`, and the direction of a place farther away.

    Args:
      observation: (n, k).
      places: columns of bearing and distance, (p, 2).
    """
    bearing, distance = observation[:, places[:, 0]], observation[:, places[:, 1]]
    near = np.minimum(distance / REACH, 1)
    straight = np.stack([near * np.cos(bearing), near * np.sin(bearing)], axis=-1)
    return np.concatenate([observation, straight.reshape(len(observation), -1)], axis=1)


def _words(blocks: Sequence[tuple[str, int]]) -> str:
    return ', '.join(f'{name} {size}' for name, size in blocks)
