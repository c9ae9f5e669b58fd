"""Options as data: frozen dataclasses whose fields have a meaning, a unit and bounds.

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class HopConfig(Config):
        height: float = option(0.3, 'height of a hop', unit='m', above=0)
        side: str = option('left', 'leg that hops', choices=('left', 'right'))

    HopConfig(height=0.5)
    HopConfig.of('my environment', {'heigth': 0.5})  # ValueError; did you mean 'height'?
    HopConfig.options()  # name, default, unit and meaning of each, for pages

Constructors, `trl-suite info`, documentation pages and error messages read the same fields.
"""

from __future__ import annotations

import dataclasses
import operator
import typing
from collections.abc import Collection, Iterable, Mapping
from typing import Any, NamedTuple, Self

import numpy as np

from trl_suite.util import errors

_COMPARISONS = {
    'at_least': operator.ge, 'at_most': operator.le, 'above': operator.gt, 'below': operator.lt,
}  # fmt: skip


def option(
    default: Any,
    meaning: str,
    *,
    unit: str = '',
    at_least: float | None = None,
    at_most: float | None = None,
    above: float | None = None,
    below: float | None = None,
    choices: Collection[str] = (),
    actuation: str | None = None,
    policy: bool = False,
) -> Any:
    """Returns a dataclass field for an option.

    Args:
      default: default value.
      meaning: one line for `trl-suite info` and the pages.
      unit: unit of the value, if it is a number.
      at_least, at_most, above, below: bounds of every number in the value.
      choices: the allowed strings, for the value or its elements.
      actuation: the only actuation model that has the option.
      policy: whether the id of an environment may be given for the policy that is shipped for it.
    """
    bounds = {'at_least': at_least, 'at_most': at_most, 'above': above, 'below': below}
    metadata = {
        'meaning': meaning, 'unit': unit, 'bounds': bounds, 'choices': tuple(choices),
        'actuation': actuation, 'policy': policy,
    }  # fmt: skip
    return dataclasses.field(default=default, metadata=metadata)


class Option(NamedTuple):
    """Name and properties of an option; see `option`."""

    name: str
    default: Any
    meaning: str
    unit: str = ''
    actuation: str | None = None
    policy: bool = False


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config:
    """Base class of options; a subclass has a field, made by `option`, for each of them.

    Raises:
      ValueError: a value of another type or out of range; the message has the name of the option
        and what was expected.
    """

    def __post_init__(self) -> None:
        hints = typing.get_type_hints(type(self))
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            errors.check_kind(field.name, value, hints[field.name])
            _check_choices(field.name, value, field.metadata['choices'])
            _check_bounds(field.name, value, field.metadata)

    @classmethod
    def of(cls, owner: str, given: Mapping[str, Any], others: Iterable[str] = ()) -> Self:
        """Makes a config from values by name.

        Args:
          owner: name of the owner of the options, for messages.
          given: values that differ from the defaults.
          others: further valid names that are handled elsewhere, for messages.

        Raises:
          ValueError: an unknown name, or an invalid value.
        """
        known = [field.name for field in dataclasses.fields(cls)]
        for name in given:
            if name not in known:
                raise ValueError(errors.unknown(f'option of {owner}', name, [*known, *others]))
        return cls(**given)

    @classmethod
    def options(cls) -> list[Option]:
        """Returns all options of the class."""
        return [
            Option(
                field.name, field.default,
                *(field.metadata[key] for key in ('meaning', 'unit', 'actuation', 'policy')),
            )
            for field in dataclasses.fields(cls)
        ]  # fmt: skip

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


def _check_choices(name: str, value: Any, choices: tuple[str, ...]) -> None:
    if not choices or value is None:
        return
    for each in (value,) if isinstance(value, str) else value:
        if each not in choices:
            raise ValueError(errors.unknown(name, each, choices))


def _check_bounds(name: str, value: Any, metadata: Mapping[str, Any]) -> None:
    bounds: dict[str, float | None] = metadata['bounds']
    if value is None or set(bounds.values()) == {None}:
        return
    numbers = np.ravel(np.asarray(value, float))
    good = np.isfinite(numbers) & (len(numbers) > 0)
    words = []
    for key, bound in bounds.items():
        if bound is not None:
            good &= _COMPARISONS[key](numbers, bound)
            words.append(f'{key.replace("_", " ")} {bound:g}')
    if not len(numbers) or not good.all():
        what = 'numbers' if np.ndim(value) else 'a number'
        unit = f', in {metadata["unit"]}' if metadata['unit'] else ''
        raise ValueError(f'{name} is {value}; expected {what} {" and ".join(words)}{unit}')
