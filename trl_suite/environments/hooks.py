"""Composer's hooks: which of them the environments call, and which they refuse."""

from __future__ import annotations

from collections.abc import Callable

from dm_control import composer

from trl_suite.tasks.task import Task

CALLED = ('initialize_episode', 'before_step', 'after_step')
_SUBSTEPS = 'substeps run in one call to C; use a plain composer.Environment for this task'
_ONCE = 'the model is compiled once; change it before the environment is made'
_REFUSED = {
    'before_substep': _SUBSTEPS, 'after_substep': _SUBSTEPS, 'initialize_episode_mjcf': _ONCE,
}  # fmt: skip
_RESULTS = ('get_reward', 'get_discount', 'should_terminate_episode')


def of_entities(task: Task, name: str) -> list[Callable[..., None]]:
    """Returns the hooks of a name that entities override.

    dm_control compares bytecode, which differs from what it expects with `python -OO`.
    """
    empty = getattr(composer.Entity, name)
    hooks = (getattr(entity, name) for entity in task.root_entity.iter_entities())
    return [hook for hook in hooks if getattr(hook, '__func__', hook) is not empty]


def called(task: Task) -> list[str]:
    """Returns the names of hooks that an environment must call, since task or entities override them."""
    return [
        name
        for name in CALLED
        if getattr(type(task), name) is not getattr(Task, name) or of_entities(task, name)
    ]


def check(task: Task) -> None:
    """Checks that an environment would call what task and entities override.

    Raises:
      ValueError: it would not.
    """
    for name, why in _REFUSED.items():
        if getattr(type(task), name) is not getattr(composer.Task, name) or of_entities(task, name):
            raise ValueError(f'the task or an entity in it has a {name} hook: {why}')
    for name in _RESULTS:
        if getattr(type(task), name) is not getattr(Task, name):
            raise ValueError(
                f'the task overrides {name}, which is not called; expected a finish_step that writes '
                'reward and failure into `outcome`'
            )


def check_extra(name: str) -> None:
    """Checks that a hook of a user would be called.

    Raises:
      ValueError: it would not; the message has the hooks that are.
    """
    why = {**_REFUSED, 'after_compile': _ONCE}.get(name)
    if why is not None:
        raise ValueError(f'cannot add a {name} hook: {why}; hooks are {", ".join(CALLED)}')
