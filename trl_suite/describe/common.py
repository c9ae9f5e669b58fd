"""Sections that every environment has: character, observation, terrain."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from trl_suite import characters, terrain
from trl_suite.environments.environment import Environment
from trl_suite.registry.spec import EnvSpec
from trl_suite.tasks.components.description import REWARD_WEIGHT, Meanings, floats
from trl_suite.util.tables import Section, Table, section


def character(environment: Environment, joints: tuple[str, Iterable[object]]) -> Iterator[Section]:
    """Yields the character of a task, and its links with one more column for its joints."""
    figure: Any = environment.task.character  # type: ignore[attr-defined]
    spec = figure.spec
    yield section(f'Character: {spec.name}', spec.description, figures(figure))
    yield section('Links', links(figure, environment.physics, joints))


def figures(figure: characters.Character) -> str:
    """Returns the whole-body figures of a character in one line."""
    spec = figure.spec
    own = characters.CHARACTERS.get(spec.name) is not spec
    found = characters.body_figures(characters.make(spec)) if own else _figures(spec.name)
    return (
        f'{found["mass"]:.4g} kg, stands {found["standing_height"]:.3g} m high at the root, '
        f'{len(spec.links)} links, {len(spec.joints)} joints'
    )


@functools.cache
def _figures(name: str) -> dict[str, Any]:
    return characters.body_figures(characters.make(name))


def links(figure: characters.Character, physics: Any, last: tuple[str, Iterable[object]]) -> Table:
    """Returns the table of a character's links and joints.

    Args:
      figure: the character.
      physics: in which it has been compiled.
      last: title of one more column, and what is in it for each joint.
    """
    masses = floats(physics.bind(figure.bodies).mass)
    own = figure.spec.root_weight if last[0] == REWARD_WEIGHT else ''
    cells: list[tuple[object, ...]] = [('root', masses[0], '', '', '', '', own)]
    for (name, joint), mass, (low, high), limit, slides, ball, more in zip(
        figure.spec.joints.items(), masses[1:], figure.joint_ranges, figure.torque_limits,
        figure.prismatic, figure.spherical, last[1], strict=True,
    ):  # fmt: skip
        reach = 'free' if np.isinf(low) else f'{low:.3g} to {high:.3g}'
        if ball:
            reach = f'ball, up to {high:.3g}'
        units = ('m', 'N', 'N/m', 'N s/m') if slides else ('', '', '', '')
        values = (reach, f'{limit:g}', f'{joint.kp:g}', f'{joint.kd:g}')
        cells.append((
            name, mass, *(f'{text} {unit}'.rstrip() for text, unit in zip(values, units, strict=True)),
            more,
        ))  # fmt: skip
    header = (
        'link and joint', 'kg', 'range (rad)', 'limit (N m)', 'kp (N m/rad)', 'kd (N m s/rad)',
        last[0],
    )  # fmt: skip
    return Table(header, cells)


def observation(environment: Environment, meanings: Meanings) -> Section:
    """Returns the blocks of the observation."""
    blocks = environment.blocks
    size = max(part.stop for part in blocks.values())
    task: Any = environment.task
    spatial = task.character.spec.spatial
    axes = "; axes: x along the root's heading, y to the left, z up" if spatial else ''
    return section(
        f'Observation: {size} numbers, in this order{axes}',
        Table(
            ('block', 'from', 'to', 'size', 'unit', 'meaning'),
            [
                (name, part.start, part.stop, part.stop - part.start, *meanings.get(name, ('', '')))
                for name, part in blocks.items()
            ],
        ),
    )


def ground(spec: EnvSpec) -> Section:
    """Returns the terrain and its parameters."""
    found = terrain.load(spec.part('terrain'))
    idle = terrain.IDLE.get(found.type, ())
    parameters = ', '.join(
        f'{name} {value:g}' for name, value in found.parameters().items() if name not in idle
    )
    sets = len(found.parameter_sets)
    more = f' (set 0 of {sets}; see the option terrain_level)' if sets > 1 else ''
    return section(
        f'Terrain: {found.name} ({found.type})', f'{parameters or "no parameters"}{more}'
    )
