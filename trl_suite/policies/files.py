"""Trained policies as data: a small network in one .npz file, evaluated with NumPy only.

    from trl_suite import policies, suite

    policy = policies.reference('PD_Biped2D_Gaps_Terrain-v0')  # shipped with the suite
    environment = suite.make(policy.id, task_kwargs={'random': 1})
    policy.check(environment)
    time_step = environment.reset()
    while not time_step.last():
        time_step = environment.step(policy(time_step.observation))

`trained/README.md` lists the arrays of a file.
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import json
import os
import pathlib
from typing import Any

import numpy as np

from trl_suite.policies.convolution import Convolution
from trl_suite.policies.mirror import Mirror
from trl_suite.policies.network import Policy
from trl_suite.util import archive, errors, resources
from trl_suite.util.archive import take
from trl_suite.util.files import check_size, existing

FORMAT = 'trl_suite policy'
SHARED = 'shared.json'  # in trained/; see its README
# Folders in trained/, with other policies of some environments.
VARIANTS = 'randomized', 'generalist'
VERSION = 1
LARGEST = 2**26  # bytes of the arrays; checks of a policy need several times as many
_FIELDS = archive.forms(
    'format U 0, version iu 0, id U 0, block_names U 1, block_sizes iu 1, actions U 1, quantity U 0, '
    'mean f 1, std f 1, clip f 0, activation U 0, layers iu 0, log_std f 1, info U 0'
)
_MIRROR = archive.forms(
    'observation_index iu 1, observation_sign f 1, action_index iu 1, action_sign f 1'
)
_SIDES = archive.forms('phase iu 0, feet iu 1')  # one of them
_OPTIONAL = archive.forms('places iu 2, columns iu 1, choices f 2, largest_change f 0')
_LINE = archive.forms('line iu 0, strides iu 1')
_LINE_OPTIONAL = archive.forms('origin iu 0, grid iu 1')


def save(policy: Policy, path: str | os.PathLike[str]) -> None:
    """Writes a policy as .npz; an existing file is replaced when the new one is complete.

    Raises:
      ValueError: another suffix, or more numbers than `load` reads.
      OSError: the file cannot be written.
    """
    fields = {name: getattr(policy, name, None) for name in _FIELDS}
    fields['block_names'], fields['block_sizes'] = zip(*policy.blocks, strict=True)
    fields |= {'format': FORMAT, 'version': VERSION, 'clip': np.float32(policy.clip)}
    fields |= {'layers': len(policy.weights), 'info': json.dumps(policy.info)}
    for i, (weight, bias) in enumerate(zip(policy.weights, policy.biases, strict=True)):
        fields[f'weight_{i}'], fields[f'bias_{i}'] = weight, bias
    if policy.mirror is not None:
        side = 'phase' if policy.mirror.feet is None else 'feet'
        for name, (kind, _) in {**_MIRROR, side: _SIDES[side]}.items():
            value = np.asarray(getattr(policy.mirror, name))
            fields[f'mirror_{name}'] = value.astype(np.float32) if kind == 'f' else value
    if policy.convolution is not None:
        fields |= {name: getattr(policy.convolution, name) for name in _LINE}
        given = {name: getattr(policy.convolution, name) for name in _LINE_OPTIONAL}
        fields |= {name: value for name, value in given.items() if value is not None}
        layers = zip(policy.convolution.weights, policy.convolution.biases, strict=True)
        for i, (weight, bias) in enumerate(layers):
            fields[f'filter_{i}'], fields[f'filter_bias_{i}'] = weight, bias
    if policy.layer_norm:
        fields['layer_norm'] = 1
    optional = {name: getattr(policy, name) for name in _OPTIONAL}
    fields |= {name: value for name, value in optional.items() if value is not None}
    small = {name: _small(value) for name, value in fields.items()}
    size = sum(np.asarray(value).nbytes for value in small.values())
    check_size(pathlib.Path(path), LARGEST, size)
    archive.write(path, small)


def load(path: str | os.PathLike[str]) -> Policy:
    """Reads a policy that `save` wrote.

    Raises:
      ValueError: a broken or malformed file; the message names file and field.
      FileNotFoundError: there is no such file.
    """
    path = existing(path, ('.npz',))
    arrays = archive.arrays(path, 'policy', LARGEST)
    with errors.naming(path, Exception):  # wrong numbers raise others than ValueError
        return _policy(arrays)


def _policy(arrays: dict[str, np.ndarray]) -> Policy:
    """Makes a policy of the arrays of a file, which it takes from the dict."""
    fields: dict[str, Any] = {}
    for name, form in _FIELDS.items():
        fields[name] = take(arrays, name, *form).tolist()
        expected = {'format': FORMAT, 'version': VERSION}.get(name, fields[name])
        if fields[name] != expected:
            raise ValueError(f'field {name!r}: is {fields[name]!r}; expected {expected!r}')
    stacked = int('weight_0' in arrays and arrays['weight_0'].ndim == 3)  # axes of an ensemble
    layers = fields.pop('layers')
    fields['weights'] = _layers(arrays, 'weight', layers, stacked + 2)
    fields['biases'] = _layers(arrays, 'bias', layers, stacked + 1)
    if any(name.startswith('mirror_') for name in arrays):
        side = 'feet' if 'mirror_feet' in arrays else 'phase'
        forms = {**_MIRROR, side: _SIDES[side]}
        parts: dict[str, Any] = {
            name: take(arrays, f'mirror_{name}', *form) for name, form in forms.items()
        }
        fields['mirror'] = Mirror(**{**parts, side: parts[side].tolist()})
    if any(name in arrays for name in _LINE):
        forms = _LINE | {name: form for name, form in _LINE_OPTIONAL.items() if name in arrays}
        line = {name: take(arrays, name, *form).tolist() for name, form in forms.items()}
        count, axes = len(line['strides']), stacked + (4 if 'grid' in line else 3)
        line['weights'] = _layers(arrays, 'filter', count, axes)
        line['biases'] = _layers(arrays, 'filter_bias', count, stacked + 1)
        fields['convolution'] = Convolution(**line)
    if 'layer_norm' in arrays:
        fields['layer_norm'] = take(arrays, 'layer_norm', 'iu', 0).tolist()
        if fields['layer_norm'] != 1:
            raise ValueError(f"field 'layer_norm': is {fields['layer_norm']}; expected 1")
    for name in _OPTIONAL.keys() & arrays.keys():
        fields[name] = take(arrays, name, *_OPTIONAL[name])
    with errors.naming("field 'info'", (ValueError, RecursionError)):
        fields['info'] = json.loads(fields['info'])
    for name in sorted(arrays):
        if name.partition('_')[0] not in ('weight', 'bias'):
            raise ValueError(f'field {name!r}: is unknown')
        found = len(fields['weights'])
        raise ValueError(f"field 'layers': is {found}, but there are arrays of other layers")
    del fields['format'], fields['version']
    blocks = zip(fields.pop('block_names'), fields.pop('block_sizes'), strict=True)
    return Policy(blocks=tuple(blocks), **fields)


def _layers(
    arrays: dict[str, np.ndarray], name: str, count: int, axes: int
) -> tuple[np.ndarray, ...]:
    return tuple(take(arrays, f'{name}_{i}', 'f', axes) for i in range(count))


def reference(id: str, variant: str = '') -> Policy:
    """Returns the policy shipped for an environment.

    Args:
      id: id of the environment; `suite.reference_policy` also accepts aliases.
      variant: '', or one of `VARIANTS`, which some environments have in addition: 'randomized' is a
        policy that was trained in worlds and with sensors that vary, 'generalist' one for all
        terrains of a character.

    Raises:
      TypeError: the id is not a string.
      ValueError: unknown variant.
      FileNotFoundError: no policy is shipped for it; the message has the closest ids with a policy,
        or how to install the policies.
    """
    if not isinstance(id, str):
        raise TypeError(f'the id of an environment is a string, not {id!r}')
    shipped = available(variant)
    if id not in shipped and resources.lacks_policies():
        raise FileNotFoundError(
            f'no policy for {id!r}, because the trained policies are not installed: '
            "pip install 'trl_suite[policies]', or in a checkout pip install ./trained"
        )
    if id not in shipped:
        near = difflib.get_close_matches(id, shipped, n=3, cutoff=0)
        raise FileNotFoundError(
            f'no {f"{variant} " if variant else ""}policy is shipped for {id!r}; '
            + (f'the closest ids with a policy: {", ".join(near)}' if near else 'none is installed')
        )
    other, preference = _source(id, variant)
    path = _folder(variant) / f'{other}.npz'
    policy = load(path)
    if policy.id != other:
        raise ValueError(f"{path}: field 'id': is {policy.id!r}; expected {other!r}")
    if preference:
        policy = policy.with_preference(preference)
    return policy if id == other else dataclasses.replace(policy, id=id)


def available(variant: str = '') -> tuple[str, ...]:
    """Returns the ids of the environments that have a shipped policy, sorted; see `reference`."""
    own = (path.stem for path in _folder(variant).glob('*.npz'))
    return tuple(sorted({*own, *_shared(variant)}))


def trained_for(id: str) -> str:
    """Returns the id of the environment in which the shipped policy of an environment was trained."""
    return _source(id)[0]


def preference_for(id: str) -> float:
    """Returns the preference of the default gait with which an environment's policy is shipped."""
    return _source(id)[1]


