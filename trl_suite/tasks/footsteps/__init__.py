"""Tasks that walk along planned footsteps."""

from trl_suite.motion import Clip, Steps
from trl_suite.tasks.components import differences
from trl_suite.tasks.components.differences import Difference
from trl_suite.tasks.footsteps import description
from trl_suite.tasks.footsteps.planar import PlanarFootsteps, PlanarFootstepsConfig
from trl_suite.tasks.footsteps.spatial import SpatialFootsteps, SpatialFootstepsConfig
from trl_suite.tasks.task_type import TaskType, tracking

TYPES = (
    TaskType(
        name='planar_footsteps',
        title='footsteps',
        spatial=False,
        config=PlanarFootstepsConfig,
        make=tracking(PlanarFootsteps),
        description=description.PLANAR,
        motion=Clip,
        differences=(
            differences.FROM_3000, differences.ACTIONS, differences.LANDING,
            Difference('the reference is half a cycle of the walk for every step, however long'),
            differences.OWN_CLIP, differences.START_PHASE, differences.CUT,
        ),
    ),
    TaskType(
        name='spatial_footsteps',
        title='footsteps',
        spatial=True,
        config=SpatialFootstepsConfig,
        make=tracking(SpatialFootsteps),
        description=description.SPATIAL,
        motion=Steps,
        differences=(
            differences.FROM_1200, differences.AXES, differences.ACTIONS, *differences.ROTATIONS,
            differences.CONES,
            Difference(
                'truly mirrored; the original runs the same environment as for the general plan',
                lambda spec: spec.options.get('mirrored', False),
            ),
            differences.LANDING,
            Difference(
                'a goal is drawn anew when the walker is within 1 m; the original draws one, at the start',
                lambda spec: spec.options.get('goal', False),
            ),
            differences.START_PHASE, differences.CUT,
        ),
    ),
)  # fmt: skip
