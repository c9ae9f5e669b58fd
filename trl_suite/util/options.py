"""Options as data: frozen dataclasses whose fields have a meaning, a unit and bounds.

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class HopConfig(Config):
        height: Range = option(Range(0.3, 0.3), 'height of a hop', unit='m', at_least=0, at_most=2)
        side: str = option('left', 'leg that hops', choices=('left', 'right'))

    HopConfig(height=0.5).height  # Range(0.5, 0.5); height=(0.2, 0.5) is drawn between them
    HopConfig.parse('my environment', {'heigth': 0.5})  # ValueError; did you mean 'height'?
    dataclasses.fields(HopConfig)  # name and default of each; `metadata` has meaning, unit and bounds

Constructors, `trl-suite info`, documentation pages and error messages read the same fields.
`checked` applies the same rules to the arguments of functions.
"""

from __future__ import annotations

import dataclasses
import math
import operator
import types
import typing
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np

from trl_suite.util import errors

_COMPARISONS = {
    'at_least': operator.ge,
    'at_most': operator.le,
    'above': operator.gt,
    'below': operator.lt,
}


class Range(NamedTuple):
    """Bounds between which a value is drawn; an option also takes a number, which is both."""

    low: float
    high: float


_UNFIT = object()  # stands for a value of another type
_TYPES: dict[Any, Any] = {bool: (bool, np.bool_), str: str, types.NoneType: types.NoneType}
_SEQUENCES = (list, Sequence, Collection)
_WORDS: dict[object, tuple[str, str]] = {  # kinds of values, singular and plural
    bool: ('True or False', 'bools'),
    int: ('a whole number', 'whole numbers'),
    float: ('a number', 'numbers'),
    str: ('a string', 'strings'),
    types.NoneType: ('None', 'None'),
    Range: ('a number or a lower and an upper bound', 'ranges'),
}


def option(
    default: Any,
    meaning: str,
    *,
    unit: str = '',
    choices: Collection[str] = (),
    actuation: str | None = None,
    policy: bool = False,
    **bounds: float,
) -> Any:
    """Returns a dataclass field for an option.

    Args:
      default: default value.
      meaning: one line for `trl-suite info` and the pages.
      unit: unit of the value, if it is a number.
      choices: the allowed strings, for the value or its elements.
      actuation: the only actuation model that has the option.
      policy: whether the id of an environment may be given for the policy that is shipped for it.
      **bounds: at_least, at_most, above or below, of every number in the value.
    """
    metadata: dict[str, Any] = {'meaning': meaning, 'unit': unit, 'bounds': bounds}
    metadata |= {'choices': tuple(choices), 'actuation': actuation, 'policy': policy}
    return dataclasses.field(default=default, metadata=metadata)


def within(low: float, high: float, unit: str = '') -> dict[str, Any]:
    """Returns bounds and unit for `option`: every number is from low to high."""
    return {'at_least': low, 'at_most': high, 'unit': unit}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config:
    """Base class of options; a subclass has a field, made by `option`, for each of them.

    An option whose type is a `Range` or another `Config` also takes a number, or a dict of options;
    of a `Config` that is not optional, None stands for the defaults.

    Attributes:
      presets: values of options by the name of a preset; a class that has some has an option `preset`.

    Raises:
      ValueError: a value of another type or out of range; the message has the name of the option
        and what was expected.
    """

    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = types.MappingProxyType({})

    def __post_init__(self) -> None:
        kinds = typing.get_type_hints(type(self))
        for field in dataclasses.fields(self):
            name, data = field.name, field.metadata
            limits = data['unit'], data['choices']
            found = checked(name, getattr(self, name), kinds[name], *limits, **data['bounds'])
            object.__setattr__(self, name, found)

    @classmethod
    def parse(cls, owner: str, given: Any, others: Iterable[str] = ()) -> Self:
        """Makes a config from what a user gives.

        Args:
          owner: name of the owner of the options, for messages.
          given: values that differ from the defaults, or from those of a preset, by name; the name
            of a preset; or a config.
          others: further valid names that are handled elsewhere, for messages.

        Raises:
          ValueError: anything else, an unknown name, or an invalid value.
        """
        if isinstance(given, cls):
            return given
        if isinstance(given, str) and cls.presets:
            given = {'preset': given}
        if not isinstance(given, Mapping):
            names = ''.join(f'{name!r}, ' for name in cls.presets)
            raise ValueError(
                f'{owner} is {given!r}; expected {names}a dict of options, or {cls.__name__}'
            )
        known = [field.name for field in dataclasses.fields(cls)]
        if not {*known}.issuperset(given):
            errors.check_known(f'option of {owner}', [*known, *others], *given)
        preset = given.get('preset')
        return cls(**{**(cls.presets.get(preset, {}) if isinstance(preset, str) else {}), **given})

    @property
    def changed(self) -> dict[str, Any]:
        """The options that differ from the defaults, by name."""
        return {
            field.name: getattr(self, field.name)
            for field in dataclasses.fields(self)
            if getattr(self, field.name) != field.default
        }

    def _set(self, name: str, value: Any) -> None:
        """Replaces a value by its canonical form; for `__post_init__` of subclasses."""
        object.__setattr__(self, name, value)


