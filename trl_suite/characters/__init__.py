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
    'spec_of',
)


def spec_of(character: str | CharacterSpec) -> CharacterSpec:
    """Returns the spec of a character.

    Args:
      character: a name in `CHARACTERS`, or a user's own `CharacterSpec`, which is returned.

    Raises:
      ValueError: an unknown name.
      TypeError: neither a name nor a `CharacterSpec`.
    """
    if isinstance(character, str):
        errors.check_known('character', CHARACTERS, character)
        return CHARACTERS[character]
    if not isinstance(character, CharacterSpec):
        raise TypeError(
            f'character is {character!r}; expected a name, or what characters.from_file returns'
        )
    return character


def make(character: str | CharacterSpec) -> Character:
    """Builds a character entity; see `spec_of`.

    Raises:
      ValueError: also an MJCF file that lacks a link or joint of the spec.
    """
    return Character(spec_of(character))
