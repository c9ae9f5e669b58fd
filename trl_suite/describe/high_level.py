"""Plans of footsteps above a footstep controller: hikes from goal to goal, and soccer."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from trl_suite.describe import spatial
from trl_suite.describe.common import Meanings, floats
from trl_suite.describe.gait import looks_until_fall, running_share
from trl_suite.describe.layout import Section, Table, section
from trl_suite.describe.spatial import after, before
from trl_suite.environments.environment import Environment
from trl_suite.registry import catalogue
from trl_suite.tasks.navigation import hierarchical as high_level

__all__ = ['action', 'after', 'before', 'blocks', 'rules', 'time']

_BLOCKS = {
    'surface': (
        'm/s',
        'velocities of the ground against that under the root, at 32 lines from the left to the right (5.5 m '
        'to each side), each of 32 from 1 m behind to 10 m ahead: all ahead, then all to the right',
    ),
    'ball': spatial.BALL_BLOCK,
    'low_level': ('', 'what the footstep controller observes'),
}
_MEANINGS = {
    'first_x': 'm; where the foot that swings lands, ahead of the root',
    'first_y': 'm; the same, to the left of the root',
    'second_x': 'm; where the other foot lands after it, ahead of the root',
    'second_y': 'm; the same, to the left of the root',
    'turn': 'rad; heading to have, to the left of the present one',
}


def blocks(task: Any) -> Meanings:
    """Returns units and meanings of the observation blocks."""
    return {**spatial.BLOCKS, **_BLOCKS, 'goal': spatial.TARGETS['ball' in task.blocks]}


def action(environment: Environment) -> Section:
    """Returns what the actions plan."""
    action_map = environment.action_map
    cells = [
        (name, action_offset, action_scale, _MEANINGS.get(name, 'of the footstep controller'))
        for name, action_offset, action_scale in zip(
            action_map.names,
            floats(action_map.action_offset),
            floats(action_map.action_scale),
            strict=True,
        )
    ]
    return section(
        f'Action: {len(action_map)} numbers in [-1, 1]; {action_map.quantity} = action_offset + action_scale * action',
        Table(('sets', 'action_offset', 'action_scale', 'unit and meaning'), cells, numbered=True),
    )


def rules(spec: catalogue.EnvSpec, task: Any) -> Iterator[Section]:
    """Yields controller, goal, reward and termination."""
    yield section(
        'Footstep controller',
        f'{task.controller.name}; the plan is laid out from the root and its heading when a footstep begins',
    )
    yield spatial.start(spec)
    if task.ball:
        yield spatial.goal_and_ball(task._goal_distance)
        formulas, full = spatial.ball_terms(task._target_speed, task._goal_reached)
    else:
        yield spatial.goal(spec, task, 'hike')
        formulas = [
            f'exp(-{high_level.SPEED_SHARPNESS:g} min(0, v - {task._target_speed:g})^2), v: speed of the '
            'centre of mass towards the goal, m/s',
            '1',
        ]
        full = f'speed is full where a step begins within {task._goal_reached:g} m of the goal'
    yield section(
        'Reward of a step: sum of weight * term, at most 1; 0 after a fall',
        Table(
            ('name', 'weight', 'term'),
            [
                (name, weight, formula)
                for (name, (weight, _)), formula in zip(task.TERMS.items(), formulas, strict=True)
            ],
        ),
        full,
    )
    every = high_level.SAMPLE_FRAMES / 30
    yield section(
        f'Termination (discount 0), looked at every {every:g} s',
        f'one of {", ".join(task.character.spec.fall_links)} touches the ground in '
        f'{looks_until_fall(high_level)} looks in a row, or so often that {running_share(high_level)}; '
        'or the physics diverges',
    )


def time(spec: catalogue.EnvSpec, task: Any) -> Section:
    """Returns rates, and how long a step and an episode are."""
    duration, physics = task.control_timestep, 1 / task.physics_timestep
    return section(
        'Time',
        f'a step is {duration:.3g} s, the first of an episode may be shorter; footstep controller 30 Hz, '
        f'physics\n{physics:.4g} Hz; an episode is cut (discount 1) after {spec.step_limit} steps, '
        f'{spec.step_limit * duration:.3g} s',
    )
