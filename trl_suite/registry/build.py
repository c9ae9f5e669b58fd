"""Builds the task of an `EnvSpec`."""

from __future__ import annotations

import dataclasses
import inspect
import math
from collections.abc import Mapping
from typing import Any

from trl_suite import characters, motion, policies
from trl_suite import terrain as terrains
from trl_suite.actuation import Actuators, realism
from trl_suite.arenas import PlanarArena, SpatialArena, scene
from trl_suite.registry.catalogue import ALIASES, BY_ID, SPECS, find
from trl_suite.registry.spec import EnvSpec
from trl_suite.tasks import variation
from trl_suite.tasks.task import Task
from trl_suite.tasks.task_type import TASK_TYPES, Parts, TaskType
from trl_suite.util import errors, notices
from trl_suite.util.options import Config, option

DIMENSIONS = {False: 'planar', True: 'three-dimensional'}


def task_type(spec: EnvSpec) -> TaskType | None:
    """Returns the task type of an environment; None if a custom function makes the task."""
    own = spec.own.get('task_type')
    if own is None:
        return TASK_TYPES[spec.task_type]
    return own if isinstance(own, TaskType) else None


def character_of(spec: EnvSpec) -> characters.CharacterSpec:
    """Returns the spec of an environment's character."""
    return characters.spec_of(spec.part('character'))


def config_of(spec: EnvSpec) -> type[Config] | None:
    """Returns the config class of an environment's task; None for a user's function without one."""
    type_ = task_type(spec)
    if type_ is not None:
        return type_.config
    config = getattr(spec.own['task_type'], 'CONFIG', None)
    return config[character_of(spec).spatial] if isinstance(config, Mapping) else config


def task_options(spec: EnvSpec) -> dict[str, tuple[Any, Mapping[str, Any]]]:
    """Returns default and metadata (see `option`) of the options of an environment's task, by name.

    Those that all tasks have are not among them.
    """
    config = config_of(spec)
    if config is None:
        known = {  # after character and arena
            name: (each.default, option(None, '').metadata)
            for name, each in [*inspect.signature(spec.own['task_type']).parameters.items()][2:]
            if each.kind in (each.POSITIONAL_OR_KEYWORD, each.KEYWORD_ONLY)
            and name not in ('actuation_model', 'clip')
        }
    else:
        known = {each.name: (each.default, each.metadata) for each in dataclasses.fields(config)}
    return {
        name: (spec.options.get(name, default), data) for name, (default, data) in known.items()
    }


def build_task(spec: EnvSpec, options: Mapping[str, Any] | None = None) -> Task:
    """Builds the task of an environment, for a single simulation or many.

    Args:
      spec: spec of the environment.
      options: options of the task, which override those of the spec, and of every task, see
        `trl_suite.tasks.variation.CommonOptions`.

    Raises:
      ValueError: an unknown option (the message has the closest matches), a value out of range, or
        parts that are incompatible.
    """
    notices.compiling.about(spec.id)
    given = {**spec.options, **(options or {})}
    names, shared = [each.name for each in dataclasses.fields(variation.CommonOptions)], {}
    for name in names:
        if name in given:
            shared[name] = given.pop(name)
    common = variation.CommonOptions.parse(spec.id, shared)
    realism.check(common.actuators, spec.actuation)
    type_, config_type = task_type(spec), config_of(spec)
    for name in ('step_limit', 'time_limit', 'random'):
        if name in given:
            raise ValueError(
                f'{name} is an option of the environment; expected options of the task'
            )
    others = (*names, 'step_limit', 'time_limit', 'random')
    if config_type is None:
        known, config = task_options(spec), None
        if not known.keys() >= given.keys():
            errors.check_known(f'option of {spec.id}', [*known, *others], *given)
    else:
        for each in dataclasses.fields(config_type):
            if each.metadata['policy']:
                given[each.name] = _policy(each.name, given.get(each.name, each.default), spec)
        config = config_type.parse(spec.id, given, others)
    if type_ is not None and spec.actuation not in (type_.actuations or (spec.actuation,)):
        raise ValueError(
            f'{spec.task}: expected the actuation model {" or ".join(type_.actuations or ())}, not '
            f'{spec.actuation}'
        )
    parts = _parts(spec, type_, common.actuators, config)
    if type_ is not None:
        task = type_.make(parts, config)
    else:
        own: dict[str, Any] = given if config is None else {'config': config}
        if spec.clip is not None:
            own['clip'] = parts.motion
        task = spec.own['task_type'](
            parts.character, parts.arena, actuation_model=parts.actuation, **own
        )
        if not isinstance(task, Task):
            raise TypeError(f'task returned {task!r}; expected a Task')
    for component in variation.components(common, parts.character):
        task.add(component)
    return task


