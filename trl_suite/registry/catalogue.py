"""Every environment as data: ids of the paper, aliases, tags, one-line descriptions.

Environments tagged 'original' are registered in the original simulator; those tagged 'completion' are
combinations that its papers name and its registry lacks.
"""

from __future__ import annotations

from trl_suite.registry import deeploco, imitation, plaid, terrainrl
from trl_suite.registry.spec import STEP_LIMIT, EnvSpec
from trl_suite.util import errors

__all__ = ['ALIASES', 'BY_ID', 'BY_TASK', 'SPECS', 'STEP_LIMIT', 'EnvSpec', 'find']

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
    """Returns the row of an id or alias.

    Raises:
      ValueError: unknown id; the message has the closest matches.
    """
    spec = BY_ID.get(id) or ALIASES.get(id)
    if spec is None:
        raise ValueError(errors.unknown('environment', id, ALIASES if '/' in str(id) else BY_ID))
    return spec
