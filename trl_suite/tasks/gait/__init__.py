"""The TerrainRL family: actions set the parameters of a gait state machine."""

from trl_suite.tasks import task_type as differences
from trl_suite.tasks.gait.description import GAIT
from trl_suite.tasks.gait.task import GaitConfig, GaitTask
from trl_suite.tasks.task_type import Difference, TaskType

TYPES = (
    TaskType(
        name='gait',
        title='gait',
        spatial=False,
        config=GaitConfig,
        make=lambda parts, config: GaitTask(parts.character, parts.arena, config),
        description=GAIT,
        actuations=('gait',),
        score='distance',
        samples='cycles',
        differences=(
            Difference(
                'MuJoCo at 1200 Hz, control at 600 Hz; the original controls most of these characters at 30 '
                'Hz, at which they fall in this suite'
            ),
            Difference(
                'actions are in [-1, 1], clipped, and mapped to the learnt parameters; the original assigns '
                'them to the first entries of the vector of all parameters, so that most of them set a wrong '
                'parameter'
            ),
            Difference(
                'a step ends with its cycle or a fall, not up to 1/30 s later; the first action of an '
                'episode takes effect'
            ),
            Difference('the reward is that of the cycle that the action controlled, and never NaN'),
            differences.FACES,
            Difference('episodes are truncated after 5000 cycles (discount 1)'),
        ),
    ),
)
