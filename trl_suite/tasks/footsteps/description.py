"""Walking along planned footsteps in words and tables."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from trl_suite.tasks.components import description, spatial_description
from trl_suite.tasks.components.description import REWARD, span, tracking_terms
from trl_suite.tasks.imitation.description import PLANAR_BLOCKS
from trl_suite.tasks.task_type import Description
from trl_suite.util.tables import Section, section

_PLANS = 'Plans: at every switch of stance'
_SWING = 'end_effector: in the second half of a step, that of the swing foot is the way to its landing place'
LEGEND = ' Orange and blue: where the foot that swings and the other one are to land.'


def after(task: Any) -> Iterator[Section]:
    """Yields where parts of a plan are in the observation."""
    yield description.plan(task)


def planar_rules(spec: Any, task: Any) -> Iterator[Section]:
    """Yields clip, plans, reward and termination."""
    yield description.clip(task)
    yield section(
        _PLANS,
        f'steps {span(task.plans.length)} long, straight on; with probability {task.plans.change:g} '
        'another length is drawn; the right foot stands while the phase is below 0.5',
    )
    yield section(
        REWARD,
        tracking_terms(task, True),
        _SWING,
        'heading: the whole weight while the trunk faces ahead, 0 while it faces backwards',
    )
    yield description.fall(task, description.missed(task))


def spatial_rules(spec: Any, task: Any) -> Iterator[Section]:
    """Yields steps, plans, reward and termination."""
    motion = task.motion
    yield section(
        f'Steps: {motion.name}',
        f'{motion.description}, and mirrored; the nearest to the plan is the reference of a step. '
        f'Period of two steps {task.period:.4g} s; the right foot stands while the phase is below 0.5',
    )
    yield section(_PLANS, '; '.join(_plans(task)))
    yield section(
        REWARD,
        tracking_terms(task, True),
        'heading: weight * ((1 + cos error) / 2)^4, error: angle between the heading and that planned',
        _SWING,
    )
    yield description.fall(task, description.missed(task))


def _plans(task: Any) -> list[str]:
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
    return lines


PLANAR = Description(
    blocks=lambda task: PLANAR_BLOCKS, rules=planar_rules, after=after, legend=LEGEND
)
SPATIAL = Description(
    blocks=spatial_description.blocks, rules=spatial_rules, after=spatial_description.after,
    legend=LEGEND,
)  # fmt: skip
