"""The front door: a row of the catalogue, a paper's id, or a free combination -> an environment."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

from trl_suite import actuation as actuation_models
from trl_suite import catalogue, characters, errors, motion, policies
from trl_suite import terrain as terrains
from trl_suite.arenas import PlanarTerrain, SpatialTerrain, stage
from trl_suite.catalogue import Row, find
from trl_suite.environment import Environment
from trl_suite.tasks import composed
from trl_suite.tasks.ball import Ball
from trl_suite.tasks.footsteps import Footsteps
from trl_suite.tasks.footsteps2d import PlanarFootsteps, check_feet
from trl_suite.tasks.gait import GaitTask
from trl_suite.tasks.high_level import HighLevel
from trl_suite.tasks.imitation import Imitation
from trl_suite.tasks.imitation3d import SpatialImitation
from trl_suite.tasks.journey import Journey, journey
from trl_suite.tasks.task import Task
from trl_suite.tasks.walk import WALK, Walk

ALL_IDS: tuple[str, ...] = tuple(catalogue.BY_ID)
ALL_TASKS: tuple[tuple[str, str], ...] = tuple(catalogue.BY_TASK)
BENCHMARKING: tuple[tuple[str, str], ...] = tuple(
    key for key, row in catalogue.BY_TASK.items() if 'original' in row.tags
)
TASKS_BY_DOMAIN: dict[str, tuple[str, ...]] = {
    domain: tuple(task for d, task in ALL_TASKS if d == domain)
    for domain in dict.fromkeys(d for d, _ in ALL_TASKS)
}
DEFAULT_CLIPS = {
    'biped2d': 'biped2d_walk', 'biped2d_full': 'biped2d_full_walk', 'dog': 'dog_bound',
    'goat': 'dog_bound', 'raptor': 'raptor_run_050', 'biped3d': 'biped3d_walk',
    'biped3d_mocap': 'biped3d_mocap_walk', 'biped3d_mocap_run': 'biped3d_mocap_run',
    'biped3d_full_mocap': 'biped3d_full_walk',
}  # fmt: skip
_ENVIRONMENT_OPTIONS = ('random', 'time_limit', 'step_limit')  # also taken from task_kwargs


def _clip(row: Row) -> motion.Clip:
    clip: Any = row.clip
    if isinstance(clip, motion.Steps):
        raise ValueError(f'{clip.name!r} is a library of steps; to be imitated, give a clip')
    return clip if isinstance(clip, motion.Clip) else motion.load(clip or '')


def _imitation(row: Row, options: dict[str, Any]) -> Task:
    return Imitation(
        characters.make(row.character),
        _arena(row),
        _clip(row),
        actuation_model=row.actuation,
        **options,
    )


def _gait(row: Row, options: dict[str, Any]) -> Task:
    return GaitTask(characters.make(row.character), _arena(row), **options)


def _imitation3d(row: Row, options: dict[str, Any]) -> Task:
    return SpatialImitation(
        characters.make(row.character), _arena(row), _clip(row), actuation_model=row.actuation,
        **options,
    )  # fmt: skip


def _footsteps(row: Row, options: dict[str, Any]) -> Task:
    steps: Any = row.clip
    if isinstance(steps, motion.Clip):
        raise ValueError(f'{steps.name!r} is a clip; for footsteps, give a library of steps')
    if not isinstance(steps, motion.Steps):
        steps = motion.load_steps(steps or '')
    return Footsteps(
        characters.make(row.character), _arena(row), steps, actuation_model=row.actuation,
        **options,
    )  # fmt: skip


def _footsteps2d(row: Row, options: dict[str, Any]) -> Task:
    return PlanarFootsteps(
        characters.make(row.character), _arena(row), _clip(row),
        actuation_model=row.actuation, **options,
    )  # fmt: skip


def _hike(row: Row, options: dict[str, Any], with_ball: bool = False) -> Task:
    if row.actuation != 'position':
        raise ValueError(
            f'{row.task}: a footstep controller drives joints by position, not by {row.actuation}'
        )
    controller = options.get('controller')
    if isinstance(controller, str) and not controller.endswith('.npz'):
        options['controller'] = find(controller).id  # of an alias, too
    steps = row.clip if isinstance(row.clip, motion.Steps) else motion.load_steps(row.clip or '')
    arena = _arena(row)
    ball = Ball(arena) if with_ball else None
    return HighLevel(characters.make(row.character), arena, steps, ball, **options)


def _soccer(row: Row, options: dict[str, Any]) -> Task:
    return _hike(row, options, with_ball=True)


def _journey(row: Row, options: dict[str, Any]) -> Task:
    original = options.get('reward') == 'original'
    return journey(
        characters.make(row.character), _arena(row), _clip(row),
        motion.load_steps(_character(row.character).name) if original else None,
        actuation_model=row.actuation, **options,
    )  # fmt: skip


def _ball_journey(row: Row, options: dict[str, Any]) -> Task:
    arena = _arena(row)
    return Journey(
        characters.make(row.character), arena, _clip(row), Ball(arena),
        actuation_model=row.actuation, **options,
    )  # fmt: skip


def _arena(row: Row) -> Any:
    """Returns the arena of a row: planar or spatial as its character is, in its family's colours."""
    arena = SpatialTerrain if _character(row.character).spatial else PlanarTerrain
    return arena(terrains.load(row.terrain), look=stage.LOOKS.get(row.domain, stage.OLIVE))


