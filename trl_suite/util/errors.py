"""Messages for invalid input: the value, what was expected, and the nearest valid choice."""

import collections.abc
import difflib
import math
import numbers
import types
import typing
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

LIKE, ALIKE = 0.6, 0.4  # `cutoff` of `difflib.get_close_matches`, for few and for many names
FEW = 20  # with at most this many names the stricter cutoff applies, since all can be listed
MANY = 40  # names; if there are more, only some of them are listed
KINDS: dict[object, tuple[tuple[type, ...], str, str]] = {  # types, singular and plural in words
    bool: ((bool, np.bool_), 'True or False', 'bools'),
    int: ((numbers.Integral,), 'a whole number', 'whole numbers'),
    float: ((numbers.Real,), 'a number', 'numbers'),
    str: ((str,), 'a string', 'strings'),
    types.NoneType: ((types.NoneType,), 'None', 'None'),
}


def unknown(kind: str, name: object, choices: Iterable[str]) -> str:
    """Returns a message for an unknown name, with its closest matches among `choices`."""
    known = sorted(choices)
    cutoff = LIKE if len(known) <= FEW else ALIKE
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


def check_known(kind: str, choices: Iterable[str], *names: Any) -> None:
    """Raises ValueError with the closest choices if a name is not one of them."""
    known = [*choices]
    for name in names:
        if name not in known:
            raise ValueError(unknown(kind, name, known))


def _listed(names: list[str]) -> str:
    if len(names) <= MANY:
        return ', '.join(names)
    return f'{len(names)}, such as {", ".join(names[:: len(names) // 5])}'


def is_number(value: object) -> bool:
    """Whether a value is a real number that is not NaN, no bool, and not too large for a float."""
    if not isinstance(value, numbers.Real) or isinstance(value, bool):
        return False
    try:
        return not math.isnan(value)
    except OverflowError:  # of whole numbers and fractions
        return False


def floats(name: str, value: Any) -> np.ndarray:
    """Returns a new array of floats.

    Raises:
      ValueError: the value is no number or array of numbers, or has one that is too large for a float;
        the message has the name.
    """
    try:
        return np.array(value, float)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f'{name}: expected a number, or an array of numbers: {error}') from None


def check_whole(name: str, value: object, low: int, high: int, why: str = '') -> None:
    """Checks that an argument is a whole number between two bounds.

    Args:
      name: name of the argument.
      value: a number; a float without a fractional part is valid.
      low, high: inclusive bounds.
      why: text at the end of the message, which explains the bounds.

    Raises:
      ValueError: the value is not such a number; the message has the name and the bounds.
    """
    if not is_number(value) or value % 1 or not low <= value <= high:  # type: ignore[operator]
        raise ValueError(f'{name} is {value!r}; expected a whole number from {low} to {high}{why}')


def options(name: str, value: Mapping[str, Any] | None) -> dict[str, Any]:
    """Returns a copy of a mapping of options; an empty dict for None.

    Args:
      name: name of the argument that holds them.
      value: the options by name, or None.

    Raises:
      TypeError: the value is not a mapping.
    """
    if value is not None and not isinstance(value, Mapping):
        raise TypeError(f'{name} is {value!r}; expected a dict of options by name')
    return dict(value or {})


def check_kind(name: str, value: object, hint: object) -> None:
    """Checks the value of an option against its type annotation.

    Args:
      name: name of the option.
      value: its value; any value is valid for an annotation that this function does not support.
      hint: the annotation.

    Raises:
      ValueError: the value has another type; the message has the name and what was expected.
    """
    choices = _choices(hint)
    if not any(_fits(value, choice) for choice in choices):
        expected = ' or '.join(dict.fromkeys(map(_words, choices)))
        raise ValueError(f'{name} is {value!r}; expected {expected}')


def _choices(hint: object) -> tuple[object, ...]:
    union = typing.get_origin(hint) in (typing.Union, types.UnionType)
    return typing.get_args(hint) if union else (hint,)


def _fits(value: object, hint: object) -> bool:
    if hint in KINDS:
        return isinstance(value, KINDS[hint][0]) and (hint not in (int, float) or is_number(value))
    if typing.get_origin(hint) in (collections.abc.Sequence, collections.abc.Collection):
        (inner,) = typing.get_args(hint)
        # Bytes and mappings are iterable as well, but their elements are not the intended values; nor
        # are those of a text, which is a sequence of texts only.
        if not isinstance(value, Iterable) or isinstance(value, (bytes, Mapping)):
            return False
        if isinstance(value, str) and inner is not str:
            return False
        return all(_fits(each, inner) for each in value)
    return True


def _words(hint: object, many: bool = False) -> str:
    if hint in KINDS:
        _, one, more = KINDS[hint]
        return more if many else one
    inner = ''.join(f' of {_words(each, many=True)}' for each in typing.get_args(hint)[:1])
    return f'lists{inner}' if many else f'a list{inner}'
