"""Parameters of gaits: vectors, base actions, and which parameters an action sets.

One JSON file per character:

    kind                     'bound', 'stride' or 'hop', see `trl_suite.controllers.gaits`; the
                             meaning of the first parameters depends on it
    legs                     joints of each leg, the hip first: for a bound the hind leg and the
                             fore leg, down to the joint of the foot, for a stride right and left
    feet                     links that touch the ground, one for each leg
    misc, state_parameters   names; a vector is [misc..., those of state 0, those of state 1, ...]
    targets                  parameter of a state -> joints whose target it is; for a stride, in
                             right stance
    states                   names, in their order in a cycle
    fixed                    parameters that actions do not set
    absolute                 parameters of which the absolute value is used
    target_speed             m/s, for the reward
    sets                     name -> vector
    base_actions             [set, set, blend]: gaits to select from; they determine the action ranges
    action_offset            action 0: name of a set, or index of a base action
    search_scale             name without state -> standard deviation for a search
    start                    initial state: height of the root m, pitch rad, velocity of the root
                             (m/s, m/s, rad/s), and angle and rate of each joint

and optionally, for exceptions:

    original_base_actions    the base actions of the papers' mixture of experts, if they differ
                             from `base_actions`
    tuning                   set -> record and scores of the search that found it
    gravity_compensation     false: legs of a bound on the ground do not support the weight
    forward_only             true: a root that moves backwards is a fall
    backward_reward          false: the reward of a cycle with negative speed is 0
    reward                   weights of the terms 'speed' and 'stumble', by default 0.8 and 0.2
    observe_pitch            true: pitch and its rate replace z of the last link and its rate

Source of the values: the controllers of Terrain RL Simulator (2018) and of Peng, Berseth, van de
Panne (2016). The sets that 'tuning' lists, and 'tuned' of biped2d_simbicon, were found for this suite.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib.resources
import json
from typing import Any

import numpy as np

from trl_suite.util import errors

KINDS = ('bound', 'stride', 'hop')
BASE_ACTIONS = ('default', 'original')
REWARD = {'speed': 0.8, 'stumble': 0.2}


@dataclasses.dataclass(frozen=True, eq=False)
class Parameters:
    """The parameter vectors of one character's gait.

    Other attributes are entries of its file, see the module.

    Attributes:
      names: names of the P parameters, e.g. 'Cv' or 'Gather.Hip'.
      misc: number of parameters before those of the states.
      actions: indices of the a parameters that an action sets.
      absolute: indices of parameters of which the absolute value is used.
      sets: name -> vector, (P,).
      base_actions: vectors of the base actions, (B, P).
      blends: for each base action, two sets and the share of the second.
      action_offset: vector at action 0, (P,).
      action_scale: largest deviation of a base action from action_offset, (P,), the change per unit
        action: all base actions are in [-1, 1].
      search_scale: standard deviation for a search, (P,).
    """

    character: str
    kind: str
    legs: tuple[tuple[str, ...], ...]
    feet: tuple[str, ...]
    targets: dict[str, tuple[str, ...]]
    names: tuple[str, ...]
    misc: int
    states: tuple[str, ...]
    actions: np.ndarray
    absolute: np.ndarray
    target_speed: float
    sets: dict[str, np.ndarray]
    base_actions: np.ndarray
    blends: tuple[tuple[str, str, float], ...]
    action_offset: np.ndarray
    action_scale: np.ndarray
    search_scale: np.ndarray
    start: dict[str, Any]
    gravity_compensation: bool
    forward_only: bool
    backward_reward: bool
    reward: dict[str, float]
    observe_pitch: bool

    def vector(self, action: np.ndarray) -> np.ndarray:
        """Returns parameters (n, P) for actions (n, a): action_offset + action_scale * action."""
        vectors = np.tile(self.action_offset, (len(action), 1))
        vectors[:, self.actions] += self.action_scale[self.actions] * action
        return vectors

    def action(self, vector: np.ndarray) -> np.ndarray:
        """Returns actions (..., a) for parameters (..., P); fixed parameters are ignored."""
        return (vector - self.action_offset)[..., self.actions] / self.action_scale[self.actions]

    def place(self, name: str) -> int:
        """Returns the index of a parameter."""
        return self.names.index(name)


def available() -> tuple[str, ...]:
    """Returns the characters that have a gait."""
    files = importlib.resources.files(__package__).iterdir()
    return tuple(sorted(f.name.removesuffix('.json') for f in files if f.name.endswith('.json')))


@functools.cache
def load(character: str, base_actions: str = 'default') -> Parameters:
    """Returns the parameters of a character's gait.

    Args:
      character: its name.
      base_actions: 'default', or 'original' for those of the papers.
    """
    errors.check_known('base_actions', BASE_ACTIONS, base_actions)
    errors.check_known('character with a gait', available(), character)
    text = (importlib.resources.files(__package__) / f'{character}.json').read_text()
    data = json.loads(text)
    if base_actions == 'original' and 'original_base_actions' in data:
        data |= {'base_actions': data['original_base_actions'], 'action_offset': 0}
    return read(data)


def read(data: dict[str, Any]) -> Parameters:
    """Makes parameters from the content of a file."""
    errors.check_known('kind of gait', KINDS, data['kind'])
    legs = tuple(tuple(leg) for leg in data['legs'])
    if len({len(leg) for leg in legs}) != 1 or len(legs) != len(data['feet']):
        raise ValueError('legs: expected the same number of joints for all, and one foot for each')
    errors.check_known('parameter of a state', data['state_parameters'], *data['targets'])
    names = (*data['misc'], *(f'{s}.{p}' for s in data['states'] for p in data['state_parameters']))
    sets = {name: np.array(values, float) for name, values in data['sets'].items()}
    for name, values in sets.items():
        if values.shape != (len(names),) or not np.isfinite(values).all():
            raise ValueError(f'set {name!r} needs {len(names)} finite numbers: {", ".join(names)}')
    errors.check_known('parameter', names, *(*data['fixed'], *data['absolute']))
    base = np.array(
        [(1 - blend) * sets[a] + blend * sets[b] for a, b, blend in data['base_actions']]
    )
    action_offset = data['action_offset']
    action_offset = sets[action_offset] if isinstance(action_offset, str) else base[action_offset]
    action_scale = np.abs(base - action_offset).max(0)
    for name, scale in zip(names, action_scale, strict=True):
        if scale == 0 and name not in data['fixed']:
            raise ValueError(
                f'parameter {name!r} has no range: expected a base action that changes it, or its '
                'name in fixed'
            )
    return Parameters(
        character=data['character'],
        kind=data['kind'],
        legs=legs,
        feet=tuple(data['feet']),
        targets={name: tuple(joints) for name, joints in data['targets'].items()},
        names=names,
        misc=len(data['misc']),
        states=tuple(data['states']),
        actions=np.array([i for i, name in enumerate(names) if name not in data['fixed']]),
        absolute=np.array([names.index(name) for name in data['absolute']]),
        target_speed=data['target_speed'],
        sets=sets,
        base_actions=base,
        blends=tuple((a, b, float(blend)) for a, b, blend in data['base_actions']),
        action_offset=action_offset,
        action_scale=action_scale,
        search_scale=np.array([data['search_scale'][name.split('.')[-1]] for name in names]),
        start=data['start'],
        gravity_compensation=data.get('gravity_compensation', True),
        forward_only=data.get('forward_only', False),
        backward_reward=data.get('backward_reward', True),
        reward=data.get('reward', REWARD),
        observe_pitch=data.get('observe_pitch', False),
    )
