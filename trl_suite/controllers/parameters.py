"""What a gait is as numbers: parameter vectors, base actions, and which of them an agent sets.

One JSON file per character:

    misc, state_parameters   names; a vector is [misc..., of state 0..., of state 1..., ...]
    states                   names, in the order of visit
    fixed                    parameters that are no part of an action
    absolute                 parameters whose sign does not count
    target_speed             m/s, of the reward
    sets                     name -> vector
    base_actions             [set, set, blend]: the gaits that the papers' mixture of experts mixed
    centre                   action 0: a set by name, or a base action by number
    search_scale             by name, without state: standard deviations for a search
    start                    the pose of the first instant: height of the root m, pitch rad, velocity
                             of the root (m/s, m/s, rad/s), and angle and rate of each joint

Source of the figures: the controllers of Terrain RL Simulator (2018) and of Peng, Berseth, van de
Panne (2016); the sets 'tuned' of biped2d_simbicon and goat are our own.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib.resources
import json
from typing import Any

import numpy as np

from trl_suite import errors


@dataclasses.dataclass(frozen=True, eq=False)
class Parameters:
    """The parameter vectors of one character's gait.

    Attributes:
      character: name of the character.
      names: of the P parameters, 'Cv' or 'Gather.Hip'.
      misc: how many come before those of the states.
      states: names.
      actions: places of the a parameters that an agent sets.
      absolute: places of those whose sign does not count.
      target_speed: m/s.
      sets: name -> (P,).
      base_actions: (8 or so, P).
      blends: of each base action: a set, another, and the other's share.
      centre: what action 0 means, (P,).
      half_range: largest deviation of a base action from the first one, (P,); what action 1 adds.
      search_scale: standard deviation for a search, (P,).
      start: the pose of the first instant, see the module.
    """

    character: str
    names: tuple[str, ...]
    misc: int
    states: tuple[str, ...]
    actions: np.ndarray
    absolute: np.ndarray
    target_speed: float
    sets: dict[str, np.ndarray]
    base_actions: np.ndarray
    blends: tuple[tuple[str, str, float], ...]
    centre: np.ndarray
    half_range: np.ndarray
    search_scale: np.ndarray
    start: dict[str, Any]

    def vector(self, action: np.ndarray) -> np.ndarray:
        """Returns the parameters (n, P) that actions (n, a) mean: centre + half_range * action."""
        vectors = np.tile(self.centre, (len(action), 1))
        vectors[:, self.actions] += self.half_range[self.actions] * action
        return vectors

    def action(self, vector: np.ndarray) -> np.ndarray:
        """Returns the actions (..., a) that mean parameters (..., P), as far as actions can."""
        return (vector - self.centre)[..., self.actions] / self.half_range[self.actions]

    def place(self, name: str) -> int:
        """Returns where a parameter lies."""
        return self.names.index(name)


def available() -> tuple[str, ...]:
    """Returns the characters that have a gait."""
    files = importlib.resources.files(__package__).iterdir()
    return tuple(sorted(f.name.removesuffix('.json') for f in files if f.name.endswith('.json')))


@functools.cache
def load(character: str) -> Parameters:
    """Returns the parameters of a character's gait.

    Raises:
      ValueError: the character has none.
    """
    if character not in available():
        raise ValueError(errors.unknown('character with a gait', character, available()))
    text = (importlib.resources.files(__package__) / f'{character}.json').read_text()
    return read(json.loads(text))


def read(data: dict[str, Any]) -> Parameters:
    """Makes parameters from what a file holds.

    Raises:
      ValueError: a vector has another length, or a name is unknown.
    """
    names = (*data['misc'], *(f'{s}.{p}' for s in data['states'] for p in data['state_parameters']))
    sets = {name: np.array(values, float) for name, values in data['sets'].items()}
    for name, values in sets.items():
        if values.shape != (len(names),) or not np.isfinite(values).all():
            raise ValueError(f'set {name!r} needs {len(names)} finite numbers: {", ".join(names)}')
    for name in (*data['fixed'], *data['absolute']):
        if name not in names:
            raise ValueError(errors.unknown('parameter', name, names))
    base = np.array(
        [(1 - blend) * sets[a] + blend * sets[b] for a, b, blend in data['base_actions']]
    )
    centre = data['centre']
    return Parameters(
        character=data['character'],
        names=names,
        misc=len(data['misc']),
        states=tuple(data['states']),
        actions=np.array([i for i, name in enumerate(names) if name not in data['fixed']]),
        absolute=np.array([names.index(name) for name in data['absolute']]),
        target_speed=data['target_speed'],
        sets=sets,
        base_actions=base,
        blends=tuple((a, b, float(blend)) for a, b, blend in data['base_actions']),
        centre=sets[centre] if isinstance(centre, str) else base[centre],
        half_range=np.abs(base - base[0]).max(0),
        search_scale=np.array([data['search_scale'][name.split('.')[-1]] for name in names]),
        start=data['start'],
    )
