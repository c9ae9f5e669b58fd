"""Worlds that vary between episodes, and pushes: options, draws, and the component.

Each property is drawn at the beginning of an episode, uniformly between two bounds, and stays
constant until the next one; pushes are drawn one after the other.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from trl_suite.engine import World
from trl_suite.engine.pushes import DIRECTION, DURATION, FORCE, INTERVAL
from trl_suite.engine.pushes import draw as draw_push
from trl_suite.engine.variation import Properties, Variation
from trl_suite.tasks.component import PUSH, WORLD, Component, seeded, spawned
from trl_suite.tasks.rewards import Outcome
from trl_suite.tasks.task import Marker, Task
from trl_suite.util import errors
from trl_suite.util.compiled import compiled
from trl_suite.util.options import Config, Range, option

PUSH_COLOUR = (0.9, 0.2, 0.15, 1.0)
_METRES_PER_NEWTON = 0.004  # of the arrow that shows a push
# Friction, mass of links, and pushes of 'robot' are within the ranges with which policies for
# robots are trained: friction 0.5 to 1.25 and changes of velocity of up to 1 m/s every 15 s in
# legged_gym (`legged_robot_config.py`; Rudin et al. 2022, 'Learning to walk in minutes using
# massively parallel deep reinforcement learning'); friction 0.4 to 1 and factors of masses of
# links from 0.9 to 1.1 in MuJoCo Playground. The other numbers are chosen.
PRESETS: Mapping[str, Mapping[str, Any]] = {
    'mild': {
        'friction': (0.7, 0.95), 'mass': (0.97, 1.03), 'link_mass': (0.97, 1.03),
        'com_offset': (0.0, 0.01), 'damping': (0.9, 1.1), 'slope': (-0.01, 0.01),
        'push': {'speed': (0.0, 0.15), 'duration': (0.1, 0.2), 'interval': (4.0, 8.0)},
    },
    'robot': {
        'friction': (0.5, 1.2), 'mass': (0.95, 1.05), 'link_mass': (0.9, 1.1),
        'com_offset': (0.0, 0.03), 'damping': (0.8, 1.25), 'slope': (-0.03, 0.03),
        'push': {'speed': (0.0, 0.4), 'duration': (0.1, 0.2), 'interval': (3.0, 6.0)},
    },
    'harsh': {
        'friction': (0.3, 1.5), 'mass': (0.85, 1.15), 'link_mass': (0.8, 1.2), 'inertia': (0.8, 1.25),
        'com_offset': (0.0, 0.06), 'damping': (0.5, 2.0), 'gravity': (9.3, 10.3),
        'slope': (-0.1, 0.1),
        'push': {'speed': (0.3, 1.0), 'duration': (0.1, 0.3), 'interval': (2.0, 4.0)},
    },
}  # fmt: skip


@dataclasses.dataclass(frozen=True, kw_only=True)
class PushConfig(Config):
    """Options of pushes: horizontal forces on a link, at its centre of mass."""

    force: Range | None = option(None, 'force', unit='N', at_least=0, at_most=1e6)
    speed: Range | None = option(
        None,
        "impulse over the character's nominal mass, instead of a force: the change of velocity of a "
        'free body',
        unit='m/s', at_least=0, at_most=100,
    )  # fmt: skip
    duration: Range = option(Range(0.2, 0.2), 'duration', unit='s', at_least=0.001, at_most=1000)
    interval: Range = option(
        Range(2.0, 4.0),
        'time from the end of a push, or the start of the episode, to the next push',
        unit='s', at_least=0, at_most=1e6,
    )  # fmt: skip
    direction: Range = option(
        Range(-math.pi, math.pi),
        'direction, to the left of +x; planar characters are pushed along +x if its cosine is positive, '
        'otherwise along -x',
        unit='rad', at_least=-2 * math.pi, at_most=2 * math.pi,
    )  # fmt: skip
    body: str | None = option(None, 'link that is pushed; by default the root')

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.force is None) == (self.speed is None):
            given = 'neither' if self.force is None else 'both'
            raise ValueError(f'push has {given} force and speed; expected one of them')


@dataclasses.dataclass(frozen=True, kw_only=True)
class WorldConfig(Config):
    """Options of worlds; a property that is None is not varied."""

    presets = PRESETS

    preset: str | None = option(None, 'preset that the other options change', choices=PRESETS)
    friction: Range | None = option(
        None, 'coefficient of sliding friction of all contacts; 0.81 otherwise', at_least=0, at_most=10
    )  # fmt: skip
    mass: Range | None = option(
        None, 'factor of mass and inertia of all links', at_least=0.01, at_most=100
    )
    link_mass: Range | None = option(
        None,
        'factor of mass and inertia, drawn for each link; in addition to mass',
        at_least=0.01,
        at_most=100,
    )
    inertia: Range | None = option(
        None,
        'factor of the inertia of all links about their centres of mass; in addition to mass',
        at_least=0.01,
        at_most=100,
    )
    com_offset: Range | None = option(
        None,
        "displacement of the root link's centre of mass, in a random direction",
        unit='m',
        at_least=0,
        at_most=1,
    )
    damping: Range | None = option(
        None,
        'factor of the passive damping of joints; the joints of gaits have none',
        at_least=0,
        at_most=1000,
    )
    gravity: Range | None = option(
        None, 'magnitude of gravity; 9.8 otherwise', unit='m/s^2', at_least=0, at_most=100
    )
    slope: Range | None = option(
        None,
        'angle by which the whole ground is tilted: gravity is rotated, and positions, headings and heights '
        'are relative to the ground',
        unit='rad', at_least=-1.5, at_most=1.5,
    )  # fmt: skip
    slope_direction: Range | None = option(
        None,
        'direction of ascent of the slope, to the left of +x, in three dimensions; by default 0',
        unit='rad',
        at_least=-2 * math.pi,
        at_most=2 * math.pi,
    )
    contact_depth: Range | None = option(
        None,
        'depth over which contacts become stiff, starting from nothing; otherwise they are stiff from the '
        'first touch',
        unit='m', at_least=1e-4, at_most=0.1,
    )  # fmt: skip
    contact_time: Range | None = option(
        None,
        'time constant of contacts; 0.005 otherwise, and at least two physics steps',
        unit='s',
        at_least=1e-3,
        at_most=1,
    )
    push: PushConfig | None = option(
        None, 'forces on the character: a mapping of options of pushes'
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.slope_direction is not None and self.slope is None:
            raise ValueError('slope_direction has no effect without slope; give both')

    @property
    def varied(self) -> tuple[str, ...]:
        """Names of the properties that are varied."""
        return tuple(name for name in Properties._fields if getattr(self, name) is not None)


def draw(
    env_id: int,
    config: WorldConfig,
    random: np.random.Generator,
    spatial: bool,
    properties: Properties,
) -> None:
    """Draws the properties of one simulation.

    A number is drawn for every property, in a fixed order, whether it is varied or not, so that the
    draws of one do not depend on which others are varied.

    Args:
      env_id: index of the simulation.
      config: the options.
      random: the random numbers.
      spatial: whether the character is three-dimensional.
      properties: written in place.
    """
    for name in Properties._fields:
        array = getattr(properties, name)
        share: Any = random.random(array.shape[1:] or None)
        given = getattr(config, name)
        if name == 'com_offset':
            if given is not None:
                size = given.low + (given.high - given.low) * share[0]
                array[env_id] = size * direction(share[1], share[2], spatial)
        elif given is not None:
            array[env_id] = given.low + (given.high - given.low) * share


def direction(first: float, second: float, spatial: bool) -> np.ndarray:
    """Returns a unit vector, uniform on the sphere, or on the circle of x and z, from two draws."""
    angle = 2 * np.pi * first
    if not spatial:
        return np.array([np.cos(angle), 0.0, np.sin(angle)])
    z = 2 * second - 1
    radius = np.sqrt(max(1 - z * z, 0.0))
    return np.array([radius * np.cos(angle), radius * np.sin(angle), z])


class Worlds(Component):
    """Properties of the world that vary between episodes, and pushes.

    `info` has 'world', the drawn properties by name, and with pushes 'impulse', that of the last
    step, (n, 3) N s.

    Attributes:
      variation: the properties, after `bind`.
    """

    variation: Variation

    def __init__(self, config: WorldConfig) -> None:
        self._config, self._push = config, config.push

    def added_to(self, task: Task) -> None:
        _check(task, self._config)
        super().added_to(task)

    @property
    def made_of(self) -> dict[str, tuple[str, Any]]:
        return {'randomize': (str(self._config.changed), self._config)}

    def prepare(self, world: World) -> None:
        if self._push is not None:
            self._pushes = world.set_pushes()

    def bind(self, world: World, outcome: Outcome) -> Outcome:
        task: Any = self.task
        figure, spatial = task.figure, task.character.spec.spatial
        self._spatial = spatial
        constants = getattr(task.root_entity, 'set_inertia', None)
        dofs = figure.pose_dof[6 if spatial else 3 :]
        self.variation = Variation(world, self._config.varied, figure.links, dofs, constants)
        properties = self.variation.properties
        self.saved = (properties,)
        self.info_arrays = {
            'world': {name: getattr(properties, name) for name in self._config.varied}
        }
        if self._push is not None:
            pushes, push = self._pushes, self._push
            pushes.ranges[FORCE] = push.speed if push.force is None else push.force
            pushes.ranges[DURATION], pushes.ranges[INTERVAL] = push.duration, push.interval
            pushes.ranges[DIRECTION], pushes.planar[0] = push.direction, not spatial
            pushes.mass[0] = self.variation.mass if push.force is None else 0.0
            links = task.character.spec.links
            pushes.body[0] = figure.links[0 if push.body is None else links.index(push.body)]
            self.saved = properties, pushes.state
            self.info_arrays['impulse'] = pushes.state.impulse
            self._steps = np.zeros(world.n, int)
        return outcome

    def begin(self, env_ids: np.ndarray, seeds: Sequence[np.random.SeedSequence]) -> None:
        world = self.task.world
        for env_id, seed in zip(env_ids.tolist(), seeds, strict=True):
            draw(
                env_id, self._config, np.random.default_rng(spawned(seed, WORLD)), self._spatial,
                self.variation.properties,
            )  # fmt: skip
            self.variation.apply(env_id)
            if self._push is not None:
                state = self._pushes.state
                seeded(env_id, spawned(seed, PUSH), state.stream)
                state.impulse[env_id] = 0.0
                first_push(np.array([env_id]), world.pack)

    def before_physics(self, action: np.ndarray, env_ids: np.ndarray) -> None:
        if self._push is not None:
            self._pushes.state.impulse[env_ids] = 0.0
            self._steps[env_ids] = self.task.world.engine.steps[env_ids]

    def finish(self, env_ids: np.ndarray, fresh: bool) -> None:
        if self._push is None or fresh:
            return
        if (self.task.world.engine.steps[env_ids] == self._steps[env_ids]).any():
            raise RuntimeError(
                'a plain composer.Environment has no pushes: use '
                'trl_suite.environments.environment.Environment'
            )

    def restored(self, env_id: int) -> None:
        self.variation.apply(env_id)

    def markers(self, env_id: int) -> list[Marker]:
        """Returns an arrow for a push."""
        if self._push is None:
            return []
        world, pushes = self.task.world, self._pushes
        time = world.time[env_id]
        if not pushes.state.begin[env_id] <= time < pushes.state.end[env_id]:
            return []
        x, y, _ = pushes.state.force[env_id]
        length = max(_METRES_PER_NEWTON * float(np.hypot(x, y)), 0.1)
        yaw = float(np.arctan2(y, x))
        place = world.xipos[env_id, pushes.body[0]].copy()
        place[:2] -= (length + 0.15) * np.array([np.cos(yaw), np.sin(yaw)])
        return [Marker('arrow', place, (0.03, 0.03, length), PUSH_COLOUR, yaw)]


@compiled
def first_push(env_ids: np.ndarray, engine: Any) -> None:
    """Draws the first push of episodes, which begin at time 0; takes the pack of a world."""
    for i in env_ids:
        draw_push(i, 0.0, engine.pushes)


def _check(task: Task, world: WorldConfig) -> None:
    """Checks that a task can have these worlds.

    Raises:
      ValueError: it cannot.
    """
    if not hasattr(task, 'figure') or not hasattr(task, 'character'):
        raise ValueError(
            f'randomize: the task {type(task).__name__} has no attributes `character` and `figure`, as '
            'all tasks of the suite do'
        )
    spec = task.character.spec
    if world.slope_direction is not None and not spec.spatial:
        raise ValueError(
            'slope_direction is for three-dimensional characters; planar ones move along x, so that '
            'slope alone, positive or negative, is enough'
        )
    if world.push is not None and world.push.body not in (None, *spec.links):
        raise ValueError(errors.unknown('link in push: body', world.push.body, spec.links))
