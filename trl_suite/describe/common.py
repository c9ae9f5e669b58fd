"""Sections that all environments share: character, observation, terrain."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from trl_suite import characters, terrain
from trl_suite.actuation.action_map import ActionMap
from trl_suite.environments.environment import Environment
from trl_suite.registry.spec import EnvSpec
from trl_suite.util.tables import Section, Table, section

REWARD_WEIGHT = 'reward weight'  # title of a column of links


def character(environment: Environment, joints: tuple[str, Iterable[object]]) -> Iterator[Section]:
    """Yields sections on a task's character and its links; `joints` is a column of the table."""
    task: Any = environment.task
    figure, spec = task.character, task.character.spec
    yield section(f'Character: {spec.name}', spec.description, figures(figure))
    yield section('Links', links(figure, environment.physics, joints))


def figures(figure: characters.Character) -> str:
    """Returns mass, standing height and size of a character in one line."""
    spec = figure.spec
    own = characters.CHARACTERS.get(spec.name) is not spec
    found = characters.body_figures(characters.make(spec)) if own else _figures(spec.name)
    return (
        f'{found["mass"]:.4g} kg, root at a height of {found["standing_height"]:.3g} m when standing, '
        f'{len(spec.links)} links, {len(spec.joints)} joints'
    )


@functools.cache
def _figures(name: str) -> dict[str, Any]:
    return characters.body_figures(characters.make(name))


def links(figure: characters.Character, physics: Any, last: tuple[str, Iterable[object]]) -> Table:
    """Returns the table of a compiled character's links and joints.

    `last` is the title of the last column, and its entry for each joint.
    """
    spec = figure.spec
    moved = [figure.bodies[0], *(joint.parent for joint in figure.joints)]
    masses = [float(physics.bind(body).mass) for body in moved]
    own = spec.root_weight if last[0] == REWARD_WEIGHT else ''
    cells: list[tuple[object, ...]] = [('root', masses[0], '', '', '', '', own)]
    ranges, limits = figure.joint_ranges, figure.torque_limits
    kinds = zip(figure.prismatic, figure.spherical, last[1], strict=True)
    rows = zip(spec.joints.items(), masses[1:], ranges, limits, kinds, strict=True)
    for (name, joint), mass, (low, high), limit, (slides, ball, more) in rows:
        reach = 'free' if np.isinf(low) else f'{low:.3g} to {high:.3g}'
        if ball:
            reach = f'ball, up to {high:.3g}'
        units = ('m', 'N', 'N/m', 'N s/m') if slides else ('', '', '', '')
        values = (reach, f'{limit:g}', f'{joint.kp:g}', f'{joint.kd:g}')
        texts = (f'{value} {unit}'.rstrip() for value, unit in zip(values, units, strict=True))
        cells.append((name, mass, *texts, more))
    gains = 'kp (N m/rad)', 'kd (N m s/rad)'
    return Table(('link and joint', 'kg', 'range (rad)', 'limit (N m)', *gains, last[0]), cells)


def observation(environment: Environment) -> Section:
    """Returns the blocks of the observation."""
    task: Any = environment.task
    spatial = task.character.spec.spatial
    axes = '; x is mirrored while the trunk points backwards'
    if spatial:
        axes = "; axes: x along the root's heading, y to the left, z up"
    size, mirrored = sum(block.size for block in task.observed), getattr(task, 'mirrored', False)
    return section(
        f'Observation: {size} numbers, in this order{axes}',
        Table(
            ('block', 'from', 'to', 'size', 'unit', 'meaning'),
            [
                (block.name, part.start, part.stop, block.size, block.unit, block.meaning)
                for block in task.observed
                if block.size
                for part in (task.blocks[block.name],)
            ],
        ),
        *(['mirrored: in left stance, observations and actions are reflected'] if mirrored else []),
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


def reward(task: Any, *notes: str, title: str = 'Reward of a step') -> Section:
    """Returns the table of reward terms, and notes on them."""
    return section(
        f'{title}: sum of weight * exp(-scale * error), or without a scale of weight * share; at most 1; 0 '
        'after a fall',
        Table(
            ('term', 'weight', 'scale', 'unit', 'error, or share'),
            [
                (
                    term.name,
                    term.weight,
                    '' if term.scale is None else term.scale,
                    term.unit,
                    term.meaning,
                )
                for term in task.terms
                if term.weight
            ],
        ),
        *notes,
    )


def actions(
    action_map: ActionMap, titles: Sequence[str], *columns: Iterable[object], unit: str = ''
) -> Section:
    """Returns the table of what each action does; `titles` of its name, and of further columns."""
    offset = np.round(action_map.action_offset, 9) + 0.0
    cells = zip(action_map.names, offset, action_map.action_scale, *columns, strict=True)
    first, *others = titles
    return section(
        f'Action: {len(action_map)} numbers in [-1, 1]; {action_map.quantity}{unit} = action_offset + '
        'action_scale * action',
        Table((first, 'action_offset', 'action_scale', *others), list(cells), numbered=True),
    )
