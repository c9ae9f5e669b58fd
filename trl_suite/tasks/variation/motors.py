"""Imperfect motors: the option `actuators` of every task."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from trl_suite.actuation import realism, series, strength_curves
from trl_suite.actuation.realism import Actuators
from trl_suite.characters import Character
from trl_suite.engine import World
from trl_suite.tasks.component import MOTORS, Component, spawned
from trl_suite.util.random import seed_stream

if TYPE_CHECKING:
    from trl_suite.tasks.rewards import Outcome
    from trl_suite.tasks.task import Task


class Motors(Component):
    """The motors that `Actuators` describes drive the joints of a task.

    `info` has 'delay' (ms) and 'strength_NAME' of each joint or muscle, if they are options.

    Attributes:
      actuators: the options.
    """

    by_engine = 'motors that are not ideal'

    def __init__(self, actuators: Actuators, character: Character) -> None:
        """Keeps the options; the character is made from what `realism.body` returns.

        Raises:
          ValueError: an option that does not suit the character.
        """
        self.actuators, self._character = actuators, character
        self._curves = strength_curves.load(actuators.torque_pose, character.spec)

    def added_to(self, task: Task) -> None:
        super().added_to(task)
        if self.actuators.backlash or self.actuators.flex:
            series.finish(self._character, task.physics_timestep)

    @property
    def made_of(self) -> dict[str, tuple[str, Any]]:
        # The table of a file counts, not its path.
        own = {**vars(self.actuators), 'torque_pose': self._curves}
        return {'actuators': (str(self.actuators.changed), own)}

    def prepare(self, world: World) -> None:
        model, actuators = world.models[0], self.actuators
        self._units = units = realism.Units(self._character, model)
        self._timestep = world.engine.timestep
        longest = self._steps(actuators.delay.high)
        if actuators.delay.high and not longest:
            raise ValueError(
                f'delay is {actuators.delay.high:g} ms, which is rounded to 0; expected 0, or more than '
                f'half a physics step of {1000 * self._timestep:.3g} ms'
            )
        slots = longest // self.task.steps_per_call + 2 if longest else 0
        self.motors = world.set_motors(
            realism.limits(actuators, units, model, self._curves),
            realism.noise(actuators, units, self._timestep),
            len(units.names),
            slots,
        )
        self.saved = (self.motors,)
        # Nominal values; limits that the engine writes replace those of the models.
        self._gain, self._bias = model.actuator_gainprm.copy(), model.actuator_biasprm.copy()
        self._force, self._joint = model.actuator_forcerange.copy(), model.jnt_actfrcrange.copy()
        if actuators.torque_speed or actuators.torque_pose is not None:
            for each in world.models:  # only the motors' limits count
                each.jnt_actfrclimited[units.joints] = False
                each.actuator_forcelimited[np.concatenate(units.actuators)] = True
        self._delay = np.zeros(world.n)
        self._info: dict[str, np.ndarray] = {}
        if 'strength' in actuators.changed:
            for name, strength in zip(units.names, self.motors.strength.T, strict=True):
                self._info[f'strength_{name}'] = strength
        if longest:
            self._info['delay'] = self._delay

    def bind(self, world: World, outcome: Outcome) -> Outcome:
        self.info_arrays = self._info
        return outcome

    def _strengthen(self, env_id: int) -> None:
        """Scales the torques of the motors or muscles of a simulation by their strengths."""
        model, units = self.task.world.models[env_id], self._units
        # Numbers of the parameters that are proportional to torque: a muscle's peak force; gains.
        scaled = slice(2, 3) if units.muscles else slice(0, 3)
        for unit, ids in enumerate(units.actuators):
            factor = self.motors.strength[env_id, unit]
            model.actuator_gainprm[ids, scaled] = self._gain[ids, scaled] * factor
            model.actuator_biasprm[ids, scaled] = self._bias[ids, scaled] * factor
            if not units.muscles:
                model.actuator_forcerange[ids] = self._force[ids] * factor
                joint = units.joints[unit]
                model.jnt_actfrcrange[joint] = self._joint[joint] * factor

    def _steps(self, delay: float) -> int:
        """Returns a delay in ms as physics steps."""
        return round(delay / 1000 / self._timestep)

    def begin(self, env_id: int, seed: np.random.SeedSequence) -> None:
        own = spawned(seed, MOTORS)
        state, rng = self.motors, np.random.default_rng(own)
        state.age[env_id] = state.given[env_id] = state.used[env_id] = 0
        state.strength[env_id] = rng.uniform(*self.actuators.strength, state.strength.shape[1])
        state.lag[env_id] = self._steps(rng.uniform(*self.actuators.delay))
        state.noise[env_id] = rng.standard_normal(state.noise.shape[1])
        seed_stream(env_id, own.spawn(1)[0], self.motors.stream)
        self.restored(env_id)

    def restored(self, env_id: int) -> None:
        self._delay[env_id] = 1000 * self._timestep * self.motors.lag[env_id]
        self._strengthen(env_id)
