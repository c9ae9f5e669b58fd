"""Tasks that track a motion clip."""

from trl_suite.motion import Clip
from trl_suite.tasks import task_type as differences
from trl_suite.tasks.common import description
from trl_suite.tasks.imitation.task import (
    PlanarImitation,
    PlanarImitationConfig,
    SpatialImitation,
    SpatialImitationConfig,
)
from trl_suite.tasks.task_type import Description, Difference, TaskType, tracking

TYPES = (
    TaskType(
        name='planar_imitation',
        title='imitation',
        spatial=False,
        config=PlanarImitationConfig,
        make=tracking(PlanarImitation),
        description=Description(rules=description.imitation),
        motion=Clip,
        differences=(
            Difference(
                'MuJoCo at 600 Hz instead of Bullet at 3000 Hz; see the option substeps',
                lambda spec: 'substeps' in spec.options,
            ),
            Difference(
                differences.FROM_3000.text, lambda spec: 'substeps' not in spec.options
            ),
            differences.ACTIONS, differences.OWN_CLIP, differences.START_PHASE, differences.FACES,
            differences.CUT,
        ),
    ),
    TaskType(
        name='spatial_imitation',
        title='imitation',
        spatial=True,
        config=SpatialImitationConfig,
        make=tracking(SpatialImitation),
        description=Description(rules=description.imitation),
        motion=Clip,
        differences=(
            differences.FROM_3000, differences.AXES, differences.ACTIONS, *differences.ROTATIONS,
            differences.CONES,
            Difference(
                'the goal is 3 m ahead on the line along +x through the start; the original observes bearing '
                'and distance of the start'
            ),
            differences.START_PHASE, differences.CUT,
        ),
    ),
)  # fmt: skip
