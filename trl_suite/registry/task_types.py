"""The task types by name."""

from trl_suite.tasks.task_type import TYPES, TaskType

TASK_TYPES: dict[str, TaskType] = {type_.name: type_ for type_ in TYPES}
TITLES: tuple[str, ...] = tuple(dict.fromkeys(type_.title for type_ in TYPES))