def checked(
    name: str,
    value: Any,
    kind: Any,
    unit: str = '',
    choices: Collection[str] = (),
    /,
    **bounds: float,
) -> Any:
    """Returns a value in its normal form: a `Range`, a `Config`, an integer, a tuple of a sequence.

    Args:
      name: name of the option or argument.
      value: its value. Numbers must be finite; any without a fractional part is a whole number.
      kind: its type annotation; any value is valid for types that this function does not know.
      unit: unit of numbers, for the message.
      choices: the allowed strings, for the value or its elements.
      **bounds: at_least, at_most, above or below, of every number in the value.

    Raises:
      ValueError: the value has another type or is out of range; the message has the name and what
        was expected.
    """
    union = typing.get_origin(kind) in (typing.Union, types.UnionType)
    kinds = typing.get_args(kind) if union else (kind,)
    if value is None and types.NoneType in kinds:
        return None
    found: Any = _UNFIT
    for each in kinds:
        if found is _UNFIT:
            found = _normal(name, value, each)
    if found is not _UNFIT and choices:
        errors.check_known(name, choices, *((found,) if isinstance(found, str) else found))
    if found is _UNFIT or (bounds and not _is_within(found, bounds)):
        words = dict.fromkeys(_words(each) for each in sorted(kinds, key=_is_numeric))
        expected = ' or '.join(words) + _limits(bounds) + (f', in {unit}' if unit else '')
        raise ValueError(f'{name} is {value!r}; expected {expected}')
    return found


def _normal(name: str, value: Any, kind: Any) -> Any:
    """Returns a value in the normal form of a kind, or `_UNFIT`."""
    if kind in (int, float):
        fits = errors.is_number(value) and math.isfinite(value) and not (kind is int and value % 1)
        return _UNFIT if not fits else int(value) if kind is int else value
    if kind in _TYPES:
        return value if isinstance(value, _TYPES[kind]) else _UNFIT
    if kind is Range:
        pair = (value, value) if errors.is_number(value) else _sequence(name, value, float)
        fits = pair is not _UNFIT and len(pair) == 2 and -math.inf < pair[0] <= pair[1] < math.inf
        return Range(*map(float, pair)) if fits else _UNFIT
    if isinstance(kind, type) and issubclass(kind, Config):
        return kind.parse(name, {} if value is None else value)
    if typing.get_origin(kind) in _SEQUENCES:
        return _sequence(name, value, *typing.get_args(kind))
    return value


def _sequence(name: str, value: Any, kind: Any) -> Any:
    if isinstance(value, (str, bytes, Mapping)):  # their elements are not the intended values
        return _UNFIT
    try:
        found = tuple(_normal(name, each, kind) for each in value)
    except TypeError:  # not iterable
        return _UNFIT
    return _UNFIT if any(each is _UNFIT for each in found) else found


def _is_within(value: Any, bounds: Mapping[str, float]) -> bool:
    found = np.ravel(np.asarray(value, float))
    return len(found) > 0 and all(_COMPARISONS[k](found, b).all() for k, b in bounds.items())


def _is_numeric(kind: Any) -> bool:
    return kind in (int, float, Range) or any(map(_is_numeric, typing.get_args(kind)))


def _words(kind: Any, many: bool = False) -> str:
    if kind in _WORDS:
        return _WORDS[kind][many]
    inner = ''.join(f' of {_words(each, many=True)}' for each in typing.get_args(kind)[:1])
    return f'lists{inner}' if many else f'a list{inner}'


def _limits(bounds: Mapping[str, float]) -> str:
    """Returns bounds in words."""
    text = {key: str(b) if isinstance(b, int) else f'{b:g}' for key, b in bounds.items()}
    if [*text] == ['at_least', 'at_most']:
        return ' from {at_least} to {at_most}'.format(**text)
    words = ' and '.join(f'{key.replace("_", " ")} {number}' for key, number in text.items())
    return f' {words}' if words else ''
