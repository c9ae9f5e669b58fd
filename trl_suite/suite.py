"""Makes environments: by id (`make`), by family and task (`load`), or by parts (`build`)."""

from __future__ import annotations

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
from trl_suite.environments import arguments
from trl_suite.environments.environment import Environment
from trl_suite.registry import catalogue
from trl_suite.registry.build import DIMENSIONS, build_task
from trl_suite.registry.catalogue import find
from trl_suite.registry.spec import EnvSpec
from trl_suite.registry.task_types import TASK_TYPES, TITLES
from trl_suite.tasks.task import Task
from trl_suite.tasks.task_type import TaskType
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
    environment_kwargs.setdefault('visualize_reward', visualize_reward)
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
        with the task's options as keyword arguments, and returns a `Task`.
      clip: the reference motion. For imitation: name of a clip, path of an .npz, or a `Clip`; for
        footsteps in three dimensions: name or path of a library of footsteps, or a
        `FootstepLibrary`. By default the character's own. The tasks 'gait' and 'walk' have no
        reference motion.

    Raises:
      ValueError: unknown names, or parts that are incompatible.
    """
    own: dict[str, Any] = {}
    if not isinstance(character, (str, characters.CharacterSpec)):
        raise TypeError(
            f'a character is a CharacterSpec or a name, one of {", ".join(characters.CHARACTERS)}; '
            f'not {character!r}'
        )
    if not isinstance(clip, (str, motion.Clip, motion.FootstepLibrary, type(None))):
        raise TypeError(f'clip is a name, a file, a Clip or FootstepLibrary, not {clip!r}')
    if not isinstance(character, str):
        own['character'], character = character, character.name
    elif character not in characters.CHARACTERS:
        raise ValueError(errors.unknown('character', character, characters.CHARACTERS))
    figure = own.get('character') or characters.CHARACTERS[character]
    if isinstance(task, str):
        title, type_ = task, _type(task, figure)
        actuation = _actuation(type_, actuation)
        if type_.motion is None and clip is not None:
            raise ValueError(f'the task {title!r} has no reference motion: it takes no clip')
        if clip is None and type_.motion is not None:
            clip = _own_motion(figure, type_.motion)
    elif isinstance(task, TaskType):
        title, type_, own['task_type'] = task.title, task, task
        _check_dimensions(task, figure)
        actuation = _actuation(type_, actuation)
        if clip is None and type_.motion is not None:
            clip = _own_motion(figure, type_.motion)
    elif callable(task):
        title, type_ = str(getattr(task, '__name__', 'task')), None
        own['task_type'], actuation = task, _actuation(None, actuation)
    else:
        raise TypeError(f'task is {task!r}; expected a title, a TaskType, or a class or function')
    if terrain is None:
        terrain = 'plane' if figure.spatial else 'flat'
    if isinstance(clip, str) and clip.endswith('.npz'):  # read once: the working folder may change
        steps = type_ is not None and type_.motion is motion.FootstepLibrary
        clip = motion.load_steps(clip) if steps else motion.load(clip)
    if clip is not None and not isinstance(clip, str):
        own['clip'], clip = clip, clip.name
    ground = terrain if isinstance(terrain, str) else 'terrain'
    spec = EnvSpec(
        id=f'{character}/{actuation}/{ground}/{title}',
        domain='custom',
        task=title,
        character=character,
        actuation=actuation,
        terrain=ground,
        task_type=title if type_ is None else type_.name,
        clip=clip,
        options={} if type_ is None else dict(type_.options),
        description='A user-defined combination.',
        own=own,
    )
    return spec.with_terrain(terrain)


def _type(title: str, character: characters.CharacterSpec) -> TaskType:
    """Returns the task type of a title for a character."""
    errors.check_known('task', TITLES, title)
    types = {type_.spatial: type_ for type_ in TASK_TYPES.values() if type_.title == title}
    type_ = types.get(character.spatial) or next(iter(types.values()))
    _check_dimensions(type_, character)
    return type_


def _check_dimensions(type_: TaskType, character: characters.CharacterSpec) -> None:
    """Checks that task type and character are both planar or both three-dimensional."""
    if character.spatial != type_.spatial:
        raise ValueError(
            f'character {character.name!r} is {DIMENSIONS[character.spatial]}; the task '
            f'{type_.title!r} is for {DIMENSIONS[type_.spatial]} characters'
        )


def _actuation(type_: TaskType | None, actuation: str | None) -> str:
    """Returns the checked actuation model; by default 'position', if the task type allows it."""
    known = actuation_models.ACTUATIONS
    if type_ is not None and type_.actuations is not None:
        known = type_.actuations
    if actuation is None:
        return 'position' if 'position' in known else known[0]
    if actuation not in known:
        owner = 'actuation' if type_ is None else f'actuation of the task {type_.title!r}'
        raise ValueError(errors.unknown(owner, actuation, known))
    return actuation


def _own_motion(character: characters.CharacterSpec, kind: type) -> str:
    """Returns the name of a character's default clip, or of its library of steps."""
    name = character.name
    if kind is motion.Clip:
        if character.clip is None:
            raise ValueError(
                f"character {name!r} has no clip of its own; pass clip=, or task='walk', which needs none"
            )
        return character.clip
    known = motion.steps_names()
    if name not in known:
        raise ValueError(
            f'character {name!r} has no library of steps of its own; pass clip=, one of '
            f'{", ".join(known)}'
        )
    return name


def build_environment(
    spec: EnvSpec,
    task_kwargs: Mapping[str, Any] | None,
    environment_kwargs: Mapping[str, Any] | None,
) -> Environment:
    """Builds an environment from its spec; see `load` for the other arguments."""
    task_kwargs = arguments.absolute(errors.options('task_kwargs', task_kwargs))
    environment_kwargs = errors.options('environment_kwargs', environment_kwargs)
    known = [*_ENVIRONMENT_OPTIONS, 'flat_observation', 'visualize_reward']
    errors.check_known('option of an environment', known, *environment_kwargs)
    options = {'step_limit': spec.step_limit, **environment_kwargs}
    for name in _ENVIRONMENT_OPTIONS:
        if name in task_kwargs:
            options[name] = task_kwargs[name]
    task = build_task(
        spec, {name: v for name, v in task_kwargs.items() if name not in _ENVIRONMENT_OPTIONS}
    )
    environment = Environment(task, **options)
    environment.recipe = (build_environment, (spec, task_kwargs, environment_kwargs))
    return environment
