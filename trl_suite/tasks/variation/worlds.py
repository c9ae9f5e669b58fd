"""Worlds that vary between episodes: options, draws, and the component.

Each property is drawn at the beginning of an episode, uniformly between two bounds, and stays
constant until the next one.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from trl_suite.engine import World
from trl_suite.engine.variation import Properties, Variation
from trl_suite.tasks.component import WORLD, Component, spawned
from trl_suite.tasks.rewards import Outcome
from trl_suite.tasks.task import Task
from trl_suite.tasks.variation.pushes import PushConfig
from trl_suite.util.options import Config, Range, option, within

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
class WorldConfig(Config):
    """Options of worlds; a property that is None is not varied."""

    presets = PRESETS

    preset: str | None = option(None, 'preset that the other options change', choices=PRESETS)
    friction: Range | None = option(
        None, 'coefficient of sliding friction of all contacts; 0.81 otherwise', **within(0, 10)
    )
    mass: Range | None = option(
        None, 'factor of mass and inertia of all links', **within(0.01, 100)
    )
    link_mass: Range | None = option(
        None,
        'factor of mass and inertia, drawn for each link; in addition to mass',
        **within(0.01, 100),
    )
    inertia: Range | None = option(
        None,
        'factor of the inertia of all links about their centres of mass; in addition to mass',
        **within(0.01, 100),
    )
    com_offset: Range | None = option(
        None,
        "displacement of the root link's centre of mass, in a random direction",
        **within(0, 1, 'm'),
    )
    damping: Range | None = option(
        None,
        'factor of the passive damping of joints; the joints of gaits have none',
        **within(0, 1000),
    )
    gravity: Range | None = option(
        None, 'magnitude of gravity; 9.8 otherwise', **within(0, 100, 'm/s^2')
    )
    slope: Range | None = option(
        None,
        'angle by which the whole ground is tilted: gravity is rotated, and positions, headings and heights '
        'are relative to the ground',
        **within(-1.5, 1.5, 'rad'),
    )
    slope_direction: Range | None = option(
        None,
        'direction of ascent of the slope, to the left of +x, in three dimensions; by default 0',
        **within(-2 * math.pi, 2 * math.pi, 'rad'),
    )
    contact_depth: Range | None = option(
        None,
        'depth over which contacts become stiff, starting from nothing; otherwise they are stiff from the '
        'first touch',
        **within(1e-4, 0.1, 'm'),
    )
    contact_time: Range | None = option(
        None,
        'time constant of contacts, at least two physics steps; 0.005 or two physics steps otherwise',
        **within(1e-3, 1, 's'),
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


def direction(first: float, second: float, spatial: bool) -> np.ndarray:
    """Returns a unit vector, uniform on the sphere, or on the circle of x and z, from two draws."""
    angle = 2 * np.pi * first
    if not spatial:
        return np.array([np.cos(angle), 0.0, np.sin(angle)])
    z = 2 * second - 1
    radius = np.sqrt(max(1 - z * z, 0.0))
    return np.array([radius * np.cos(angle), radius * np.sin(angle), z])


class Worlds(Component):
    """Properties of the world that vary between episodes.

    `info` has 'world', the drawn properties by name.

    Attributes:
      variation: the properties, after `bind`.
    """

    variation: Variation

    def __init__(self, config: WorldConfig) -> None:
        self._config = config

    def added_to(self, task: Task) -> None:
        if not hasattr(task, 'body') or not hasattr(task, 'character'):
            raise ValueError(
                f'randomize: the task {type(task).__name__} has no attributes `character` and `body`, '
                'as all tasks of the suite do'
            )
        self._spatial = task.character.spec.spatial
        if self._config.slope_direction is not None and not self._spatial:
            raise ValueError(
                'slope_direction is for three-dimensional characters; planar ones move along x, so '
                'that slope alone, positive or negative, is enough'
            )
        super().added_to(task)

    @property
    def made_of(self) -> dict[str, tuple[str, Any]]:
        return {'randomize': (str(self._config.changed), self._config)}

    def bind(self, world: World, outcome: Outcome) -> Outcome:
        task = self.task
        body, varied = task.body, self._config.varied
        constants = getattr(task.root_entity, 'set_inertia', None)
        dofs = body.pose_dof[6 if self._spatial else 3 :]
        self.variation = Variation(world, varied, body.links, dofs, body.geoms, constants)
        properties = self.variation.properties
        self.saved = (properties,)
        self.info_arrays = {'world': {name: getattr(properties, name) for name in varied}}
        return outcome

    def begin(self, env_id: int, seed: np.random.SeedSequence) -> None:
        """Draws the properties of one simulation.

        A number is drawn for every property, in a fixed order, whether it is varied or not, so that
        the draws of one do not depend on which others are varied.
        """
        random = np.random.default_rng(spawned(seed, WORLD))
        for name, array in self.variation.properties._asdict().items():
            share: Any = random.random(array.shape[1:] or None)
            given = getattr(self._config, name)
            if given is None:
                continue
            if name == 'com_offset':
                size = given.low + (given.high - given.low) * share[0]
                array[env_id] = size * direction(share[1], share[2], self._spatial)
            else:
                array[env_id] = given.low + (given.high - given.low) * share
        self.variation.apply(env_id)

    def restored(self, env_id: int) -> None:
        self.variation.apply(env_id)
