"""What is said of every environment: character, observation, action, terrain, time."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from trl_suite import characters, terrain
from trl_suite.describe.layout import Section, Table, section
from trl_suite.environments.environment import Environment
from trl_suite.registry import catalogue
from trl_suite.tasks.components import rewards
from trl_suite.tasks.spatial_task import SpatialTask

Meanings = dict[str, tuple[str, str]]  # unit and meaning of observation blocks
REWARD_WEIGHT = 'reward weight'  # title of a column of links
# What terms of a reward compare with the clip, or the step.
_ERRORS = {
    'pose': 'angles of joints and root, mean weighted as in Links; rad^2',
    'velocity': 'their rates, mean weighted alike; rad^2/s^2',
    'com': f'velocity of the centre of mass; {rewards.COM_ERROR_FACTOR:g} of the m^2/s^2',
    'root': 'height of the root above the ground; m^2',
    'heading': '-',
}
_ABOUT = {'com': 'the centre of mass', 'root': 'the root'}


def character(environment: Environment) -> Iterator[Section]:
    """Yields the character of a task, and its links."""
    task: Any = environment.task
    figure, spec = task.character, task.character.spec
    # The last column: a weight in a reward that has none of a gait, or what a gait tracks.
    gait, above = getattr(task, 'gait', None), hasattr(task, 'controller')
    title, last = REWARD_WEIGHT, [joint.weight for joint in spec.joints.values()]
    if gait is not None:
        title = 'target is to'
        last = ['the world' if j in gait.hips else 'its parent' for j in spec.joints]
    elif above:
        title, last = '', [''] * len(last)
    yield section(f'Character: {spec.name}', spec.description, figures(figure))
    yield section('Links', links(figure, environment.physics, (title, last)))


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
    spatial = isinstance(environment.task, SpatialTask)
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


def tracking_terms(task: Any, steps: bool, **more: str) -> Table:
    """Returns the terms of a reward for tracking.

    Args:
      task: it has them.
      steps: whether footsteps are tracked, not a clip.
      more: meanings of terms that only this task has; terms without a meaning are left out.
    """
    average = 'sum' if steps else 'mean'
    errors = {
        **_ERRORS,
        'end_effector': f'joints of the end effectors, their way from {_ABOUT[task.ABOUT]} and their '
        f'height above the ground, {average} over them; m^2',
        **more,
    }
    return Table(
        ('term', 'weight', 'scale', 'error: squared difference of'),
        [
            (name, weight, '' if name == 'heading' else scale, errors[name])
            for name, (weight, scale) in task.TERMS.items()
            if name in errors
        ],
    )


def action(environment: Environment) -> Section:
    """Returns what the actions drive."""
    action_map = environment.action_map
    title, limits = _limits(environment)
    unit = '' if action_map.unit == '1' else f' in {action_map.unit}'
    columns = (np.round(action_map.action_offset, 9) + 0.0, action_map.action_scale, limits)
    return section(
        f'Action: {len(action_map)} numbers in [-1, 1]; {action_map.quantity}{unit} = action_offset + '
        'action_scale * action',
        Table(
            ('drives', 'action_offset', 'action_scale', title),
            list(zip(action_map.names, *map(floats, columns), strict=True)),
            numbered=True,
        ),
    )


def _limits(environment: Environment) -> tuple[str, Any]:
    """Returns what limits each action's effect, and how much."""
    task: Any = environment.task
    actuators = environment.physics.bind(task.root_entity.mjcf_model.find_all('actuator'))
    if environment.action_map.quantity == 'excitation':
        return 'peak force (N)', np.asarray(actuators.gainprm)[:, 2]
    ball, limits = task.character.spherical, task.character.torque_limits
    names = environment.action_map.names
    if not ball.any():
        return 'torque limit (N m)', limits
    if task.actuation_model == 'velocity':
        limits = np.where(ball, limits / np.sqrt(3), limits)
    # Every ball joint takes as many numbers.
    each = (len(names) - np.count_nonzero(~ball)) // np.count_nonzero(ball)
    norm = '' if task.actuation_model == 'velocity' else ', norm'
    return f'torque limit (N m{norm})', np.repeat(limits, np.where(ball, each, 1))


def ground(spec: catalogue.EnvSpec) -> Section:
    """Returns the terrain and its parameters."""
    found = terrain.load(spec.terrain)
    idle = terrain.IDLE.get(found.type, ())
    parameters = ', '.join(
        f'{name} {value:g}' for name, value in found.parameters().items() if name not in idle
    )
    sets = len(found.parameter_sets)
    more = f' (set 0 of {sets}; see the option terrain_level)' if sets > 1 else ''
    return section(
        f'Terrain: {found.name} ({found.type})', f'{parameters or "no parameters"}{more}'
    )


def time(spec: catalogue.EnvSpec, task: Any) -> Section:
    """Returns rates, and how long an episode is."""
    control, physics = 1 / task.control_timestep, 1 / task.physics_timestep
    return section(
        'Time',
        f'control {control:.4g} Hz, physics {physics:.4g} Hz; an episode is cut (discount 1) after '
        f'{spec.step_limit} steps, {spec.step_limit * task.control_timestep:.3g} s',
    )


def floats(values: Any) -> list[float]:
    """Returns plain numbers."""
    return [float(value) for value in values]
