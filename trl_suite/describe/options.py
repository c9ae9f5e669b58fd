"""The options in `task_kwargs`: name, default, unit and meaning of each."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Mapping
from typing import Any

from trl_suite.registry.build import task_options
from trl_suite.registry.spec import EnvSpec
from trl_suite.util.tables import Section, Table, section

_EVERYWHERE = (
    (
        'rewards, observations, failures',
        '-',
        '',
        'custom functions, see docs/make_your_own.md',
    ),
    (
        'actuators',
        '-',
        '',
        'limits, delay, noise, strength, free play and elasticity of motors: a dict, see docs/realism.md',
    ),
    ('random', '-', '', 'seed; by default drawn from the operating system'),
    ('time_limit', '-', 's', 'simulated time after which an episode is truncated'),
)


def options(spec: EnvSpec) -> Section:
    """Returns the table of an environment's options."""
    cells: list[tuple[object, ...]] = [
        (option.name, _shown(option.default), option.unit, option.meaning)
        for option in sorted(task_options(spec))
        if option.actuation in (None, spec.actuation)
    ]
    cells += _EVERYWHERE
    cells.append(('step_limit', spec.step_limit, '', 'steps after which an episode is truncated'))
    return section('Options in task_kwargs', Table(('option', 'default', 'unit', 'meaning'), cells))


def _shown(value: Any) -> str:
    if value is None or value is inspect.Parameter.empty:
        return '-'
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = dataclasses.asdict(value)
    return repr(dict(value) if isinstance(value, Mapping) else value)
