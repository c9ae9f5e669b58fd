"""Messages for invalid input: the value, what was expected, and the nearest valid choice."""

import contextlib
import difflib
import math
import numbers
import os
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

LIKE, ALIKE = 0.6, 0.4  # `cutoff` of `difflib.get_close_matches`, for few and for many names
FEW = 20  # with at most this many names the stricter cutoff applies, since all can be listed
MANY = 40  # names; if there are more, only some of them are listed


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


@contextlib.contextmanager
def naming(
    what: object, kinds: type[Exception] | tuple[type[Exception], ...] = ValueError
) -> Iterator[None]:
    """Makes errors of some kinds ValueErrors whose messages begin with `what`, e.g. a file."""
    try:
        yield
    except kinds as error:
        raise ValueError(f'{what}: {error}') from None


def _listed(names: list[str]) -> str:
    if len(names) <= MANY:
        return ', '.join(names) or 'none'
    return f'{len(names)}, such as {", ".join(names[:: len(names) // 5])}'


def is_number(value: object) -> bool:
    """Whether a value is a real number that is not NaN, no bool, and not too large for a float."""
    if not isinstance(value, numbers.Real) or isinstance(value, bool):
        return False
    try:
        return not math.isnan(value)
    except OverflowError:  # of whole numbers and fractions
        return False


def floats(
    name: str,
    value: Any,
    shape: tuple[int, ...] | None = None,
    most: float = math.inf,
    dtype: Any = float,
    missing: bool = False,
) -> np.ndarray:
    """Returns a read-only copy of an array of finite numbers.

    Args:
      name: its name, for messages.
      value: a number or an array of numbers.
      shape: expected shape; None for any.
      most: largest magnitude.
      dtype: type of floats of the copy.
      missing: whether numbers may be NaN.

    Raises:
      ValueError: anything else; the message has the name, and the index of a number.
    """
    try:
        found = np.asarray(value).dtype
        if found.kind not in 'fiubO':  # NumPy would turn texts and dates into numbers
            raise ValueError(f'the type is {found}')
        with np.errstate(over='ignore'):
            array = np.array(value, dtype, order='C')
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f'{name}: expected an array of numbers: {error}') from None
    if shape is not None and array.shape != shape:
        raise ValueError(f'{name}: has shape {array.shape}; expected {shape}')
    good = (np.isfinite(array) & (np.abs(array) <= most)) | (missing & np.isnan(array))
    if not good.all():
        index = np.argwhere(~good)[0].tolist()
        bound = '' if most == math.inf else f' of at most {most:g}'
        raise ValueError(f'{name}: {array[*index]} at {index}; expected finite numbers{bound}')
    array.setflags(write=False)
    return array


def options(name: str, value: Mapping[str, Any] | None) -> dict[str, Any]:
    """Returns a copy of a mapping of options; an empty dict for None. `name` is the argument's.

    Paths of files become absolute, since copies may be made in other folders.
    """
    if value is not None and not isinstance(value, Mapping):
        raise TypeError(f'{name} is {value!r}; expected a dict of options by name')
    found = dict(value or {})
    for key, each in found.items():
        if isinstance(each, Mapping):
            found[key] = options(key, each)
        elif type(each) in (list, tuple):
            found[key] = type(each)(map(_absolute, each))
        else:
            found[key] = _absolute(each)
    return found


def _absolute(value: Any) -> Any:
    """Returns the absolute path of a file, and any other value as it is."""
    is_path = isinstance(value, os.PathLike)
    if is_path or (isinstance(value, str) and value.endswith(('.npz', '.json'))):
        return os.path.abspath(value)
    return value
