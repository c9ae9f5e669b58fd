"""Sections of descriptions that several task types for 3D walkers share."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from trl_suite import terrain
from trl_suite.tasks.common import ball, goals
from trl_suite.tasks.common.description import span
from trl_suite.terrain import SpatialGround
from trl_suite.terrain.spatial import ground
from trl_suite.terrain.spatial.layout import Layout
from trl_suite.util.tables import Section, section

if TYPE_CHECKING:
    from trl_suite.registry.spec import EnvSpec


def start(spec: EnvSpec) -> Section:
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


def goal(spec: EnvSpec, task: Any, rule: str) -> Section:
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


def goal_and_ball(away: tuple[float, float] | None = None) -> Section:
    """Returns where ball and goal are placed, and when; `away`: distances of goal from ball, m."""
    return section(
        'Goal and ball',
        f'a ball of radius {ball.RADIUS:g} m and {ball.MASS:g} kg is placed {span(ball.BALL_AWAY)} from the walker, '
        f'the goal {span(away or ball.GOAL_AWAY)} from the ball, in any direction; the ball is placed again '
        f'after {_seconds(ball.BALL_LASTS)}, the goal is redrawn after {_seconds(goals.GOAL_LASTS)}',
    )


def _layout(spec: EnvSpec) -> Layout:
    """Returns the layout of the ground of an environment's terrain."""
    return SpatialGround(terrain.load(spec.part('terrain')), 0).layout


def _seconds(span: tuple[float, float]) -> str:
    return f'{span[0]:g} to {span[1]:g} s'
