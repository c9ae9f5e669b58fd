"""Characters: articulated figures as composer entities."""

from __future__ import annotations

from trl_suite.characters.character import (
    Character,
    CharacterSpec,
    Joint,
    body_figures,
)
from trl_suite.characters.from_file import from_file
from trl_suite.characters.specs import CHARACTERS
from trl_suite.util import errors

__all__ = (
    'CHARACTERS',
    'Character',
    'CharacterSpec',
    'Joint',
    'body_figures',
    'from_file',
    'make',
)


def make(character: str | CharacterSpec) -> Character:
    """Builds a character entity.

    Args:
      character: a name in `CHARACTERS`, or a user's own `CharacterSpec`.

    Raises:
      ValueError: an unknown name, or an MJCF file that lacks a link or joint of the spec.
      TypeError: neither a name nor a `CharacterSpec`.
    """
    if isinstance(character, str):
        errors.check_known('character', CHARACTERS, character)
        character = CHARACTERS[character]
    if not isinstance(character, CharacterSpec):
        raise TypeError(
            f'character is {character!r}; expected a name, or what characters.from_file returns'
        )
    return Character(character)
