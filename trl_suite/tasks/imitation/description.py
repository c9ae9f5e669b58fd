"""Imitation in words and tables."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from trl_suite.tasks.components import description, spatial_description
from trl_suite.tasks.components.description import PLAN_BLOCKS, REWARD, Meanings, tracking_terms
from trl_suite.tasks.task_type import Description
from trl_suite.util.tables import Section, section

PLANAR_BLOCKS: Meanings = {
    'terrain': ('m', 'ground heights from 0.5 m behind to 3 m ahead, above the ground at the root'),
    'pose': ('m', 'root height above ground; then x, z of each link centre from the root'),
    'velocity': ('m/s', 'x, z velocity of each link centre'),
    'strain': ('1', 'strain of each muscle fibre'),
    'phase': ('1', 'phase of the clip in [0, 1); then the one-hot of its quarter'),
    'reference': (
        'm, m/s',
        "the clip's root height; its link centres from its root; their velocities",
    ),
    **PLAN_BLOCKS,
}


def rules(spec: Any, task: Any) -> Iterator[Section]:
    """Yields clip, reward and termination."""
    yield description.clip(task)
    yield section(REWARD, tracking_terms(task, False))
    yield description.fall(task)


PLANAR = Description(blocks=lambda task: PLANAR_BLOCKS, rules=rules)
SPATIAL = Description(
    blocks=spatial_description.blocks, rules=rules, after=spatial_description.after
)
