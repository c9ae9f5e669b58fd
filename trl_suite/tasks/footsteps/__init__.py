"""Tasks that walk along planned footsteps."""

from trl_suite.motion import Clip, FootstepLibrary
from trl_suite.tasks import task_type as differences
from trl_suite.tasks.footsteps import description
from trl_suite.tasks.footsteps.task import (
    PlanarFootsteps,
    PlanarFootstepsConfig,
    SpatialFootsteps,
    SpatialFootstepsConfig,
)
from trl_suite.tasks.task_type import Difference, TaskType, tracking

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
            Difference('the reference of a step is half a cycle of the walk, for all step lengths'),
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
        motion=FootstepLibrary,
        differences=(
            differences.FROM_1200, differences.AXES, differences.ACTIONS, *differences.ROTATIONS,
            differences.CONES,
            Difference(
                'observations and actions are mirrored; in the original, this id runs the same environment as '
                'PD_Biped3D_LLC_General_Step-v0',
                lambda spec: spec.options.get('mirrored', False),
            ),
            differences.LANDING,
            Difference(
                'a goal is redrawn when the walker is within 1 m; the original draws one, at the start',
                lambda spec: spec.options.get('goal', False),
            ),
            differences.START_PHASE, differences.CUT,
        ),
    ),
)  # fmt: skip
