"""Sentences for bad input: what it was, what was expected, and the nearest valid choice."""

import difflib
from collections.abc import Iterable

LIKE, ALIKE = 0.6, 0.4  # shares of two names that must agree, see `difflib`
FEW = 20  # names that may all be listed where none is like the one given
MANY = 40  # names; of more only some are listed


def unknown(kind: str, name: object, choices: Iterable[str]) -> str:
    """Returns a message for an unknown name, with its closest matches among `choices`."""
    known = sorted(choices)
    cutoff = LIKE if len(known) <= FEW else ALIKE  # few can all be told instead
    near = difflib.get_close_matches(str(name), known, n=3, cutoff=cutoff)
    if not near:
        lowered = {choice.lower(): choice for choice in known}
        near = [
            lowered[match]
            for match in difflib.get_close_matches(str(name).lower(), lowered, n=3, cutoff=cutoff)
        ]
    if not near and str(name):
        near = [choice for choice in known if choice.startswith(str(name))][:3]
    hint = f'did you mean {" or ".join(map(repr, near))}?' if near else f'known: {_listed(known)}'
    return f'unknown {kind} {name!r}; {hint}'


def _listed(names: list[str]) -> str:
    if len(names) <= MANY:
        return ', '.join(names)
    return f'{len(names)}, such as {", ".join(names[:: len(names) // 5])}'
