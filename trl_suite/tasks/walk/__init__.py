"""Walking forward, with nothing to track: for characters without a clip, and to compose tasks of."""

from trl_suite.tasks.components import spatial_description
from trl_suite.tasks.imitation.description import PLANAR_BLOCKS
from trl_suite.tasks.task_type import Description, Parts, TaskType
from trl_suite.tasks.walk.task import WALK, PlanarWalkConfig, SpatialWalkConfig, Walk

_HEADING = ('1', 'cosine and sine of the bearing of the heading to keep, that of the start')


def _make(parts: Parts, config: PlanarWalkConfig | SpatialWalkConfig) -> Walk:
    return Walk(parts.character, parts.arena, config, actuation_model=parts.actuation)


TYPES = (
    TaskType(
        name='planar_walk',
        title='walk',
        spatial=False,
        config=PlanarWalkConfig,
        make=_make,
        description=Description(blocks=lambda task: PLANAR_BLOCKS),
        options=(('rewards', WALK),),
    ),
    TaskType(
        name='spatial_walk',
        title='walk',
        spatial=True,
        config=SpatialWalkConfig,
        make=_make,
        description=Description(
            blocks=lambda task: {**spatial_description.BLOCKS, 'target_heading': _HEADING}
        ),
        options=(('rewards', WALK),),
    ),
)
