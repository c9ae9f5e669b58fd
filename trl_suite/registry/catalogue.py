"""All environments as data: ids as in the papers, aliases, tags, one-line descriptions.

Every environment has one of the tags 'original' (registered in the original simulator), 'completion'
(not registered there: a combination that its papers name or imply) and 'addition' (neither).
"""

from __future__ import annotations

from trl_suite.registry import deeploco, imitation, plaid, terrainrl
from trl_suite.registry.spec import STEP_LIMIT, EnvSpec
from trl_suite.util import errors

__all__ = [
    'ALIASES',
    'BY_ID',
    'BY_TASK',
    'FAMILIES',
    'SPECS',
    'STEP_LIMIT',
    'EnvSpec',
    'find',
    'spec_of',
]

FAMILIES = {  # titles of domains, in the order of the documentation
    'imitation': 'Imitation: tracking a clip on flat ground, or in three dimensions',
    'plaid': 'PLAiD: tracking a clip over terrain',
    'terrainrl': 'TerrainRL: gaits whose parameters an action sets for one cycle',
    'deeploco': 'DeepLoco: tracking and planning footsteps',
}

SPECS: tuple[EnvSpec, ...] = (
    *plaid.SPECS,
    *imitation.SPECS,
    *terrainrl.SPECS,
    *deeploco.SPECS,
)

BY_ID: dict[str, EnvSpec] = {spec.id: spec for spec in SPECS}
BY_TASK: dict[tuple[str, str], EnvSpec] = {(spec.domain, spec.task): spec for spec in SPECS}
ALIASES: dict[str, EnvSpec] = {
    alias: spec for spec in SPECS for alias in (*spec.aliases, f'{spec.domain}/{spec.task}')
}


def find(id: str) -> EnvSpec:
    """Returns the `EnvSpec` of an id or alias.

    Raises:
      TypeError: the id is not a string.
      ValueError: unknown id; the message has the closest matches.
    """
    if not isinstance(id, str):
        raise TypeError(f'the id of an environment is a string, not {id!r}')
    spec = BY_ID.get(id) or ALIASES.get(id)
    if spec is None:
        own = id.removeprefix('trl_suite/')
        if own != id and own in BY_ID:
            raise ValueError(f'{id!r} is an id of Gymnasium; expected {own!r}')
        raise ValueError(errors.unknown('environment', id, ALIASES if '/' in id else BY_ID))
    return spec


def spec_of(environment: str | EnvSpec) -> EnvSpec:
    """Returns the `EnvSpec` of an environment, from an id, an alias, or an `EnvSpec`."""
    if isinstance(environment, (str, EnvSpec)):
        return find(environment) if isinstance(environment, str) else environment
    raise TypeError(f'an environment is an id, an alias or an EnvSpec, not {environment!r}')
