"""The options in `task_kwargs`: name, default, unit and meaning of each."""

from __future__ import annotations

import dataclasses
import inspect
import math
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Any

from trl_suite.actuation.realism import NOT_FOR_MUSCLES, Actuators
from trl_suite.bodies.blocks import Block
from trl_suite.registry.build import task_options
from trl_suite.registry.spec import EnvSpec
from trl_suite.tasks.variation import CommonOptions, pushes, sensors, worlds
from trl_suite.util.options import Config, Range
from trl_suite.util.tables import Section, Table, section


def options(spec: EnvSpec) -> Section:
    """Returns the table of an environment's options."""
    common = dataclasses.fields(CommonOptions)
    cells: list[tuple[object, ...]] = [
        *(
            (name, _shown(default), data['unit'], data['meaning'])
            for name, (default, data) in sorted(task_options(spec).items())
            if data['actuation'] in (None, spec.actuation)
        ),
        *((each.name, '-', '', each.metadata['meaning']) for each in common),
        ('random', '-', '', 'seed; by default drawn from the operating system'),
        ('time_limit', '-', 's', 'simulated time after which an episode is truncated'),
        ('step_limit', spec.step_limit, '', 'steps after which an episode is truncated'),
    ]
    return section('Options in task_kwargs', Table(('option', 'default', 'unit', 'meaning'), cells))


def disturbances(actuation: str, blocks: Iterable[Block]) -> Iterator[Section]:
    """Yields the options of actuators, worlds, pushes and sensors; blocks are those of the task."""
    omitted = NOT_FOR_MUSCLES if actuation == 'muscle' else ()
    yield section('Options of actuators', table_of(Actuators, omitted))
    yield section(
        'Options of randomize',
        'Each is a number, or two bounds between which it is drawn at the start of an episode.',
        table_of(worlds.WorldConfig),
        'Options of push, in randomize:',
        table_of(pushes.PushConfig),
        '\n'.join(f'- randomize={name!r}: {dict(v)}' for name, v in worlds.PRESETS.items()),
    )
    yield section(
        'Options of sensors',
        table_of(sensors.SensorConfig),
        'Presets, with the values for mild, robot and harsh:',
        presets_of_sensors(blocks),
    )


def table_of(config: type[Config], omitted: Collection[str] = ()) -> Table:
    """Returns a table of the options of a config, with their bounds, except omitted ones."""
    cells = []
    for field in dataclasses.fields(config):
        if field.name in omitted:
            continue
        data, limits = field.metadata, []
        for key in ('at_least', 'above', 'at_most', 'below'):
            if (bound := data['bounds'].get(key)) is not None:
                limits.append(f'{key.replace("_", " ")} {bound:.4g}')
        cells.append(
            (field.name, _shown(field.default), data['unit'], ', '.join(limits), data['meaning'])
        )
    return Table(('option', 'default', 'unit', 'bounds', 'meaning'), cells)


def presets_of_sensors(blocks: Iterable[Block]) -> Table:
    """Returns a table of what the presets of sensors do to observation blocks."""
    cells: list[tuple[object, ...]] = []
    for block in (block for block in blocks if block.size):
        if isinstance(block.noise, str):
            cells.append((block.name, block.unit, 'exact', '', ''))
        else:
            shown = [' '.join(f'{value:g}' for value in values) for values in block.noise[:3]]
            cells.append((block.name, block.unit, *shown))
    share = ' '.join(f'{value:g}' for value in sensors.TERRAIN_DROPOUT)
    cells.append(('terrain_dropout', '1', share, '', ''))
    return Table(('block', 'unit', 'noise', 'bias', 'delay up to'), cells)


def _shown(value: Any) -> str:
    if value is None or value is inspect.Parameter.empty:
        return '-'
    if isinstance(value, Range):
        if (value.low, value.high) == (-math.pi, math.pi):
            return '(-π, π)'
        value = value.low if value.low == value.high else tuple(value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = dataclasses.asdict(value)
    return repr(dict(value) if isinstance(value, Mapping) else value)
