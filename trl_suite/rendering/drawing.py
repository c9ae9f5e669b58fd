"""Rendering without a display: frames of environments.

    from trl_suite import suite
    from trl_suite import rendering

    environment = suite.make('PD_Biped2D_Gaps_Terrain-v0', task_kwargs={'random': 1})
    environment.reset()
    image = rendering.frame(environment, ghost=True)  # (480, 640, 3) uint8

    policy = lambda time_step: environment.task.clip_action(0)
    rendering.video(rendering.frames(environment, policy, steps=90), 'rollout.mp4')
    rendering.replay(environment, policy, 'rollout.html')  # an interactive page

Rendering needs an OpenGL library, chosen by the environment variable MUJOCO_GL before Python
starts: egl or osmesa without a display, glfw with one. `trl_suite.rendering.pictures` writes frames
to files, and makes pictures without OpenGL.
"""

from __future__ import annotations

import contextlib
import functools
import os
import sys
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from trl_suite.util import errors, interrupts
from trl_suite.util.options import checked

if TYPE_CHECKING:  # plots of terrain need no engine
    from dm_control import composer

    from trl_suite.rendering.replays import Replay
    from trl_suite.util.files import Path


Policy = Callable[[Any], np.ndarray]  # from a dm_env.TimeStep to an action in [-1, 1]


def frame(
    environment: composer.Environment,
    height: int = 480,
    width: int = 640,
    camera: str | int = 'side',
    ghost: bool = False,
) -> np.ndarray:
    """Renders the current state, and the task's markers: places, goals, directions.

    Args:
      environment: any composer environment, after `reset`.
      height: pixels.
      width: pixels.
      camera: name of a camera, short ('side', 'front') or full ('biped2d/side'), or its number; -1
        is a camera that shows the whole model.
      ghost: also draw the reference clip, translucent and slightly farther from the camera. Its
        displacement since the start of the episode is that of the clip, not of the character.

    Returns:
      The picture, shape (height, width, 3), uint8.

    Raises:
      ValueError: unknown camera, a size that is not positive or above the model's limit, or a ghost
        although the task has no reference clip.
      RuntimeError: no OpenGL library works (the message names MUJOCO_GL and its choices), this
        process was forked from one that has rendered, or another thread uses the environment.
    """
    with getattr(environment, 'core', contextlib.nullcontext()):
        return _frame(environment, height, width, camera, ghost)


def _frame(
    environment: composer.Environment, height: int, width: int, camera: str | int, ghost: bool
) -> np.ndarray:
    from trl_suite.rendering import cameras, overlays

    physics, task = environment.physics, environment.task
    camera_id = check_options(physics.model.ptr, task, height, width, camera, ghost)
    drawn = overlays.of_task(task, ghost)
    check_gl(physics)

    def add(physics: Any, scene: Any) -> None:
        for overlay in drawn:
            overlay(physics, scene)

    with cameras.outside_obstacles(physics, camera_id):
        return physics.render(
            int(height), int(width), camera_id, scene_callback=add if drawn else None
        )


def check_options(
    model: Any,
    task: Any,
    height: int = 480,
    width: int = 640,
    camera: str | int = 'side',
    ghost: bool = False,
) -> int:
    """Checks the options of `frame`; returns the number of the camera.

    The model, a `mujoco.MjModel`, may lack visual assets.
    """
    from trl_suite.rendering import overlays

    limits = model.vis.global_
    for name, value, most in (
        ('height', height, limits.offheight),
        ('width', width, limits.offwidth),
    ):
        checked(name, value, int, 'pixels', at_least=1, at_most=most)
    checked('camera', camera, str | int)
    checked('ghost', ghost, bool)
    overlays.of_task(task, ghost)
    return _camera(model, camera)


def frames(
    environment: composer.Environment, policy: Policy, steps: int = 256, **options: Any
) -> Iterator[np.ndarray]:
    """Runs a policy after a reset, through successive episodes, and renders every state.

    If steps last longer than 1/30 s (gaits), there is a frame every 1/30 s instead. Options are those
    of `frame`, and other arguments those of `played`.

    Yields:
      One frame per state: `steps` frames, and one more for every reset.
    """
    within: list[np.ndarray] = []

    def look(first: bool) -> None:
        within.append(frame(environment, **options))

    for _ in played(environment, policy, steps, look):
        yield from within
        within.clear()