def _policy(name: str, source: Any, spec: EnvSpec) -> Any:
    """Returns the policy shipped for an id or alias, or a list of them; other sources are unchanged.

    Raises:
      ValueError: an unknown id, or a footstep controller whose footsteps last longer or shorter than those
        of the environment; the message has the controllers that fit.
    """
    if isinstance(source, (list, tuple)):
        return [_policy(name, each, spec) for each in source]
    if not isinstance(source, str) or source.endswith('.npz'):
        return source
    clip = spec.part('clip')
    fitting = [each.id for each in SPECS if 'controller' in each.tags and each.clip == clip]
    if source not in BY_ID and source not in ALIASES:
        known = fitting or policies.available()
        raise ValueError(errors.unknown(name, source, (*known, 'FILE.npz')))
    own, type_ = find(source), task_type(spec)
    tracks = type_ is not None and type_.motion is motion.FootstepLibrary
    if tracks and 'controller' in own.tags and own.clip != clip:
        theirs, ours = (_motion(each, motion.FootstepLibrary).duration for each in (own, spec))
        if not math.isclose(theirs, ours):
            raise ValueError(
                f'{name} {own.id!r} has footsteps of {theirs:g} s; expected {ours:g} s, as {spec.id} has them: '
                f'{", ".join([*fitting, "FILE.npz"])}'
            )
    return policies.reference(own.id)


def _parts(spec: EnvSpec, type_: TaskType | None, actuators: Actuators, config: Any) -> Parts:
    """Makes the parts of the task."""
    character = character_of(spec)
    ground = terrains.load(spec.part('terrain')).with_faces(getattr(config, 'face_length', None))
    # A level that it does not have is refused here, not by the first reset.
    ground.parameters(getattr(config, 'terrain_level', 0.0))
    if ground.spatial != character.spatial:
        presets = terrains.PRESETS3D if character.spatial else terrains.PRESETS
        raise ValueError(
            f'character {character.name!r} is {DIMENSIONS[character.spatial]} and terrain '
            f'{ground.name!r} ({ground.type}) {DIMENSIONS[ground.spatial]}; presets that fit: '
            f'{", ".join(sorted(presets))}'
        )
    kind: Any = motion.Clip if type_ is None else type_.motion
    tracked = None if kind is None or spec.clip is None else _motion(spec, kind)
    make_arena = SpatialArena if character.spatial else PlanarArena
    arena = make_arena(ground, look=scene.LOOKS.get(spec.domain, scene.OLIVE))
    body = realism.body(actuators, character)
    return Parts(characters.make(body), arena, tracked, spec.actuation)


def _motion(spec: EnvSpec, kind: type) -> Any:
    """Returns the clip or the library of steps of an environment."""
    given, steps = spec.part('clip'), kind is motion.FootstepLibrary
    if isinstance(given, str):
        return motion.load_steps(given) if steps else motion.load(given)
    if not isinstance(given, kind):
        raise ValueError(
            f'{given.name!r} is a clip; for footsteps, give a library of steps'
            if steps
            else f'{given.name!r} is a library of steps; to be imitated, give a clip'
        )
    return given
