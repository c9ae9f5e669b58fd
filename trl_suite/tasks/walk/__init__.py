"""Walking without a reference motion: for characters without a clip, and for custom tasks."""

from trl_suite.tasks.task_type import Description, Parts, TaskType
from trl_suite.tasks.walk.task import WALK, PlanarWalkConfig, SpatialWalkConfig, Walk


def _make(parts: Parts, config: PlanarWalkConfig | SpatialWalkConfig) -> Walk:
    return Walk(parts.character, parts.arena, config, actuation_model=parts.actuation)


TYPES = (
    TaskType(
        name='planar_walk',
        title='walk',
        spatial=False,
        config=PlanarWalkConfig,
        make=_make,
        description=Description(),
        options=(('rewards', WALK),),
    ),
    TaskType(
        name='spatial_walk',
        title='walk',
        spatial=True,
        config=SpatialWalkConfig,
        make=_make,
        description=Description(),
        options=(('rewards', WALK),),
    ),
)