def _walk(row: Row, options: dict[str, Any]) -> Task:
    return Walk(
        characters.make(row.character), _arena(row), actuation_model=row.actuation, **options
    )


def _of_the_user(row: Row, options: dict[str, Any]) -> Task:
    make: Any = row.rules
    tracked = {} if row.clip is None else {'clip': _clip(row)}
    return make(
        characters.make(row.character), _arena(row), actuation_model=row.actuation, **tracked,
        **options,
    )  # fmt: skip


# How a row's rules make a task, and what has the task's options as keyword arguments.
_RULES: dict[str, tuple[Callable[[Row, dict[str, Any]], Task], Callable[..., Task]]] = {
    'imitation': (_imitation, Imitation),
    'gait': (_gait, GaitTask),
    'imitation3d': (_imitation3d, SpatialImitation),
    'footsteps': (_footsteps, Footsteps),
    'footsteps2d': (_footsteps2d, PlanarFootsteps),
    'hike': (_hike, HighLevel),
    'soccer': (_soccer, HighLevel),
    'journey': (_journey, journey),
    'ball_journey': (_ball_journey, Journey),
    'walk': (_walk, Walk),
}
# As `build` names rules.
TASKS = ('imitation', 'footsteps', 'hike', 'soccer', 'journey', 'gait', 'walk')
_SPATIAL = {  # what is for one kind of character only
    'hike': True, 'soccer': True, 'journey': True, 'gait': False,
}  # fmt: skip
_BY_DIMENSIONS = {  # rules of a task that planar and spatial characters have
    ('imitation', True): 'imitation3d', ('footsteps', False): 'footsteps2d',
}  # fmt: skip
_OF_STEPS = ('footsteps', 'hike', 'soccer')  # in space the motion is a library of steps
_DIMENSIONS = {False: 'planar', True: 'three-dimensional'}


def load(
    domain_name: str,
    task_name: str,
    task_kwargs: Mapping[str, Any] | None = None,
    environment_kwargs: Mapping[str, Any] | None = None,
) -> Environment:
    """Loads an environment by family and task, as `dm_control.suite.load` does.

    Args:
      domain_name: family, one of `TASKS_BY_DOMAIN`.
      task_name: one of `TASKS_BY_DOMAIN[domain_name]`.
      task_kwargs: `random` (seed), `time_limit` (s), `step_limit`, and the task's own options.
      environment_kwargs: options of `Environment`, e.g. `flat_observation`.

    Raises:
      ValueError: unknown names or options; the message has the closest matches.
    """
    if domain_name not in TASKS_BY_DOMAIN:
        raise ValueError(errors.unknown('domain', domain_name, TASKS_BY_DOMAIN))
    if task_name not in TASKS_BY_DOMAIN[domain_name]:
        raise ValueError(
            errors.unknown(
                f'task of domain {domain_name!r}', task_name, TASKS_BY_DOMAIN[domain_name]
            )
        )
    row = catalogue.BY_TASK[domain_name, task_name]
    return build_row(row, dict(task_kwargs or {}), dict(environment_kwargs or {}))


def make(
    id: str,
    task_kwargs: Mapping[str, Any] | None = None,
    environment_kwargs: Mapping[str, Any] | None = None,
) -> Environment:
    """Makes an environment by its id in the paper's manner or by an alias ('plaid/dog_gaps').

    Arguments and errors are those of `load`.
    """
    return build_row(find(id), dict(task_kwargs or {}), dict(environment_kwargs or {}))


