"""Imitation of a clip in the plane, and footsteps."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from trl_suite.describe.common import Meanings, action, time, tracking_terms
from trl_suite.describe.layout import Section, section
from trl_suite.describe.spatial import BLOCKS, REWARD, plan, span
from trl_suite.registry import catalogue
from trl_suite.tasks.footsteps.planar import PlanarFootsteps

__all__ = ['action', 'after', 'before', 'blocks', 'rules', 'time']

_BLOCKS = {
    'terrain': ('m', 'ground heights from 0.5 m behind to 3 m ahead, above the ground at the root'),
    'pose': ('m', 'root height above ground; then x, z of each link centre from the root'),
    'velocity': ('m/s', 'x, z velocity of each link centre'),
    'strain': ('1', 'strain of each muscle fibre'),
    'phase': ('1', 'phase of the clip in [0, 1); then the one-hot of its quarter'),
    'reference': (
        'm, m/s',
        "the clip's root height; its link centres from its root; their velocities",
    ),
    'contact': BLOCKS['contact'],
    'plan': BLOCKS['plan'],
}


def blocks(task: Any) -> Meanings:
    """Returns units and meanings of the observation blocks."""
    return _BLOCKS


def before(task: Any) -> Iterator[Section]:
    """Yields what comes before the observation."""
    yield from ()


def after(task: Any) -> Iterator[Section]:
    """Yields where parts of a plan are in the observation."""
    if isinstance(task, PlanarFootsteps):
        yield plan(task)


def rules(spec: catalogue.EnvSpec, task: Any) -> Iterator[Section]:
    """Yields clip, reward and termination."""
    clip = task.clip
    notes, missed = [], ''
    yield section(
        f'Clip: {clip.name}',
        f'{clip.description}; period {clip.duration:.4g} s, {clip.speed:.3g} m/s',
    )
    if isinstance(task, PlanarFootsteps):
        yield section(
            'Plans: at every switch of stance',
            f'steps {span(task.plans.length)} long, straight on; with probability {task.plans.change:g} '
            'another length is drawn; the right foot stands while the phase is below 0.5',
        )
        notes = [
            'end_effector: in the second half of a step, that of the swing foot is the way to its '
            'landing place',
            'heading: the whole weight while the trunk faces ahead, 0 while it faces backwards',
        ]
        if task.max_landing_error is not None:
            missed = f'a foot lands more than {task.miss:g} m from its place; '
    yield section(
        REWARD,
        tracking_terms(task, bool(notes)),
        *notes,
    )
    yield section(
        'Termination (discount 0)',
        f'a fall: one of {", ".join(task.character.spec.fall_links)} touches the ground at the end of a step; '
        f'{missed}or the physics diverges',
    )