def played(
    environment: composer.Environment,
    policy: Policy,
    steps: int,
    look: Callable[[bool], object] | None = None,
) -> Iterator[tuple[int, Any, np.ndarray]]:
    """Runs a policy after a reset, through successive episodes.

    Args:
      environment: reset and stepped by this function.
      policy: time step -> action; not called at the end of an episode.
      steps: control steps.
      look: called for each frame, with whether it is the first one of an episode.

    Yields:
      The number of steps so far, every time step, and the action that follows it: zeros at ends of
      episodes.

    Raises:
      ValueError: steps is not a whole number.
    """
    steps = checked('steps', steps, int, at_least=0)
    none = np.zeros(environment.action_spec().shape)
    time_step, done = environment.reset(), 0
    while True:
        if look is not None and time_step.first():
            look(True)
        action = none if done == steps or time_step.last() else policy(time_step)
        yield done, time_step, action
        if done == steps:
            return
        if time_step.last():
            time_step = environment.reset()
        else:
            with contextlib.ExitStack() as stack:
                if look is not None:
                    later = functools.partial(look, False)
                    stack.enter_context(calling_each_frame(environment, later))
                time_step = environment.step(action)
            done += 1


def replay(
    environment: composer.Environment,
    policy: Policy,
    path: Path | None = None,
    steps: int = 256,
    ghost: bool = False,
) -> Replay:
    """Runs a policy after a reset, through successive episodes, and records it as an HTML page.

    The page shows the episodes with an orbit camera and a time slider, and loads nothing from other
    hosts. Recording needs no OpenGL.

    Args:
      environment, policy, steps: as for `played`.
      path: file to write, .html; None for none.
      ghost: also show the reference clip.

    Returns:
      The recording, which notebooks display; see `trl_suite.rendering.replays.Replay` for its errors.
    """
    from trl_suite.rendering.replays import Replay

    with Replay(environment, path, ghost=ghost) as recording:
        for _ in played(environment, policy, steps, recording.add):
            pass
    return recording


@contextlib.contextmanager
def calling_each_frame(
    environment: composer.Environment, look: Callable[[], object]
) -> Iterator[None]:
    """Calls `look` every 1/30 s of a step that lasts longer than that, after another step once."""
    task: Any = environment.task
    if not hasattr(task, 'watch'):
        yield
        look()
        return
    task.watch = look
    try:
        yield
    finally:
        task.watch = None


def _camera(model: Any, camera: str | int) -> int:
    names = [model.camera(i).name for i in range(model.ncam)]
    if not isinstance(camera, str):
        if not -1 <= camera < len(names):
            raise ValueError(f'camera is {camera}; expected -1 to {len(names) - 1}')
        return int(camera)
    if camera and camera in names:
        return names.index(camera)
    found = [i for i, name in enumerate(names) if name and name.rpartition('/')[2] == camera]
    if len(found) > 1:
        raise ValueError(f'several cameras are named {camera!r}: {[names[i] for i in found]}')
    if not found:
        known = {*filter(None, names), *(n.rpartition('/')[2] for n in names if n)}
        raise ValueError(errors.unknown('camera', camera, known))
    return found[0]


def check_gl(physics: Any) -> None:
    """Creates the rendering context for the first frame."""
    from trl_suite.rendering import contexts

    contexts.install()
    with interrupts.postponed():  # half a context would print a traceback when it is freed
        _ = physics.contexts


def has_display() -> bool:
    """Whether a window can probably be opened."""
    names = 'DISPLAY', 'WAYLAND_DISPLAY'
    return sys.platform != 'linux' or any(map(os.environ.get, names))


def no_gl(error: Exception) -> str:
    """Returns the error message for a machine without a working OpenGL library."""
    set_to = os.environ.get('MUJOCO_GL')
    state = 'is not set' if set_to is None else f'is {set_to!r}'
    reason = str(error).strip().partition('\n')[0].rstrip('.')
    return (
        f'cannot render: no OpenGL library works ({reason}); MUJOCO_GL {state}. Set it before Python '
        'starts: egl or osmesa (without a display), glfw (with a display), or disable (no rendering). '
        '`trl-suite doctor` shows which of them work on this machine'
    )
