"""Options as data: frozen dataclasses whose fields say what they mean and what they may be.

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class HopConfig(Config):
        height: float = option(0.3, 'height of a hop', unit='m', above=0)
        side: str = option('left', 'leg that hops', choices=('left', 'right'))

    HopConfig(height=0.5)
    HopConfig.of('my environment', {'heigth': 0.5})  # ValueError; did you mean 'height'?
    HopConfig.options()  # name, default, unit and meaning of each, for pages

Constructors, `trl-suite info`, the pages and the messages read the same fields.
"""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Collection, Iterable, Mapping
from typing import Any, NamedTuple, Self

import numpy as np

from trl_suite.util import errors


def option(
    default: Any,
    meaning: str,
    *,
    unit: str = '',
    at_least: float | None = None,
    above: float | None = None,
    below: float | None = None,
    choices: Collection[str] = (),
    actuation: str | None = None,
    policy: bool = False,
) -> Any:
    """Returns a dataclass field for an option.

    Args:
      default: its value where none is given.
      meaning: one line for people.
      unit: of numbers.
      at_least, above, below: bounds of every number in the value.
      choices: the only strings that the value may be, or hold.
      actuation: the only actuation model that has the option.
      policy: the value may be the id of an environment whose shipped policy is meant.
    """
    bounds = {'at_least': at_least, 'above': above, 'below': below}
    metadata = {
        'meaning': meaning, 'unit': unit, 'bounds': bounds, 'choices': tuple(choices),
        'actuation': actuation, 'policy': policy,
    }  # fmt: skip
    return dataclasses.field(default=default, metadata=metadata)


class Option(NamedTuple):
    """What is known of an option; see `option`."""

    name: str
    default: Any
    meaning: str
    unit: str = ''
    actuation: str | None = None
    policy: bool = False


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config:
    """The options of something; a subclass has a field made by `option` for each.

    Raises:
      ValueError: a value of another kind or out of range; the message names the option, and what was
        expected.
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
        """Makes a config of values by name.

        Args:
          owner: whose options they are, for messages.
          given: values that are not the default.
          others: names that somebody else takes, for messages.

        Raises:
          ValueError: an unknown name, or a value as for the class.
        """
        known = [field.name for field in dataclasses.fields(cls)]
        for name in given:
            if name not in known:
                raise ValueError(errors.unknown(f'option of {owner}', name, [*known, *others]))
        return cls(**given)

    @classmethod
    def options(cls) -> list[Option]:
        """Returns what there is to set."""
        return [
            Option(
                field.name, field.default,
                *(field.metadata[key] for key in ('meaning', 'unit', 'actuation', 'policy')),
            )
            for field in dataclasses.fields(cls)
        ]  # fmt: skip

    def _set(self, name: str, value: Any) -> None:
        """Puts a value in its final form; for `__post_init__` of subclasses."""
        object.__setattr__(self, name, value)


def _check_choices(name: str, value: Any, choices: tuple[str, ...]) -> None:
    if not choices or value is None:
        return
    for each in (value,) if isinstance(value, str) else value:
        if each not in choices:
            raise ValueError(errors.unknown(name, each, choices))


def _check_bounds(name: str, value: Any, metadata: Mapping[str, Any]) -> None:
    at_least, above, below = (metadata['bounds'][key] for key in ('at_least', 'above', 'below'))
    if value is None or (at_least is None and above is None and below is None):
        return
    numbers = np.ravel(np.asarray(value, float))
    good = np.isfinite(numbers) & (len(numbers) > 0)
    words = []
    if at_least is not None:
        good &= numbers >= at_least
        words.append(f'at least {at_least:g}')
    if above is not None:
        good &= numbers > above
        words.append(f'above {above:g}')
    if below is not None:
        good &= numbers < below
        words.append(f'below {below:g}')
    if not len(numbers) or not good.all():
        what = 'numbers' if np.ndim(value) else 'a number'
        unit = f', in {metadata["unit"]}' if metadata['unit'] else ''
        raise ValueError(f'{name} is {value}; expected {what} {" and ".join(words)}{unit}')
