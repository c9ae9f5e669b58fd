"""From a row of the catalogue to its task."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any

from trl_suite import characters, motion
from trl_suite import terrain as terrains
from trl_suite.arenas import PlanarArena, SpatialArena
from trl_suite.registry.catalogue import EnvSpec, find
from trl_suite.tasks import composed
from trl_suite.tasks.components.ball import Ball
from trl_suite.tasks.footsteps.planar import PlanarFootsteps
from trl_suite.tasks.footsteps.spatial import Footsteps
from trl_suite.tasks.gait import GaitTask
from trl_suite.tasks.imitation.planar import Imitation
from trl_suite.tasks.imitation.spatial import SpatialImitation
from trl_suite.tasks.navigation.direct import Journey, journey
from trl_suite.tasks.navigation.hierarchical import HighLevel
from trl_suite.tasks.task import Task
from trl_suite.tasks.walk import Walk
from trl_suite.util import errors

DIMENSIONS = {False: 'planar', True: 'three-dimensional'}


def _clip(spec: EnvSpec) -> motion.Clip:
    clip: Any = spec.clip
    if isinstance(clip, motion.Steps):
        raise ValueError(f'{clip.name!r} is a library of steps; to be imitated, give a clip')
    return clip if isinstance(clip, motion.Clip) else motion.load(clip or '')


def _imitation(spec: EnvSpec, options: dict[str, Any]) -> Task:
    return Imitation(
        characters.make(spec.character),
        PlanarArena(terrains.load(spec.terrain)),
        _clip(spec),
        actuation_model=spec.actuation,
        **options,
    )


def _gait(spec: EnvSpec, options: dict[str, Any]) -> Task:
    arena = PlanarArena(terrains.load(spec.terrain))
    return GaitTask(characters.make(spec.character), arena, **options)


def _spatial(spec: EnvSpec) -> SpatialArena:
    return SpatialArena(terrains.load(spec.terrain))


def _imitation3d(spec: EnvSpec, options: dict[str, Any]) -> Task:
    return SpatialImitation(
        characters.make(spec.character), _spatial(spec), _clip(spec), actuation_model=spec.actuation,
        **options,
    )  # fmt: skip


def _footsteps(spec: EnvSpec, options: dict[str, Any]) -> Task:
    steps: Any = spec.clip
    if isinstance(steps, motion.Clip):
        raise ValueError(f'{steps.name!r} is a clip; for footsteps, give a library of steps')
    if not isinstance(steps, motion.Steps):
        steps = motion.load_steps(steps or '')
    return Footsteps(
        characters.make(spec.character), _spatial(spec), steps, actuation_model=spec.actuation,
        **options,
    )  # fmt: skip


def _footsteps2d(spec: EnvSpec, options: dict[str, Any]) -> Task:
    return PlanarFootsteps(
        characters.make(spec.character), PlanarArena(terrains.load(spec.terrain)), _clip(spec),
        actuation_model=spec.actuation, **options,
    )  # fmt: skip


def _hike(spec: EnvSpec, options: dict[str, Any], with_ball: bool = False) -> Task:
    if spec.actuation != 'position':
        raise ValueError(
            f'{spec.task}: a footstep controller drives joints by position, not by {spec.actuation}'
        )
    controller = options.get('controller')
    if isinstance(controller, str) and not controller.endswith('.npz'):
        options['controller'] = find(controller).id  # of an alias, too
    steps = spec.clip if isinstance(spec.clip, motion.Steps) else motion.load_steps(spec.clip or '')
    arena = _spatial(spec)
    ball = Ball(arena) if with_ball else None
    return HighLevel(characters.make(spec.character), arena, steps, ball, **options)


def _soccer(spec: EnvSpec, options: dict[str, Any]) -> Task:
    return _hike(spec, options, with_ball=True)


def _journey(spec: EnvSpec, options: dict[str, Any]) -> Task:
    original = options.get('reward') == 'original'
    return journey(
        characters.make(spec.character), _spatial(spec), _clip(spec),
        motion.load_steps(character_of(spec.character).name) if original else None,
        actuation_model=spec.actuation, **options,
    )  # fmt: skip


def _ball_journey(spec: EnvSpec, options: dict[str, Any]) -> Task:
    arena = _spatial(spec)
    return Journey(
        characters.make(spec.character), arena, _clip(spec), Ball(arena),
        actuation_model=spec.actuation, **options,
    )  # fmt: skip


def _arena(spec: EnvSpec) -> PlanarArena | SpatialArena:
    if character_of(spec.character).spatial:
        return _spatial(spec)
    return PlanarArena(terrains.load(spec.terrain))


def _walk(spec: EnvSpec, options: dict[str, Any]) -> Task:
    return Walk(
        characters.make(spec.character), _arena(spec), actuation_model=spec.actuation, **options
    )


def _of_the_user(spec: EnvSpec, options: dict[str, Any]) -> Task:
    make: Any = spec.rules
    tracked = {} if spec.clip is None else {'clip': _clip(spec)}
    return make(
        characters.make(spec.character), _arena(spec), actuation_model=spec.actuation, **tracked,
        **options,
    )  # fmt: skip


# How a row's rules make a task, and what has the task's options as keyword arguments.
_RULES: dict[str, tuple[Callable[[EnvSpec, dict[str, Any]], Task], Callable[..., Task]]] = {
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


def character_of(character: str | characters.CharacterSpec) -> characters.CharacterSpec:
    """Returns a character by its name; one of the user's own is returned as it is."""
    return characters.CHARACTERS[character] if isinstance(character, str) else character


