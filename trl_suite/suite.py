"""Makes environments: by id (`make`), by family and task (`load`), or by parts (`build`)."""

from __future__ import annotations

import os

try:
    import dm_control
except ModuleNotFoundError as error:
    from trl_suite.util.libraries import DM_CONTROL, missing

    raise ModuleNotFoundError(missing('dm_control', DM_CONTROL), name=error.name) from error
try:
    import dm_control._render  # noqa: F401  loads the OpenGL library that MUJOCO_GL names
except (AttributeError, ImportError) as error:
    from trl_suite.rendering import no_gl

    raise RuntimeError(no_gl(error)) from error

from collections.abc import Callable, Mapping
from typing import Any

from trl_suite import actuation as actuation_models
from trl_suite import characters, motion, policies
from trl_suite.environments.environment import Environment
from trl_suite.registry import catalogue
from trl_suite.registry.build import DIMENSIONS, build_task
from trl_suite.registry.catalogue import find
from trl_suite.registry.spec import EnvSpec
from trl_suite.tasks.task import Task
from trl_suite.tasks.task_type import TASK_TYPES, TITLES, TaskType
from trl_suite.util import errors

ALL_IDS: tuple[str, ...] = tuple(catalogue.BY_ID)
ALL_TASKS: tuple[tuple[str, str], ...] = tuple(catalogue.BY_TASK)
BENCHMARKING: tuple[tuple[str, str], ...] = tuple(
    key for key, spec in catalogue.BY_TASK.items() if 'original' in spec.tags
)
TASKS_BY_DOMAIN: dict[str, tuple[str, ...]] = {
    domain: tuple(task for d, task in ALL_TASKS if d == domain)
    for domain in dict.fromkeys(d for d, _ in ALL_TASKS)
}
_ENVIRONMENT_OPTIONS = ('random', 'time_limit', 'step_limit')  # also taken from task_kwargs


def load(
    domain_name: str,
    task_name: str,
    task_kwargs: Mapping[str, Any] | None = None,
    environment_kwargs: Mapping[str, Any] | None = None,
    visualize_reward: bool = False,
) -> Environment:
    """Loads an environment by family and task, as `dm_control.suite.load` does.

    Args:
      domain_name: family, one of `TASKS_BY_DOMAIN`.
      task_name: one of `TASKS_BY_DOMAIN[domain_name]`.
      task_kwargs: `random` (seed), `time_limit` (s), `step_limit`, and the task's own options.
      environment_kwargs: options of `Environment`, e.g. `flat_observation`.
      visualize_reward: whether images show the reward, see `Environment`.

    Raises:
      ValueError: unknown names or options; the message has the closest matches.
    """
    errors.check_known('domain', TASKS_BY_DOMAIN, domain_name)
    errors.check_known(f'task of domain {domain_name!r}', TASKS_BY_DOMAIN[domain_name], task_name)
    environment_kwargs = errors.options('environment_kwargs', environment_kwargs)
    if visualize_reward:
        environment_kwargs['visualize_reward'] = True
    spec = catalogue.BY_TASK[domain_name, task_name]
    return build_environment(spec, task_kwargs, environment_kwargs)


def make(
    id: str,
    task_kwargs: Mapping[str, Any] | None = None,
    environment_kwargs: Mapping[str, Any] | None = None,
) -> Environment:
    """Makes an environment by its id, named as in the papers, or by an alias ('plaid/dog_gaps').

    Arguments and errors are those of `load`.
    """
    return build_environment(find(id), task_kwargs, environment_kwargs)


def reference_policy(id: str, variant: str = '') -> policies.Policy:
    """Returns the trained policy that the suite ships for an id or alias.

    Args:
      id: id or alias of the environment.
      variant: 'randomized' for the policy that was trained in worlds and with sensors that vary,
        'generalist' for a policy for all terrains of a character in PLAiD;
        `policies.available(variant)` lists the environments that have one.

    Raises:
      ValueError: unknown id or variant; the message has the closest matches.
      FileNotFoundError: no policy is shipped for it; the message has the closest ids with a policy.
    """
    return policies.reference(find(id).id, variant)


def build(
    character: str | characters.CharacterSpec,
    actuation: str | None = None,
    terrain: Any = None,
    task: str | TaskType | Callable[..., Task] = 'imitation',
    clip: str | motion.Clip | motion.FootstepLibrary | None = None,
    task_kwargs: Mapping[str, Any] | None = None,
    environment_kwargs: Mapping[str, Any] | None = None,
) -> Environment:
    """Builds an environment from parts, for combinations that have no id.

    Args:
      character, actuation, terrain, task, clip: as for `combine`.
      task_kwargs: as for `load`; the task's options, e.g. `terrain_observation=50`.
      environment_kwargs: as for `load`.

    Raises:
      ValueError: unknown names or options, or parts that are incompatible.
      TypeError: a character, clip or task of another type.
    """
    spec = combine(character, actuation, terrain, task, clip)
    return build_environment(spec, task_kwargs, environment_kwargs)


