"""Clips and footsteps that are tracked in three dimensions, and journeys without hierarchy."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from trl_suite import terrain
from trl_suite.describe.common import Meanings, action, time, tracking_terms
from trl_suite.describe.layout import Section, Table, section
from trl_suite.registry import catalogue
from trl_suite.tasks.components import ball, goals
from trl_suite.tasks.navigation import direct as journey
from trl_suite.terrain import SpatialGround
from trl_suite.terrain.spatial import ground
from trl_suite.terrain.spatial.layout import Layout

__all__ = ['BLOCKS', 'action', 'after', 'before', 'blocks', 'rules', 'time']

REWARD = 'Reward: sum of weight * exp(-scale * error), at most 1; 0 after a fall'
BLOCKS = {
    'terrain': (
        'm',
        'ground heights above the ground at the root, 32 lines from the left to the right (5.5 m to each '
        'side), each of 32 from 1 m behind to 10 m ahead',
    ),
    'pose': (
        'm, 1',
        'root height above ground; then of each link its centre from the root and its orientation (wxyz)',
    ),
    'velocity': (
        'm/s, rad/s',
        'of each link the velocity of its centre, against the ground under the root, and its angular '
        'velocity',
    ),
    'phase': ('1', 'phase of the cycle in [0, 1); then the one-hot of its quarter'),
    'reference': (
        'm, m/s',
        "the clip's root height; its link centres from its root; their velocities",
    ),
    'goal': (
        'rad, m',
        'bearing (positive to the left) and distance of the point on the line of the start that is 3 m '
        'further on',
    ),
    'contact': ('1', 'whether the right and the left foot touch the ground'),
    'plan': ('m, rad', 'see below'),
}
# Of a task whose goal moves, or whose ball has one.
TARGETS = {
    False: ('rad, m', 'bearing (positive to the left) and distance of the goal'),
    True: ('rad, m', 'bearing and distance of the goal as seen from the ball'),
}
BALL_BLOCK = (
    'rad, m, m/s, rad/s',
    'bearing, distance and height of the ball; its velocity (3) and its angular velocity (3)',
)
_MIRRORED_BLOCKS = {
    'phase': ('1', 'phase of the step in [0, 1); then the one-hot of its half'),
    'contact': ('1', 'whether the stance and the swing foot touch the ground'),
}
# Size, unit and meaning of the parts of a plan.
_PLAN = (
    (3, 'm', 'first landing place from the right foot; 0 while that one stands'),
    (3, 'm', 'first landing place from the left foot; 0 while that one stands'),
    (3, 'm', 'second landing place from the right foot; 0 unless that one stands'),
    (3, 'm', 'second landing place from the left foot; 0 unless that one stands'),
    (1, 'rad', 'planned heading, to the left of the present one'),
)
_MIRRORED_PLAN = (
    (1, 'rad', 'planned heading, to the swing side of the present one'),
    (3, 'm', 'first landing place from the swing foot'),
    (3, 'm', 'second landing place from the stance foot'),
)


def blocks(task: Any) -> Meanings:
    """Returns units and meanings of the observation blocks."""
    found = {**BLOCKS, 'ball': BALL_BLOCK, **(_MIRRORED_BLOCKS if task.mirrored else {})}
    if isinstance(task, journey.Journey) or getattr(task, 'hidden_plan', False):
        found['goal'] = TARGETS['ball' in task.blocks]
    return found


def before(task: Any) -> Iterator[Section]:
    """Yields what comes before the observation."""
    yield from ()


def after(task: Any) -> Iterator[Section]:
    """Yields where links and parts of a plan are in the observation."""
    links = list(task.character.spec.links)
    pose, velocity = task.blocks['pose'].start + 1, task.blocks['velocity'].start
    if task.mirrored:
        # In right stance; in left stance links change places.
        yield section(
            'Mirrored: while the left foot stands, all is seen in a mirror, and actions are mirrored back',
            'then what is called right below is the left side',
        )
    yield section(
        'Links in the observation (centre 3 and orientation 4; velocity 3 and angular velocity 3)',
        Table(
            ('link', 'pose from', 'to', 'velocity from', 'to'),
            [
                (name, *(pose + 7 * i + k for k in (0, 7)), *(velocity + 6 * i + k for k in (0, 6)))
                for i, name in enumerate(links)
            ],
        ),
    )
    if 'plan' in task.blocks:
        yield plan(task, task.mirrored)


def plan(task: Any, mirrored: bool = False) -> Section:
    """Returns where the parts of a plan are in the observation."""
    parts = _MIRRORED_PLAN if mirrored else _PLAN
    starts = task.blocks['plan'].start + np.cumsum([0, *(size for size, _, _ in parts)])
    return section(
        'Plan in the observation (x, y, and z above the ground at the root)',
        Table(
            ('from', 'to', 'size', 'unit', 'meaning'),
            [
                (int(start), int(start) + size, size, unit, text)
                for start, (size, unit, text) in zip(starts[:-1], parts, strict=True)
            ],
        ),
        *([] if task.character.spec.spatial else ['in the plane y and the heading are 0']),
    )


def rules(spec: catalogue.EnvSpec, task: Any) -> Iterator[Section]:
    """Yields what is tracked, reward and termination."""
    motion = task.motion
    steps = hasattr(task, 'plans')
    if steps:
        yield section(
            f'Steps: {motion.name}',
            f'{motion.description}, and mirrored; the nearest to the plan is the reference of a step. '
            f'Period of two steps {task.period:.4g} s; the right foot stands while the phase is below 0.5',
        )
        yield _plans(task)
    else:
        yield section(
            f'Clip: {motion.name}',
            f'{motion.description}; period {motion.duration:.4g} s, {motion.speed:.3g} m/s',
        )
    if isinstance(task, journey.Journey):
        yield start(spec)
        yield goal_and_ball() if 'ball' in task.blocks else goal(spec, task, 'step')
    yield section(
        REWARD,
        *_reward(task, steps),
    )
    missed = ''
    if steps and task.max_landing_error is not None:
        missed = f'a foot lands more than {task.miss:g} m from its place; '
    yield section(
        'Termination (discount 0)',
        f'a fall: one of {", ".join(task.character.spec.fall_links)} touches the ground at the end of a step; '
        f'{missed}or the physics diverges',
    )


def _reward(task: Any, steps: bool) -> Iterator[Table | str]:
    of_ball = 'ball' in task.blocks
    where = 'ball' if of_ball else 'goal'
    away = f'distance to the {where} over {journey.NEAR:g} m'
    yield tracking_terms(task, steps, **({'proximity': away} if 'proximity' in task.TERMS else {}))
    if 'heading' in task.TERMS:
        aim = 'that planned' if steps else f'the way to the {where}'
        yield f'heading: weight * ((1 + cos error) / 2)^4, error: angle between the heading and {aim}'
    if 'proximity' in task.TERMS:
        yield (
            f"com: the clip's velocity is turned towards the {where}; nearer than {journey.NEAR:g} m com "
            'and heading are worth their whole weight'
        )
    if of_ball:
        formulas, full = ball_terms(ball.SPEED, task._goal_reached)
        weights = [task.TERMS[name][0] for name in task.TERMS if name in ball.SOCCER_TERMS]
        yield Table(
            ('term', 'weight', 'times'),
            list(zip(ball.SOCCER_TERMS, weights, formulas, strict=True)),
        )
        yield full
    if steps:
        yield (
            'end_effector: in the second half of a step, that of the swing foot is the way to its '
            'landing place'
        )


def _plans(task: Any) -> Section:
    """Returns how plans are drawn."""
    plans = task.plans
    lines = [f'steps {span(plans.length)} long, feet {span(plans.width)} apart']
    if task.goal_given:
        lines.append('heads for a goal, drawn anew when it is reached')
    else:
        lines.append(
            f'the heading changes by N(0, {plans.turn:g}) rad from step to step'
            if plans.turn
            else 'straight on'
        )
        if plans.sharp:
            lines.append(f'with probability {plans.sharp:g} by anything up to pi instead')
    if plans.from_root:
        lines.append(f'with probability {plans.from_root:g} planned anew from the root')
    if task.pushes:
        low, high = task.pushes.force
        lines.append(f'the torso is pushed now and then by {low:g} to {high:g} N')
    return section('Plans: at every switch of stance', '; '.join(lines))


def span(values: tuple[float, float]) -> str:
    """Returns a range of lengths in m."""
    low, high = values
    return f'{low:g} m' if low == high else f'{low:g} to {high:g} m'


def start(spec: catalogue.EnvSpec) -> Section:
    """Returns where an episode begins."""
    layout = _layout(spec)
    where = {
        'start': 'at the origin, heading along x',
        'clear': f'up to {layout.span:g} m from the origin along x and along y, where nothing stands or moves '
        f'within {ground.START_ROOM:g} m, with any heading',
        'trail': f'on the middle of the trail and along it, anywhere up to '
        f'{ground.TRAIL_SPAN - ground.TRAIL_PAD:g} m from the origin along x and along y',
    }
    return section('Start', where[layout.place])


def goal(spec: catalogue.EnvSpec, task: Any, rule: str) -> Section:
    """Returns where the goal is drawn, by a rule of `terrain.ground`, and when it changes."""
    layout = _layout(spec)
    segments = '1 to 10 segments'
    near = f'up to {ground.GOAL_SPREAD:g} m from the walker along x and along y'
    if rule == 'step':
        segments = 'one segment'
        near = f'1 to {ground.GOAL_SPREAD:g} m ahead of the walker along x, where y is 0'
    where = {
        'start': near,
        'clear': f'up to {layout.span:g} m from the origin along x and along y, where nothing stands or moves '
        f'within {layout.goal_room:g} m',
        'trail': f'{segments} of the trail (2 m each) beyond the nearest, up to {ground.TRAIL_OFFSET:g} of '
        'its width beside its middle',
    }[layout.place]
    away = getattr(task, '_goal_distance', None)
    if away is not None:
        where = f'{span(away)} from the walker, in any direction'
    return section(
        'Goal',
        f'drawn {where}; the next one when the walker is within {task._goal_reached:g} m of it, or after '
        f'{_seconds(goals.GOAL_LASTS)}',
    )


def goal_and_ball(away: tuple[float, float] | None = None) -> Section:
    """Returns where ball and goal (`away` from it, m) are, and when they change."""
    return section(
        'Goal and ball',
        f'a ball of radius {ball.RADIUS:g} m and {ball.MASS:g} kg is put {span(ball.BALL_AWAY)} from the walker, '
        f'the goal {span(away or ball.GOAL_AWAY)} from the ball, in any direction; the ball is put elsewhere '
        f'after {_seconds(ball.BALL_LASTS)}, the next goal is drawn after {_seconds(goals.GOAL_LASTS)}',
    )


def _layout(spec: catalogue.EnvSpec) -> Layout:
    """Returns how ground of an environment's terrain is laid out."""
    return SpatialGround(terrain.load(spec.terrain), 0).layout


def ball_terms(speed: float, reached: float) -> tuple[list[str], str]:
    """Returns formulas of the terms that are about a ball, and when they are full.

    Args:
      speed: of the walker and the ball that is full, m/s.
      reached: distance of the ball from the goal at which all are full, m.
    """
    speeds = f'exp(-{ball.SPEED_SHARPNESS:g} min(0, v - {speed:g})^2)'
    formulas = [
        f'{speeds}, v: speed of the centre of mass towards the ball, m/s',
        f'exp(-{ball.BALL_SHARPNESS:g} d^2), d: on the ground from where the centre of mass was when the '
        'step began to the ball, m',
        f'{speeds}, v: speed of the ball towards the goal; 0 unless positive',
        f"exp(-{ball.GOAL_SHARPNESS:g} d), d: from the ball's centre to the goal on the ground, m",
    ]
    return formulas, (
        f'all are full while the ball is within {reached:g} m of the goal and within {ball.NEAR:g} m of '
        'the walker'
    )


def _seconds(span: tuple[float, float]) -> str:
    return f'{span[0]:g} to {span[1]:g} s'