def _check_dimensions(spec: EnvSpec) -> None:
    """Checks that character and terrain have the same number of dimensions.

    Raises:
      ValueError: they have not; the message names presets that fit.
    """
    character, ground = character_of(spec.character), terrains.load(spec.terrain)
    if ground.spatial == character.spatial:
        return
    presets = terrains.PRESETS3D if character.spatial else terrains.PRESETS
    raise ValueError(
        f'character {character.name!r} is {DIMENSIONS[character.spatial]} and terrain {ground.name!r} '
        f'({ground.type}) {DIMENSIONS[ground.spatial]}; presets that fit: {", ".join(sorted(presets))}'
    )


def build_task(spec: EnvSpec, options: Mapping[str, Any] | None = None) -> Task:
    """Builds the task of a row, for a plain `composer.Environment` or a batch.

    Args:
      spec: a row of the catalogue.
      options: keyword arguments of the task class that override those of the row; besides those
        every task takes `rewards`, `observations` and `failures`, see `trl_suite.tasks.composed`.

    Raises:
      ValueError: an unknown option; the message has the closest matches. Or a terrain with other
        dimensions than the character.
    """
    make_task = _of_the_user if callable(spec.rules) else _RULES[spec.rules][0]
    merged = {**spec.options, **(options or {})}
    known = task_options(spec)
    parts = {name: merged.pop(name) for name in composed.OPTIONS if name in merged}
    for name in merged:
        if name not in known:
            choices = [*known, *composed.OPTIONS, 'random']
            raise ValueError(errors.unknown(f'option of {spec.id}', name, choices))
    if not callable(spec.rules):  # the user's own check theirs
        errors.check_kinds(_takes(spec), merged)
    _check_dimensions(spec)
    return composed.compose(make_task(spec, merged), parts)


def task_options(spec: EnvSpec) -> dict[str, Any]:
    """Returns the options of a row's task, besides those of every task, with their defaults."""
    return {
        name: spec.options.get(name, parameter.default)
        for name, parameter in inspect.signature(_takes(spec)).parameters.items()
        if parameter.kind is parameter.KEYWORD_ONLY and name != 'actuation_model'
    }


def _takes(spec: EnvSpec) -> Callable[..., Any]:
    """Returns what has the options of a row's task as keyword arguments."""
    return spec.rules if callable(spec.rules) else _RULES[spec.rules][1]
