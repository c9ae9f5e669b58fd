"""From a row of the catalogue to its task."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any

from trl_suite import characters, motion
from trl_suite import terrain as terrains
from trl_suite.arenas import PlanarTerrain, SpatialTerrain
from trl_suite.registry.catalogue import Row, find
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


def _clip(row: Row) -> motion.Clip:
    clip: Any = row.clip
    if isinstance(clip, motion.Steps):
        raise ValueError(f'{clip.name!r} is a library of steps; to be imitated, give a clip')
    return clip if isinstance(clip, motion.Clip) else motion.load(clip or '')


def _imitation(row: Row, options: dict[str, Any]) -> Task:
    return Imitation(
        characters.make(row.character),
        PlanarTerrain(terrains.load(row.terrain)),
        _clip(row),
        actuation_model=row.actuation,
        **options,
    )


def _gait(row: Row, options: dict[str, Any]) -> Task:
    arena = PlanarTerrain(terrains.load(row.terrain))
    return GaitTask(characters.make(row.character), arena, **options)


def _spatial(row: Row) -> SpatialTerrain:
    return SpatialTerrain(terrains.load(row.terrain))


def _imitation3d(row: Row, options: dict[str, Any]) -> Task:
    return SpatialImitation(
        characters.make(row.character), _spatial(row), _clip(row), actuation_model=row.actuation,
        **options,
    )  # fmt: skip


def _footsteps(row: Row, options: dict[str, Any]) -> Task:
    steps: Any = row.clip
    if isinstance(steps, motion.Clip):
        raise ValueError(f'{steps.name!r} is a clip; for footsteps, give a library of steps')
    if not isinstance(steps, motion.Steps):
        steps = motion.load_steps(steps or '')
    return Footsteps(
        characters.make(row.character), _spatial(row), steps, actuation_model=row.actuation,
        **options,
    )  # fmt: skip


def _footsteps2d(row: Row, options: dict[str, Any]) -> Task:
    return PlanarFootsteps(
        characters.make(row.character), PlanarTerrain(terrains.load(row.terrain)), _clip(row),
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
    arena = _spatial(row)
    ball = Ball(arena) if with_ball else None
    return HighLevel(characters.make(row.character), arena, steps, ball, **options)


def _soccer(row: Row, options: dict[str, Any]) -> Task:
    return _hike(row, options, with_ball=True)


def _journey(row: Row, options: dict[str, Any]) -> Task:
    original = options.get('reward') == 'original'
    return journey(
        characters.make(row.character), _spatial(row), _clip(row),
        motion.load_steps(character_of(row.character).name) if original else None,
        actuation_model=row.actuation, **options,
    )  # fmt: skip


def _ball_journey(row: Row, options: dict[str, Any]) -> Task:
    arena = _spatial(row)
    return Journey(
        characters.make(row.character), arena, _clip(row), Ball(arena),
        actuation_model=row.actuation, **options,
    )  # fmt: skip


def _arena(row: Row) -> PlanarTerrain | SpatialTerrain:
    if character_of(row.character).spatial:
        return _spatial(row)
    return PlanarTerrain(terrains.load(row.terrain))


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


def character_of(character: str | characters.CharacterRow) -> characters.CharacterRow:
    """Returns a character by its name; one of the user's own is returned as it is."""
    return characters.CHARACTERS[character] if isinstance(character, str) else character


def _check_dimensions(row: Row) -> None:
    """Checks that character and terrain have the same number of dimensions.

    Raises:
      ValueError: they have not; the message names presets that fit.
    """
    character, ground = character_of(row.character), terrains.load(row.terrain)
    if ground.spatial == character.spatial:
        return
    presets = terrains.PRESETS3D if character.spatial else terrains.PRESETS
    raise ValueError(
        f'character {character.name!r} is {DIMENSIONS[character.spatial]} and terrain {ground.name!r} '
        f'({ground.type}) {DIMENSIONS[ground.spatial]}; presets that fit: {", ".join(sorted(presets))}'
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
