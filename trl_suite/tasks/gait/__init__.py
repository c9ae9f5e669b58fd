"""The TerrainRL family: an agent sets the parameters of a gait state machine."""

from trl_suite.tasks.components import differences
from trl_suite.tasks.components.differences import Difference
from trl_suite.tasks.gait.description import GAIT
from trl_suite.tasks.gait.task import GaitConfig, GaitTask
from trl_suite.tasks.task_type import TaskType

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
                'MuJoCo at 1200 Hz, control at 600 Hz; the original controls most of these at 30 Hz, at '
                'which they fall here'
            ),
            Difference(
                'actions are in [-1, 1], clipped, and mapped to the parameters that are learnt; the original '
                'takes them for the first of all parameters, so that most mean another'
            ),
            Difference(
                'a step ends with its cycle or a fall, not up to 1/30 s later; the first action of an '
                'episode counts'
            ),
            Difference('the reward is of the cycle that the action made, and never NaN'),
            differences.FACES,
            Difference('episodes are cut after 5000 cycles (discount 1)'),
        ),
    ),
)
