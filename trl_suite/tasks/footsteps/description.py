"""Descriptions of tasks that track planned footsteps, in text and tables."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from trl_suite.tasks.common import description
from trl_suite.tasks.common.description import span
from trl_suite.tasks.task_type import Description
from trl_suite.util.tables import Section, section

_PLANS = 'Plans: drawn at every switch of stance'
_SWING = (
    'end_effector: in the second half of a step, the error of the swing foot is its displacement from the '
    'landing place'
)
LEGEND = ' Orange and blue: planned landing places of the swing foot and of the stance foot.'


def planar_rules(spec: Any, task: Any) -> Iterator[Section]:
    """Yields the sections on clip, plans, reward and termination."""
    yield description.clip(task)
    yield section(
        _PLANS,
        f'steps {span(task.plans.length)} long, straight ahead; with probability {task.plans.change:g} '
        'the length is redrawn; right stance while the phase is below 0.5',
    )
    yield description.reward(task, _SWING)
    yield description.fall(task, description.missed(task))


def spatial_rules(spec: Any, task: Any) -> Iterator[Section]:
    """Yields the sections on steps, plans, reward and termination."""
    motion = task.motion
    yield section(
        f'Steps: {motion.name}',
        f'{motion.description}, also mirrored; the reference is the step nearest to the plan. '
        f'Period (two steps) {task.period:.4g} s; right stance while the phase is below 0.5',
    )
    yield section(_PLANS, '; '.join(_plans(task)))
    yield description.reward(task, _SWING)
    yield description.fall(task, description.missed(task))


def _plans(task: Any) -> list[str]:
    """Returns phrases on how plans are drawn."""
    plans = task.plans
    lines = [f'steps {span(plans.length)} long, feet {span(plans.width)} apart']
    if task.goal_given:
        lines.append('the heading is that of a goal, which is redrawn when it is reached')
    else:
        lines.append(
            f'the heading changes by N(0, {plans.turn:g}) rad from step to step'
            if plans.turn
            else 'straight ahead'
        )
        if plans.sharp:
            lines.append(
                f'with probability {plans.sharp:g} it changes uniformly in [-pi, pi) instead'
            )
    if plans.from_root:
        lines.append(
            f'with probability {plans.from_root:g} the plan is relative to position and heading of the root'
        )
    push = task.config.pushes
    if push is not None:
        (low, high), unit = (push.speed, 'm/s') if push.force is None else (push.force, 'N')
        body = push.body or 'torso'
        lines.append(f'the {body} is pushed repeatedly with {low:g} to {high:g} {unit}')
    return lines


PLANAR = Description(rules=planar_rules, legend=LEGEND)
SPATIAL = Description(rules=spatial_rules, legend=LEGEND)