def reference_policy(id: str) -> policies.Policy:
    """Returns the trained policy that the suite ships for an id or alias.

    Raises:
      ValueError: unknown id; the message has the closest matches.
      FileNotFoundError: none is shipped for it; the message has the closest that have one.
    """
    return policies.reference(find(id).id)


def build(
    character: str | characters.CharacterRow,
    actuation: str | None = None,
    terrain: Any = None,
    task: str | Callable[..., Task] = 'imitation',
    clip: str | motion.Clip | motion.Steps | None = None,
    task_kwargs: Mapping[str, Any] | None = None,
    environment_kwargs: Mapping[str, Any] | None = None,
) -> Environment:
    """Builds a combination that the catalogue does not name.

    Args:
      character, actuation, terrain, task, clip: as for `combine`.
      task_kwargs: as for `load`; the task's options, e.g. `terrain_samples=50`.
      environment_kwargs: as for `load`.

    Raises:
      ValueError: unknown names, options, or parts that do not fit each other.
    """
    row = combine(character, actuation, terrain, task, clip)
    return build_row(row, dict(task_kwargs or {}), dict(environment_kwargs or {}))


def combine(
    character: str | characters.CharacterRow,
    actuation: str | None = None,
    terrain: Any = None,
    task: str | Callable[..., Task] = 'imitation',
    clip: str | motion.Clip | motion.Steps | None = None,
) -> Row:
    """Returns the row of a combination: what `VectorEnvironment` and Gymnasium take.

    Args:
      character: name in `trl_suite.characters.CHARACTERS`, or a row of the user's own.
      actuation: one of `trl_suite.actuation.ACTUATIONS`, by default 'position'; a gait drives
        joints by itself and takes none.
      terrain: what `trl_suite.terrain.load` takes: a preset, a file, or a mapping; as many
        dimensions as the character has. By default level ground.
      task: the rules: 'imitation'; 'footsteps', for who has a right and a left foot; in three
        dimensions 'hike' or 'soccer' (above a footstep controller) or 'journey' (from goal to goal
        without one); 'gait' (in the plane), or 'walk', which needs neither clip nor controller. Or
        a class or function of the user's, called as task(character, arena, actuation_model=...),
        with clip=... if one is given, and with the task's options by keyword; it returns a `Task`.
      clip: what is tracked. To be imitated: name of a clip, path of an .npz, or a `Clip`; for
        footsteps in three dimensions the same of a library of steps, `Steps`. By default the
        character's own. A gait or a walk takes none.

    Raises:
      ValueError: unknown names, or parts that do not fit each other.
    """
    own = not isinstance(task, str)
    title = task if isinstance(task, str) else str(getattr(task, '__name__', 'task'))
    if own and not callable(task):
        raise TypeError(f'a task is a name, or a class or function that makes one, not {task!r}')
    if not own and title not in TASKS:
        raise ValueError(errors.unknown('task', title, TASKS))
    name = character if isinstance(character, str) else character.name
    if isinstance(character, str) and character not in characters.CHARACTERS:
        raise ValueError(errors.unknown('character', character, characters.CHARACTERS))
    spatial = _character(character).spatial
    if not own and spatial is not _SPATIAL.get(title, spatial):
        raise ValueError(
            f'character {name!r} is {_DIMENSIONS[spatial]}; the task {title!r} is for '
            f'{_DIMENSIONS[not spatial]} characters'
        )
    if task == 'footsteps' and not spatial:
        check_feet(_character(character))
    if task == 'gait':
        if actuation not in (None, 'gait') or clip is not None:
            raise ValueError(
                'a gait drives the joints by itself: it takes no actuation and no clip'
            )
        actuation = 'gait'
    else:
        actuation = 'position' if actuation is None else actuation
        if actuation not in actuation_models.ACTUATIONS:
            raise ValueError(errors.unknown('actuation', actuation, actuation_models.ACTUATIONS))
        if task == 'walk' and clip is not None:
            raise ValueError('a walk tracks nothing: it takes no clip')
        if clip is None and not own and task != 'walk':
            clip = _own_motion(name, title in _OF_STEPS and spatial)
    if terrain is None:
        terrain = 'plane' if spatial else 'flat'
    return Row(
        id=f'{name}/{actuation}/{terrain if isinstance(terrain, str) else "terrain"}/{title}',
        domain='custom',
        task=title,
        character=character,  # type: ignore[arg-type]
        actuation=actuation,
        terrain=terrain,
        rules=task if own else _BY_DIMENSIONS.get((title, spatial), title),  # type: ignore[arg-type]
        clip=clip,  # type: ignore[arg-type]
        options=MappingProxyType({'rewards': WALK} if task == 'walk' else {}),
        description='A combination of the user.',
    )


