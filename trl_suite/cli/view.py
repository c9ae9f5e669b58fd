"""`trl-suite view`: dm_control's viewer on an environment, with a policy that acts.

Steps that last longer than 1/30 s (gaits, plans of footsteps) are shown frame by frame.
"""

from __future__ import annotations

import argparse
import collections
import importlib
import os
import sys
import warnings
from typing import TYPE_CHECKING, Any

import dm_env
import numpy as np

from trl_suite import rendering
from trl_suite.cli import engine
from trl_suite.environments import named_policies as acting

if TYPE_CHECKING:
    from trl_suite.environments.environment import Environment

INSTEAD = 'without one, make a film of it: trl-suite rollout ID --video FILE.mp4'


def run(arguments: argparse.Namespace) -> None:
    """Opens a window, and returns when it is closed."""
    check_screen()
    suite = engine.load()
    environment = suite.make(arguments.id, {'random': arguments.seed})
    name = arguments.policy
    if name == 'best':
        name, _ = acting.best(environment, arguments.id)

    def policy() -> rendering.Policy:
        return acting.policy(name, environment, arguments.id, arguments.seed)

    policy()(environment.reset())  # what cannot act says so before a window opens
    environment.random_state.seed(arguments.seed)
    view(environment, policy(), f'{suite.find(arguments.id).id}: {name}')


def check_screen() -> None:
    """Makes sure that a window can be opened, and lets dm_control draw by way of GLFW.

    Raises:
      RuntimeError: there is no screen, or none that GLFW can use; the message says what to do.
    """
    if sys.platform == 'linux' and not (
        os.environ.get('DISPLAY') or os.environ.get('WAYLAND_DISPLAY')
    ):
        raise RuntimeError(
            'a window needs a screen, but neither DISPLAY nor WAYLAND_DISPLAY is set; ' + INSTEAD
        )
    import glfw  # dm_control brings it

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter('always')
        if not glfw.init():
            reason = ' '.join(str(each.message) for each in caught) or 'it does not say why'
            raise RuntimeError(f'a window needs a screen that GLFW can use ({reason}); {INSTEAD}')
    # dm_control draws windows with no other library. It reads the variable when it is imported.
    os.environ['MUJOCO_GL'] = 'glfw'
    render = sys.modules.get('dm_control._render')
    if render is not None and getattr(render, 'BACKEND', None) != 'glfw':
        importlib.reload(render)


def view(environment: Environment, policy: rendering.Policy, title: str) -> None:
    """Shows an environment until the window is closed.

    Args:
      environment: begins a new episode.
      policy: time step -> action.
      title: of the window.

    Raises:
      RuntimeError: no window can be opened.
    """
    from trl_suite.viewing.window import Window

    frames: Any = environment
    if hasattr(environment.task, 'watch'):
        frames = Frames(environment, policy)
        policy = frames.policy
    Window(environment, title).launch(frames, policy)


class Frames(dm_env.Environment):
    """An environment whose long steps are shown frame by frame, 1/30 s each.

    A step is simulated as a whole and then played back: every step of this environment puts the
    simulation into the state of the next frame, the last one into that from which it goes on. Actions
    count, and the policy is asked, only where no frame is left.
    """

    def __init__(self, environment: Environment, policy: rendering.Policy) -> None:
        self._environment, self._policy = environment, policy
        self._left: collections.deque[dict[str, Any]] = collections.deque()
        self._action = np.zeros(environment.action_spec().shape)

    def policy(self, time_step: dm_env.TimeStep) -> np.ndarray:
        """Returns the action that is due, of a step that is being played back the one it had."""
        if not self._left:
            self._action = self._policy(time_step)
        return self._action

    def reset(self) -> dm_env.TimeStep:
        self._left.clear()
        self._end = self._environment.reset()
        return self._end

    def step(self, action: np.ndarray) -> dm_env.TimeStep:
        environment = self._environment
        if not self._left:
            with rendering.watching(
                environment, lambda: self._left.append(environment.get_state())
            ):
                self._end = environment.step(action)
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
        """The simulation, as the viewer draws it."""
        return self._environment.physics
