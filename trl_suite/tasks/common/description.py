"""Sections of descriptions that several task types share."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from trl_suite.util.tables import Section, Table, section

if TYPE_CHECKING:
    from trl_suite.environments.environment import Environment
    from trl_suite.registry.spec import EnvSpec

REWARD_WEIGHT = 'reward weight'  # title of a column of links


def reward_weights(task: Any) -> tuple[str, Iterable[object]]:
    """Returns the title of a column in the table of links, and the reward weight of each joint."""
    return REWARD_WEIGHT, [joint.weight for joint in task.character.spec.joints.values()]


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


def action(environment: Environment) -> Section:
    """Returns the table of what each action controls."""
    action_map = environment.action_map
    title, limits = _limits(environment)
    unit = '' if action_map.unit == '1' else f' in {action_map.unit}'
    columns = (np.round(action_map.action_offset, 9) + 0.0, action_map.action_scale, limits)
    return section(
        f'Action: {len(action_map)} numbers in [-1, 1]; {action_map.quantity}{unit} = action_offset + '
        'action_scale * action',
        Table(
            ('controls', 'action_offset', 'action_scale', title),
            list(zip(action_map.names, *map(floats, columns), strict=True)),
            numbered=True,
        ),
    )


def _limits(environment: Environment) -> tuple[str, Any]:
    """Returns the title of a column of limits, and the limit of each action."""
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
    # All ball joints have the same number of actions.
    each = (len(names) - np.count_nonzero(~ball)) // np.count_nonzero(ball)
    norm = '' if task.actuation_model == 'velocity' else ', norm'
    return f'torque limit (N m{norm})', np.repeat(limits, np.where(ball, each, 1))


def time(spec: EnvSpec, task: Any) -> Section:
    """Returns control and physics rates, and the length of an episode."""
    control, physics = 1 / task.control_timestep, 1 / task.physics_timestep
    return section(
        'Time',
        f'control {control:.4g} Hz, physics {physics:.4g} Hz; an episode is truncated (discount 1) after '
        f'{spec.step_limit} steps, {spec.step_limit * task.control_timestep:.3g} s',
    )


def floats(values: Any) -> list[float]:
    """Returns values as Python floats."""
    return [float(value) for value in values]


def span(values: tuple[float, float]) -> str:
    """Returns a range of lengths in m."""
    low, high = values
    return f'{low:g} m' if low == high else f'{low:g} to {high:g} m'


def clip(task: Any) -> Section:
    """Returns the clip that is tracked."""
    clip = task.clip
    return section(
        f'Clip: {clip.name}',
        f'{clip.description}; period {clip.duration:.4g} s, {clip.speed:.3g} m/s',
    )


def fall(task: Any, missed: str = '') -> Section:
    """Returns the conditions of failure; `missed` is a further condition."""
    links = ', '.join(task.character.spec.fall_links)
    fell = f'a fall: one of {links} touches the ground at the end of a step; ' if links else ''
    either = 'or ' if fell or missed else ''
    return section('Termination (discount 0)', f'{fell}{missed}{either}the physics diverges')


def missed(task: Any) -> str:
    """Returns the condition on the landing error; empty if there is none."""
    if task.max_landing_error is None:
        return ''
    return f'a foot lands more than {task.max_landing_error:g} m from its landing place; '


def imitation(spec: EnvSpec, task: Any) -> Iterator[Section]:
    """Yields the sections on clip, reward and termination."""
    yield clip(task)
    yield reward(task)
    yield fall(task)
