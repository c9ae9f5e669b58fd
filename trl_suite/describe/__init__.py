"""Describes an environment in text and tables, from its `EnvSpec` and the built environment.

    from trl_suite import describe, suite

    spec = suite.find('PD_Dog2D_Gaps_Terrain-v0')
    for title, text in describe.sections(spec, suite.make(spec.id)):  # as `trl-suite info` prints
        print(title, text)

Sections that all environments share are in `common`, those of a task type in `tasks` and `gait`;
`differences` lists the differences from the original.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from trl_suite.describe import common, options
from trl_suite.describe.differences import differences_of
from trl_suite.describe.tasks import description_of
from trl_suite.registry.build import task_type
from trl_suite.registry.spec import EnvSpec
from trl_suite.util import tables
from trl_suite.util.tables import Section

if TYPE_CHECKING:
    from trl_suite.environments.environment import Environment

__all__ = ['description_of', 'differences_of', 'parts', 'sections']


def sections(spec: EnvSpec, environment: Environment) -> Iterator[tuple[str, str]]:
    """Yields titles and texts: character, observation, action, rules, time, differences."""
    for title, parts_ in parts(spec, environment):
        yield title, tables.text(parts_)
    for title, parts_ in options.disturbances(spec.actuation, environment.task.observed):
        yield title, tables.text(parts_)
    yield (
        'Differences from the original (reasons in docs/differences.md)',
        '\n'.join(f'  - {text}' for text in differences_of(spec)),
    )


def parts(spec: EnvSpec, environment: Environment) -> Iterator[Section]:
    """Yields sections of paragraphs and tables: all of `sections` except the differences.

    The environment may be built from a spec that differs in its terrain.
    """
    about, task = description_of(spec), environment.task
    own = task_type(spec) is None  # whether the task is made by a user's class or function
    if not own:
        yield from common.character(environment, about.joints(task))
        yield from about.before(task)
    yield common.observation(environment)
    yield about.action(environment)
    if not own:
        yield common.ground(spec)
        yield from about.rules(spec, task)
    yield about.time(spec, task)
    yield options.options(spec)
