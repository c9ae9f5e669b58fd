"""Playback of long steps, of gaits and of footstep plans, in frames of 1/30 s."""

from __future__ import annotations

import collections
from typing import TYPE_CHECKING, Any

import dm_env
import numpy as np

from trl_suite import rendering

if TYPE_CHECKING:
    from trl_suite.environments.environment import Environment


class Playback(dm_env.Environment):
    """Wraps an environment with long steps: a step of the wrapper is a frame of 1/30 s.

    A step of the wrapped environment is simulated as a whole and then played back: every step of the
    wrapper restores the state of the next frame. Actions are used, and the policy is called, only
    when no frame is left.
    """

    def __init__(self, environment: Environment, policy: rendering.Policy) -> None:
        self._environment, self._policy = environment, policy
        self._left: collections.deque[dict[str, Any]] = collections.deque()
        self._action = np.zeros(environment.action_spec().shape)

    def policy(self, time_step: dm_env.TimeStep) -> np.ndarray:
        """Returns the next action, or during playback the action of the step that is played back."""
        if not self._left:
            self._action = self._policy(time_step)
        return self._action

    @property
    def is_within_step(self) -> bool:
        """Whether frames of a step are left."""
        return bool(self._left)

    def reset(self) -> dm_env.TimeStep:
        self._left.clear()
        self._end = self._environment.reset()
        return self._end

    def step(self, action: np.ndarray) -> dm_env.TimeStep:
        environment = self._environment
        if not self._left:
            times, data = [environment.physics.data.time], environment.physics.data

            def keep() -> None:
                times.append(data.time)
                self._left.append(environment.get_state())

            with rendering.calling_each_frame(environment, keep):
                self._end = environment.step(action)
            if self._left and times[-1] == data.time:
                self._left.pop()  # the last frame, which lacks the results of the step
            self._left.append(environment.get_state())
        environment.set_state(self._left.popleft())
        if self._left:
            return dm_env.transition(0.0, environment.observation())
        return self._end

    def observation_spec(self) -> Any:
        return self._environment.observation_spec()

    def action_spec(self) -> Any:
        return self._environment.action_spec()

    @property
    def physics(self) -> Any:
        """The simulation, for the viewer."""
        return self._environment.physics