def combine(
    character: str | characters.CharacterSpec,
    actuation: str | None = None,
    terrain: Any = None,
    task: str | TaskType | Callable[..., Task] = 'imitation',
    clip: str | motion.Clip | motion.FootstepLibrary | None = None,
) -> EnvSpec:
    """Returns the `EnvSpec` of a combination, which `VectorEnvironment` and Gymnasium accept.

    Args:
      character: name in `trl_suite.characters.CHARACTERS`, or a custom `CharacterSpec`.
      actuation: one of `trl_suite.actuation.ACTUATIONS`, by default 'position'. Not for the task
        'gait', whose controller computes the torques.
      terrain: what `trl_suite.terrain.load` takes: a preset, a file, or a mapping; planar for a
        planar character, otherwise three-dimensional. By default level ground.
      task: title of a task type: 'imitation'; 'footsteps', for characters with a right and a left
        foot; in three dimensions 'goal_navigation' or 'soccer' (with a footstep controller), or
        'direct_navigation' or 'direct_soccer' (without one); 'gait' (in the plane), or 'walk', which
        needs neither clip nor controller. Or a custom `TaskType`; or a class or function that is
        called as task(character, arena, actuation_model=...), with clip=... if one is given, and
        with the task's options that it names as keyword arguments, and returns a `Task`.
      clip: the reference motion. For imitation: name of a clip, path of an .npz, or a `Clip`; for
        footsteps in three dimensions: name or path of a library of footsteps, or a
        `FootstepLibrary`. By default the character's own. The tasks 'gait' and 'walk' have no
        reference motion.

    Raises:
      ValueError: unknown names, or parts that are incompatible.
      TypeError: a character, clip or task of another type.
    """
    figure = characters.spec_of(character)
    own: dict[str, Any] = {} if isinstance(character, str) else {'character': character}
    if isinstance(clip, os.PathLike):
        clip = os.fspath(clip)
    if not isinstance(clip, (str, motion.Clip, motion.FootstepLibrary, type(None))):
        raise TypeError(f'clip is a name, a file, a Clip or FootstepLibrary, not {clip!r}')
    type_ = _type(task, figure)
    if not isinstance(task, str):
        own['task_type'] = task
    title = str(getattr(task, '__name__', 'task')) if type_ is None else type_.title
    actuation = _actuation(type_, actuation)
    kind = motion.Clip if type_ is None else type_.motion
    if kind is None and clip is not None:
        raise ValueError(f'the task {title!r} has no reference motion: it takes no clip')
    if clip is None and type_ is not None and kind is not None:
        clip = _own_motion(figure, kind)
    if terrain is None:
        terrain = 'plane' if figure.spatial else 'flat'
    # Read once: the working folder may change.
    if isinstance(clip, str) and clip.lower().endswith('.npz'):
        clip = (motion.load_steps if kind is motion.FootstepLibrary else motion.load)(clip)
    if clip is not None and not isinstance(clip, str):
        own['clip'], clip = clip, clip.name
    ground = terrain if isinstance(terrain, str) else 'terrain'
    spec = EnvSpec(
        id=f'{figure.name}/{actuation}/{ground}/{title}',
        domain='custom',
        task=title,
        character=figure.name,
        actuation=actuation,
        terrain=ground,
        task_type=title if type_ is None else type_.name,
        clip=clip,
        options={} if type_ is None else dict(type_.options),
        description='A user-defined combination.',
        own=own,
    )
    return spec.with_terrain(terrain)


def _type(task: Any, character: characters.CharacterSpec) -> TaskType | None:
    """Returns the task type of a title, or a custom one; None for a function that makes a task."""
    if isinstance(task, str):
        errors.check_known('task', TITLES, task)
        types = {type_.spatial: type_ for type_ in TASK_TYPES.values() if type_.title == task}
        task = types.get(character.spatial) or next(iter(types.values()))
    if not isinstance(task, TaskType):
        if not callable(task):
            raise TypeError(
                f'task is {task!r}; expected a title, a TaskType, or a class or function'
            )
        return None
    if character.spatial != task.spatial:
        raise ValueError(
            f'character {character.name!r} is {DIMENSIONS[character.spatial]}; the task '
            f'{task.title!r} is for {DIMENSIONS[task.spatial]} characters'
        )
    return task


def _actuation(type_: TaskType | None, actuation: str | None) -> str:
    """Returns the checked actuation model; by default 'position', if the task type allows it."""
    own = None if type_ is None else type_.actuations
    known = own or actuation_models.ACTUATIONS
    if actuation is None:
        return 'position' if 'position' in known else known[0]
    owner = 'actuation' if type_ is None else f'actuation of the task {type_.title!r}'
    errors.check_known(owner, known, actuation)
    return actuation


def _own_motion(character: characters.CharacterSpec, kind: type) -> str:
    """Returns the name of a character's default clip, or of its library of steps."""
    name, steps = character.name, motion.steps_names()
    if kind is motion.Clip and character.clip is not None:
        return character.clip
    if kind is motion.Clip:
        raise ValueError(
            f"character {name!r} has no clip of its own; pass clip=, or task='walk', which needs none"
        )
    if name not in steps:
        raise ValueError(
            f'character {name!r} has no library of steps of its own; pass clip=, one of '
            f'{", ".join(steps)}'
        )
    return name


def build_environment(
    spec: EnvSpec,
    task_kwargs: Mapping[str, Any] | None,
    environment_kwargs: Mapping[str, Any] | None,
) -> Environment:
    """Builds an environment from its spec; see `load` for the other arguments."""
    task_kwargs = errors.options('task_kwargs', task_kwargs)
    environment_kwargs = errors.options('environment_kwargs', environment_kwargs)
    known = [*_ENVIRONMENT_OPTIONS, 'flat_observation', 'visualize_reward']
    errors.check_known('option of an environment', known, *environment_kwargs)
    options = {'step_limit': spec.step_limit, **environment_kwargs}
    of_task = task_kwargs.copy()
    for name in _ENVIRONMENT_OPTIONS:
        if name in of_task:
            if name in environment_kwargs:
                raise ValueError(
                    f'{name} is in task_kwargs and in environment_kwargs; expected it once'
                )
            options[name] = of_task.pop(name)
    environment = Environment(build_task(spec, of_task), **options)
    environment.recipe = (build_environment, (spec, task_kwargs, environment_kwargs))
    return environment
