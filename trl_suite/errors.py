"""Sentences for bad input: what it was, what was expected, and the nearest valid choice."""

import difflib
from collections.abc import Iterable


def unknown(kind: str, name: object, choices: Iterable[str]) -> str:
    """Returns a message for an unknown name, with its closest matches among `choices`."""
    known = sorted(choices)
    near = difflib.get_close_matches(str(name), known, n=3, cutoff=0.4)
    if not near:
        lowered = {choice.lower(): choice for choice in known}
        near = [
            lowered[match]
            for match in difflib.get_close_matches(str(name).lower(), lowered, n=3, cutoff=0.4)
        ]
    hint = f'did you mean {" or ".join(map(repr, near))}?' if near else f'known: {", ".join(known)}'
    return f'unknown {kind} {name!r}; {hint}'
