"""Descriptions of navigation tasks, direct and hierarchical, in text and tables."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from trl_suite import terrain
from trl_suite.tasks.common import description, goals
from trl_suite.tasks.common.description import floats, span
from trl_suite.tasks.footsteps.description import LEGEND, spatial_rules
from trl_suite.tasks.navigation import direct, hierarchical_rules
from trl_suite.tasks.rewards import fall_condition
from trl_suite.tasks.task_type import Description
from trl_suite.terrain import SpatialGround
from trl_suite.terrain.spatial import ground
from trl_suite.terrain.spatial.layout import Layout
from trl_suite.util.tables import Section, Table, section

if TYPE_CHECKING:
    from trl_suite.environments.environment import Environment
    from trl_suite.registry.spec import EnvSpec

_BEADS = ' Yellow spheres: past positions of the centre of mass; red: the goal.'
_MEANINGS = {
    'first_x': 'm; landing place of the swing foot, ahead of the root',
    'first_y': 'm; landing place of the swing foot, to the left of the root',
    'second_x': 'm; next landing place of the stance foot, ahead of the root',
    'second_y': 'm; next landing place of the stance foot, to the left of the root',
    'turn': 'rad; planned heading relative to the current one, positive to the left',
}


def action(environment: Environment) -> Section:
    """Returns the table of what each action plans."""
    action_map = environment.action_map
    cells = [
        (
            name,
            action_offset,
            action_scale,
            _MEANINGS.get(name, 'action of the footstep controller'),
        )
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


def about_plans(spec: EnvSpec, task: Any) -> Iterator[Section]:
    """Yields the sections on controller, start, goal, reward and termination."""
    yield section(
        'Footstep controller',
        f'{task.controller.name}; plans are relative to position and heading of the root at the beginning of '
        'a footstep',
    )
    yield _start(spec)
    if task.ball:
        yield _goal_and_ball(task.config.goal_distance)
        full = _full_with_ball(task)
    else:
        yield _goal(spec, task, 'far')
        full = f'the term speed is at its maximum if the step begins within {task.goal_reached:g} m of the goal'
    yield description.reward(task, f'target speed: {task.config.target_speed:g} m/s', full)
    every = hierarchical_rules.SAMPLE_FRAMES / 30
    yield section(
        f'Termination (discount 0), sampled every {every:g} s',
        f'one of {", ".join(task.character.spec.fall_links)} {fall_condition()}; or the physics diverges',
    )


def time(spec: EnvSpec, task: Any) -> Section:
    """Returns rates, and the duration of a step and an episode."""
    duration, physics = task.control_timestep, 1 / task.physics_timestep
    return section(
        'Time',
        f'a step is {duration:.3g} s (the first of an episode may be shorter); footstep controller 30 Hz, '
        f'physics\n{physics:.4g} Hz; an episode is truncated (discount 1) after {spec.step_limit} steps, '
        f'{spec.step_limit * duration:.3g} s',
    )


def about_joints(spec: EnvSpec, task: Any) -> Iterator[Section]:
    """Yields the sections on clip, start, goal, reward and termination."""
    if not isinstance(task, direct.DirectNavigation):  # reward 'original', for a hidden plan
        yield from spatial_rules(spec, task)
        return
    of_ball = 'ball' in task.blocks
    yield description.clip(task)
    yield _start(spec)
    if of_ball:
        yield _goal_and_ball()
    else:
        yield _goal(spec, task, 'near')
    where = 'ball' if of_ball else 'goal'
    notes = [
        f"com: the clip's velocity is rotated towards the {where}; within {direct.NEAR:g} m of it, com and "
        'heading are equal to their weights'
    ]
    if of_ball:
        notes += [f'target speed: {goals.SPEED:g} m/s', _full_with_ball(task)]
    yield description.reward(task, *notes)
    yield description.fall(task)


def _full_with_ball(task: Any) -> str:
    """Returns when all terms for a ball reach their maximum."""
    return (
        f'all terms for the ball are at their maximum while it is within {task.goal_reached:g} m of the goal '
        f'and within {goals.NEAR_BALL:g} m of the walker'
    )


def _start(spec: EnvSpec) -> Section:
    """Returns the initial position in an episode."""
    layout = _layout(spec)
    where = {
        'start': 'at the origin, heading along x',
        'clear': f'up to {layout.span:g} m from the origin along x and along y, with no obstacle or belt within '
        f'{ground.START_ROOM:g} m, with any heading',
        'trail': f'on the middle of the trail, heading along it, up to '
        f'{ground.TRAIL_SPAN - ground.TRAIL_PAD:g} m from the origin along x and along y',
    }
    return section('Start', where[layout.place])


def _goal(spec: EnvSpec, task: Any, rule: str) -> Section:
    """Returns where a goal is drawn, by a rule of `terrain.spatial.ground`, and when it changes."""
    layout = _layout(spec)
    segments = '1 to 10 segments'
    near = f'up to {ground.GOAL_SPREAD:g} m from the walker along x and along y'
    if rule == 'near':
        segments = 'one segment'
        near = f'1 to {ground.GOAL_SPREAD:g} m ahead of the walker along x, where y is 0'
    where = {
        'start': near,
        'clear': f'up to {layout.span:g} m from the origin along x and along y, with no obstacle or belt within '
        f'{layout.goal_room:g} m',
        'trail': f'{segments} of the trail (2 m each) beyond the nearest, up to {ground.TRAIL_OFFSET:g} of '
        'its width from its middle',
    }[layout.place]
    away = getattr(task.config, 'goal_distance', None)
    if away is not None:
        where = f'{span(away)} from the walker, in any direction'
    return section(
        'Goal',
        f'drawn {where}; redrawn when the walker is within {task.goal_reached:g} m of it, or after '
        f'{_seconds(goals.GOAL_LASTS)}',
    )


def _goal_and_ball(away: tuple[float, float] | None = None) -> Section:
    """Returns where ball and goal are placed, and when; `away`: distances of goal from ball, m."""
    return section(
        'Goal and ball',
        f'a ball of radius {goals.BALL_RADIUS:g} m and {goals.BALL_MASS:g} kg is placed {span(goals.BALL_AWAY)} from the walker, '
        f'the goal {span(away or goals.GOAL_AWAY)} from the ball, in any direction; the ball is placed again '
        f'after {_seconds(goals.BALL_LASTS)}, the goal is redrawn after {_seconds(goals.GOAL_LASTS)}',
    )


def _layout(spec: EnvSpec) -> Layout:
    """Returns the layout of the ground of an environment's terrain."""
    return SpatialGround(terrain.load(spec.part('terrain')), 0).layout


def _seconds(span: tuple[float, float]) -> str:
    return f'{span[0]:g} to {span[1]:g} s'


DIRECT = Description(
    rules=about_joints,
    legend=_BEADS,
)
HIERARCHICAL = Description(
    rules=about_plans,
    action=action,
    time=time,
    joints=lambda task: ('', [''] * len(task.character.spec.joints)),
    legend=LEGEND + _BEADS,
)
