"""Another task in worlds that vary, with pushes, and with sensors that are not exact."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from dm_control import mjcf

from trl_suite.engine import World
from trl_suite.engine.pushes import DIRECTION, DURATION, FORCE, INTERVAL
from trl_suite.engine.pushes import draw as draw_push
from trl_suite.engine.variation import Variation
from trl_suite.tasks.disturbances import sensors, worlds
from trl_suite.tasks.disturbances.sensors import AGAIN, FRESH, NEXT, SensorConfig, sense_all
from trl_suite.tasks.disturbances.worlds import PushConfig, WorldConfig
from trl_suite.tasks.task import Marker, Outcome, Task, _each
from trl_suite.tasks.wrapper import Wrapper
from trl_suite.util import errors
from trl_suite.util.compiled import compiled_loop, packed
from trl_suite.util.random import Streams

PUSH_COLOUR = (0.9, 0.2, 0.15, 1.0)
_METRES_PER_NEWTON = 0.004  # of the arrow that shows a push


class Disturbed(Wrapper):
    """Another task with worlds that vary between episodes, pushes and sensors.

    Worlds are drawn from the random state that `reset` gets, without taking numbers from it: the
    other task draws the same terrain and start as without this one. Rewards, terminations and
    custom functions read the true state; only the observation is that of the sensors.

    `info` has 'world', the drawn properties by name; with pushes 'impulse', that of the last step,
    (n, 3) N s; with sensors 'clean_observation', the exact observation, (n, size), whose columns
    are those of `blocks`.

    Attributes:
      task: the other task.
      variation: the properties of the worlds, after `bind`; None if they do not vary.
    """

    variation: Variation | None

    def __init__(self, task: Task, world: WorldConfig | None, sensor: SensorConfig | None) -> None:
        """Composes the task.

        Args:
          task: any task that no other environment uses.
          world: options of worlds and pushes, or None.
          sensor: options of sensors, or None.

        Raises:
          ValueError: options that the task cannot have.
        """
        self._world_config, self._sensor_config = world, sensor
        self._push: PushConfig | None = world.push if world is not None else None
        if world is not None:
            _check(task, world)
        if sensor is not None:
            sensors.check(sensor, task.observed)
        super().__init__(task)

    @property
    def made_of(self) -> dict[str, tuple[str, Any]]:
        configs = {'randomize': self._world_config, 'sensors': self._sensor_config}
        given = {name: (str(each.changed), each) for name, each in configs.items() if each}
        return {**self.task.made_of, **given}

    def bind(self, world: World) -> None:
        self.task.bind(world)
        self.world, inner = world, self.task.outcome
        self.outcome, self.variation = inner, None
        self._info: dict[str, Any] = {}
        saved: list[Any] = []
        if self._world_config is not None:
            saved += self._bind_world(world, self._world_config)
        self._sensors: Any = None
        if self._sensor_config is not None:
            # Tasks whose steps last longer than 1/30 s have a callback within steps.
            long_steps = hasattr(self.task, 'watch')
            rules = sensors.rules(self._sensor_config, self.observed, inner.observation, long_steps)
            self._sensors, self._sensor_state = packed(rules), rules.state
            self.outcome = Outcome(rules.state.observation, *inner[1:])
            self._info['clean_observation'] = inner.observation
            saved.append(rules.state)
        self.saved = tuple(saved)

    def _bind_world(self, world: World, config: WorldConfig) -> list[Any]:
        """Resolves what varies in a world; returns its state."""
        figure = self.task.figure  # type: ignore[attr-defined]
        spatial = self.task.character.spec.spatial  # type: ignore[attr-defined]
        constants = getattr(self.task.root_entity, 'set_inertia', None)
        dofs = figure.pose_dof[6 if spatial else 3 :]
        self.variation = Variation(world, config.varied, figure.links, dofs, constants)
        properties = self.variation.properties
        self._info['world'] = {name: getattr(properties, name) for name in config.varied}
        if self._push is None:
            return [properties]
        pushes, push = world.engine.pushes, self._push
        pushes.ranges[FORCE] = push.speed if push.force is None else push.force
        pushes.ranges[DURATION], pushes.ranges[INTERVAL] = push.duration, push.interval
        pushes.ranges[DIRECTION], pushes.planar[0] = push.direction, not spatial
        pushes.mass[0] = self.variation.mass if push.force is None else 0.0
        links = self.task.character.spec.links  # type: ignore[attr-defined]
        pushes.body[0] = figure.links[0 if push.body is None else links.index(push.body)]
        self._info['impulse'] = pushes.state.impulse
        return [properties, pushes.state]

    def reset(self, env_ids: np.ndarray, random_states: Sequence[np.random.RandomState]) -> None:
        states = [random_state.get_state() for random_state in random_states]
        for env_id, state in zip(env_ids.tolist(), states, strict=True):
            self._begin(env_id, _seed(state))
        self.task.reset(env_ids, random_states)
        for before, random_state in zip(states, random_states, strict=True):
            if _position(random_state.get_state()) == _position(before):
                random_state.random_sample()  # a task that draws nothing: worlds vary all the same
        self._sense(env_ids, FRESH)

    def _begin(self, env_id: int, seed: np.random.SeedSequence) -> None:
        """Draws world and first push of an episode, and seeds its streams."""
        worlds_, pushes_, sensors_ = seed.spawn(3)
        if self.variation is not None:
            assert self._world_config is not None
            worlds.draw(
                env_id, self._world_config, np.random.default_rng(worlds_),
                self.task.character.spec.spatial,  # type: ignore[attr-defined]
                self.variation.properties,
            )  # fmt: skip
            self.variation.apply(env_id)
        if self._push is not None:
            state = self.world.engine.pushes.state
            _seeded(env_id, pushes_, state.stream)
            state.impulse[env_id] = 0.0
            first_push(np.array([env_id]), self.world.pack)
        if self._sensors is not None:
            _seeded(env_id, sensors_, self._sensor_state.stream)

    def _sense(self, env_ids: np.ndarray, kind: int) -> None:
        if self._sensors is not None:
            sense_all(env_ids, kind, self._sensors)

    def _clear_impulse(self, env_ids: np.ndarray) -> None:
        if self._push is not None:
            self.world.engine.pushes.state.impulse[env_ids] = 0.0

    def step(self, action: np.ndarray, env_ids: np.ndarray) -> None:
        self._clear_impulse(env_ids)
        self.task.step(action, env_ids)
        self._sense(env_ids, NEXT)

    # A plain composer.Environment calls these instead of `step`.

    def apply_action(self, action: np.ndarray, env_ids: np.ndarray) -> None:
        self._clear_impulse(env_ids)
        self._steps_before = int(self.world.engine.steps[0])
        self.task.apply_action(action, env_ids)

    def finish_step(self, env_ids: np.ndarray) -> None:
        self.task.finish_step(env_ids)
        self._sense(env_ids, NEXT)

    def after_step(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        if self._push is not None and self.world.engine.steps[0] == self._steps_before:
            raise RuntimeError(
                'a plain composer.Environment has no pushes: use '
                'trl_suite.environments.environment.Environment'
            )
        self.task.after_step(physics, random_state)
        self._sense(self.world.all_ids, NEXT)

    def observe(self, env_ids: np.ndarray | None = None) -> None:
        self.task.observe(env_ids)
        self._sense(self.world.all_ids if env_ids is None else env_ids, AGAIN)

    # Results and state.

    def info(self) -> dict[str, Any]:
        """Returns the info of the other task, with that of the disturbances."""
        return {**self.task.info(), **_each(self._info, np.copy)}

    def info_of(self, env_id: int) -> dict[str, Any]:
        """Returns `info` for one simulation, as numbers and arrays."""
        return {**self.task.info_of(env_id), **_each(self._info, lambda array: _row(array, env_id))}

    def get_state(self, env_id: int) -> dict[str, Any]:
        arrays = [[array[env_id].copy() for array in group] for group in self.saved]
        return {'task': self.task.get_state(env_id), 'arrays': arrays}

    def set_state(self, env_id: int, state: dict[str, Any]) -> None:
        for group, values in zip(self.saved, state['arrays'], strict=True):
            for array, value in zip(group, values, strict=True):
                array[env_id] = value
        if self.variation is not None:
            self.variation.apply(env_id)
        self.task.set_state(env_id, state['task'])

    def markers(self, env_id: int) -> list[Marker]:
        """Returns the markers of the other task, and an arrow for a push."""
        found = list(self.task.markers(env_id)) if hasattr(self.task, 'markers') else []
        if self._push is not None:
            pushes, time = self.world.engine.pushes, self.world.time[env_id]
            if pushes.state.begin[env_id] <= time < pushes.state.end[env_id]:
                x, y, _ = pushes.state.force[env_id]
                length = max(_METRES_PER_NEWTON * float(np.hypot(x, y)), 0.1)
                yaw = float(np.arctan2(y, x))
                place = self.world.xipos[env_id, pushes.body[0]].copy()
                place[:2] -= (length + 0.15) * np.array([np.cos(yaw), np.sin(yaw)])
                found.append(Marker('arrow', place, (0.03, 0.03, length), PUSH_COLOUR, yaw))
        return found


@compiled_loop
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


def _seed(state: Any) -> np.random.SeedSequence:
    """Returns a seed from a random state (`RandomState.get_state()`), without drawing from it."""
    _, keys, position, has_gauss, gauss = state
    digest = hashlib.blake2b(keys.tobytes(), digest_size=16)
    digest.update(f'{position} {has_gauss} {gauss!r}'.encode())
    return np.random.SeedSequence(int.from_bytes(digest.digest(), 'little'))


def _position(state: Any) -> tuple[Any, ...]:
    """Returns what changes in a random state whenever a number is drawn."""
    _, keys, position, has_gauss, gauss = state
    return int(keys[0]), position, has_gauss, gauss


def _seeded(env_id: int, seed: np.random.SeedSequence, stream: np.ndarray) -> None:
    """Seeds the stream of one simulation."""
    streams = Streams(1)
    streams.seed(0, seed)
    stream[env_id] = streams.state[0]


def _row(array: np.ndarray, env_id: int) -> Any:
    return array.item(env_id) if array.ndim == 1 else array[env_id].copy()
