"""The task types by name."""

from trl_suite.tasks import footsteps, gait, imitation, navigation, walk
from trl_suite.tasks.task_type import TaskType

TASK_TYPES: dict[str, TaskType] = {
    type_.name: type_
    for room in (imitation, footsteps, navigation, gait, walk)
    for type_ in room.TYPES
}
TITLES: tuple[str, ...] = tuple(dict.fromkeys(type_.title for type_ in TASK_TYPES.values()))
