"""An environment in words and tables, made from its row and from what it was built into.

from trl_suite import describe, suite

row = suite.find('PD_Dog2D_Gaps_Terrain-v0')
for title, text in describe.sections(row, suite.make(row.id)):  # as `trl-suite info` prints it
    print(title, text)

What is said of all environments is in `common`, of a family in `planar`, `gait`, `spatial` and
`high_level`; `differences` says where the original is otherwise, and `layout` writes text and
Markdown.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from trl_suite.describe import layout
from trl_suite.describe.differences import differences_of
from trl_suite.describe.layout import Section, Table, escape, markdown, markdown_table, table
from trl_suite.registry import catalogue

if TYPE_CHECKING:
    from trl_suite.environments.environment import Environment

__all__ = [
    'Section', 'Table', 'differences_of', 'escape', 'markdown', 'markdown_table', 'parts', 'sections',
    'table',
]  # fmt: skip


def sections(spec: catalogue.EnvSpec, environment: Environment) -> Iterator[tuple[str, str]]:
    """Yields titles and texts: character, observation, action, rules, time, differences."""
    for title, parts_ in parts(spec, environment):
        yield title, layout.text(parts_)
    yield (
        'Differs from the original (reasons in docs/differences.md)',
        '\n'.join(f'  - {text}' for text in differences_of(spec)),
    )


def parts(spec: catalogue.EnvSpec, environment: Environment) -> Iterator[Section]:
    """Yields sections of paragraphs and tables: all of `sections` but the differences.

    Args:
      spec: of the environment.
      environment: built from it, or from a row that differs by its terrain only.
    """
    # They import the engine, which the tables of the command line do without.
    from trl_suite.describe import common, gait, high_level, options, planar, spatial
    from trl_suite.registry.build import task_options
    from trl_suite.tasks.gait import GaitTask
    from trl_suite.tasks.imitation.planar import Imitation
    from trl_suite.tasks.navigation.hierarchical import HighLevel
    from trl_suite.tasks.spatial_task import SpatialTask

    families = (
        (GaitTask, gait), (HighLevel, high_level), (SpatialTask, spatial), (Imitation, planar),
    )  # fmt: skip
    task: Any = environment.task
    family: Any = next((family for kind, family in families if isinstance(task, kind)), None)
    if family is None:  # one of the user's
        yield common.observation(environment, planar.blocks(task))
        yield common.action(environment)
        yield common.time(spec, task)
        yield options.options(spec, task_options(spec))
        return
    yield from common.character(environment)
    yield from family.before(task)
    yield common.observation(environment, family.blocks(task))
    yield from family.after(task)
    yield family.action(environment)
    yield common.ground(spec)
    yield from family.rules(spec, task)
    yield family.time(spec, task)
    yield options.options(spec, task_options(spec))