def _character(character: str | characters.CharacterRow) -> characters.CharacterRow:
    return characters.CHARACTERS[character] if isinstance(character, str) else character


def _own_motion(name: str, steps: bool) -> str:
    """Returns the name of a character's own clip, or of its library of steps."""
    if not steps:
        if name not in DEFAULT_CLIPS:
            raise ValueError(
                f"character {name!r} has no clip of its own; give clip=, or task='walk', which needs none"
            )
        return DEFAULT_CLIPS[name]
    known = motion.steps_names()
    if name not in known:
        raise ValueError(
            f'character {name!r} has no library of steps of its own; give clip=, one of '
            f'{", ".join(known)}'
        )
    return name


def _check_dimensions(row: Row) -> None:
    """Checks that character and terrain have the same number of dimensions.

    Raises:
      ValueError: they have not; the message names presets that fit.
    """
    character, ground = _character(row.character), terrains.load(row.terrain)
    if ground.spatial == character.spatial:
        return
    presets = terrains.PRESETS3D if character.spatial else terrains.PRESETS
    raise ValueError(
        f'character {character.name!r} is {_DIMENSIONS[character.spatial]} and terrain {ground.name!r} '
        f'({ground.type}) {_DIMENSIONS[ground.spatial]}; presets that fit: {", ".join(sorted(presets))}'
    )


def build_task(row: Row, options: Mapping[str, Any] | None = None) -> Task:
    """Builds the task of a row, for a plain `composer.Environment` or a batch.

    Args:
      row: a row of the catalogue.
      options: keyword arguments of the task class that override those of the row; besides those
        every task takes `rewards`, `observations` and `failures`, see `trl_suite.tasks.composed`.

    Raises:
      ValueError: an unknown option; the message has the closest matches. Or a terrain with other
        dimensions than the character.
    """
    make_task = _of_the_user if callable(row.rules) else _RULES[row.rules][0]
    merged = {**row.options, **(options or {})}
    known = task_options(row)
    parts = {name: merged.pop(name) for name in composed.OPTIONS if name in merged}
    for name in merged:
        if name not in known:
            choices = [*known, *composed.OPTIONS, 'random']
            raise ValueError(errors.unknown(f'option of {row.id}', name, choices))
    if not callable(row.rules):  # the user's own check theirs
        errors.check_kinds(_takes(row), merged)
    _check_dimensions(row)
    return composed.compose(make_task(row, merged), parts)


def task_options(row: Row) -> dict[str, Any]:
    """Returns the options of a row's task, besides those of every task, with their defaults."""
    return {
        name: row.options.get(name, parameter.default)
        for name, parameter in inspect.signature(_takes(row)).parameters.items()
        if parameter.kind is parameter.KEYWORD_ONLY and name != 'actuation_model'
    }


def _takes(row: Row) -> Callable[..., Any]:
    """Returns what has the options of a row's task as keyword arguments."""
    return row.rules if callable(row.rules) else _RULES[row.rules][1]


def build_row(
    row: Row, task_kwargs: dict[str, Any], environment_kwargs: dict[str, Any]
) -> Environment:
    """Builds the environment of a row; see `load` for the arguments."""
    known = [*_ENVIRONMENT_OPTIONS, 'flat_observation']
    for name in environment_kwargs:
        if name not in known:
            raise ValueError(errors.unknown('option of an environment', name, known))
    options = {'step_limit': row.step_limit, **environment_kwargs}
    for name in _ENVIRONMENT_OPTIONS:
        if name in task_kwargs:
            options[name] = task_kwargs[name]
    task = build_task(
        row, {name: v for name, v in task_kwargs.items() if name not in _ENVIRONMENT_OPTIONS}
    )
    environment = Environment(task, **options)
    environment._recipe = (build_row, (row, task_kwargs, environment_kwargs))
    return environment