def _source(id: str, variant: str = '') -> tuple[str, float]:
    """Returns the environment whose policy an environment uses, and the preference."""
    return _shared(variant).get(id, (id, 0.0))


def _folder(variant: str) -> pathlib.Path:
    """Returns the folder of the policies of a variant, or of '', the policies themselves."""
    if variant:
        errors.check_known('variant of policies', VARIANTS, variant)
    return resources.directory('trained') / variant


def _shared(variant: str = '') -> dict[str, tuple[str, float]]:
    """Returns the environments that use the policy of another one, its id, and the preference."""
    path = _folder(variant) / SHARED
    return _read_shared(path, path.stat().st_mtime_ns) if path.exists() else {}


@functools.lru_cache(maxsize=len(VARIANTS) + 1)
def _read_shared(path: pathlib.Path, changed: int) -> dict[str, tuple[str, float]]:
    """Reads the file of shared policies; `changed` is its modification time, ns."""
    return {
        id_: (entry['policy'], entry.get('preference', 0.0))
        for id_, entry in json.loads(path.read_text()).items()
    }


def _small(value: Any) -> Any:
    """Returns an array in half precision, if that is exact."""
    if not isinstance(value, np.ndarray) or value.dtype != np.float32:
        return value
    with np.errstate(over='ignore'):
        half = value.astype(np.float16)
    return half if np.array_equal(half, value) else value
