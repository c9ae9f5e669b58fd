"""Descriptions of imitation tasks in text and tables."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from trl_suite.tasks.common import description
from trl_suite.tasks.task_type import Description
from trl_suite.util.tables import Section


def rules(spec: Any, task: Any) -> Iterator[Section]:
    """Yields the sections on clip, reward and termination."""
    yield description.clip(task)
    yield description.reward(task)
    yield description.fall(task)


IMITATION = Description(rules=rules)
