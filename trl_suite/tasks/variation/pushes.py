"""Pushes, drawn one after the other: options, and the component."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from trl_suite.engine import World
from trl_suite.engine.pushes import DIRECTION, DURATION, FORCE, INTERVAL, draw
from trl_suite.tasks.component import PUSH, Component, spawned
from trl_suite.tasks.rewards import Outcome
from trl_suite.tasks.task import Marker, Task
from trl_suite.util import errors
from trl_suite.util.compiled import compiled
from trl_suite.util.options import Config, Range, option, within
from trl_suite.util.random import seed_stream

COLOUR = (0.9, 0.2, 0.15, 1.0)
_METRES_PER_NEWTON = 0.004  # of the arrow that shows a push


@dataclasses.dataclass(frozen=True, kw_only=True)
class PushConfig(Config):
    """Options of pushes: horizontal forces on a link, at its centre of mass."""

    force: Range | None = option(None, 'force', **within(0, 1e6, 'N'))
    speed: Range | None = option(
        None,
        "impulse over the character's nominal mass, instead of a force: the change of velocity of a free body",
        **within(0, 100, 'm/s'),
    )
    duration: Range = option(Range(0.2, 0.2), 'duration', **within(0.001, 1000, 's'))
    interval: Range = option(
        Range(2.0, 4.0),
        'time from the end of a push, or the start of the episode, to the next push',
        **within(0, 1e6, 's'),
    )
    direction: Range = option(
        Range(-math.pi, math.pi),
        'direction, to the left of +x; planar characters are pushed along +x if its cosine is positive, '
        'otherwise along -x',
        **within(-2 * math.pi, 2 * math.pi, 'rad'),
    )
    body: str | None = option(None, 'link that is pushed; by default the root')

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.force is None) == (self.speed is None):
            given = 'neither' if self.force is None else 'both'
            raise ValueError(f'push has {given} force and speed; expected one of them')


class Pushes(Component):
    """A series of pushes on one link.

    A task may have several; the first one keeps the random streams and the impulses of all. `info`
    has 'impulse', that of the last step, (n, 3) N s.
    """

    by_engine = 'pushes'

    def __init__(self, config: PushConfig) -> None:
        self._config = config

    def added_to(self, task: Task) -> None:
        known: Any = task
        links = known.character.spec.links
        if self._config.body not in (None, *links):
            raise ValueError(errors.unknown('link in push: body', self._config.body, links))
        super().added_to(task)

    def prepare(self, world: World) -> None:
        self._series = world.add_pushes()

    def bind(self, world: World, outcome: Outcome) -> Outcome:
        super().bind(world, outcome)
        task = self.task
        pushes: Any = world.engine.pushes
        links, spec = task.body.links, task.character.spec
        push, k = self._config, self._series
        pushes.ranges[k, FORCE] = push.speed if push.force is None else push.force
        pushes.ranges[k, DURATION], pushes.ranges[k, INTERVAL] = push.duration, push.interval
        pushes.ranges[k, DIRECTION], pushes.planar[k] = push.direction, not spec.spatial
        pushes.mass[k] = world.models[0].body_mass[links].sum() if push.force is None else 0.0
        pushes.body[k] = links[0 if push.body is None else spec.links.index(push.body)]
        self._pushes = pushes
        if not k:
            self.saved = (pushes.state,)
            self.info_arrays = {'impulse': pushes.state.impulse}
        return outcome

    def begin(self, env_id: int, seed: np.random.SeedSequence) -> None:
        state = self._pushes.state
        if not self._series:
            seed_stream(env_id, spawned(seed, PUSH), state.stream)
        state.impulse[env_id] = 0.0
        first_push(env_id, self._series, self.task.world.pack)

    def before_physics(self, action: np.ndarray, env_ids: np.ndarray) -> None:
        self._pushes.state.impulse[env_ids] = 0.0

    def markers(self, env_id: int) -> list[Marker]:
        """Returns an arrow for a push."""
        world, state, k = self.task.world, self._pushes.state, self._series
        if not state.begin[env_id, k] <= world.time[env_id] < state.end[env_id, k]:
            return []
        x, y, _ = state.force[env_id, k]
        length = max(_METRES_PER_NEWTON * float(np.hypot(x, y)), 0.1)
        yaw = float(np.arctan2(y, x))
        place = world.xipos[env_id, self._pushes.body[k]].copy()
        place[:2] -= (length + 0.15) * np.array([np.cos(yaw), np.sin(yaw)])
        return [Marker('arrow', place, (0.03, 0.03, length), COLOUR, yaw)]


@compiled
def first_push(i: int, series: int, engine: Any) -> None:
    """Draws the first push of an episode, which begins at time 0; takes the pack of a world."""
    draw(i, series, 0.0, engine.pushes)
