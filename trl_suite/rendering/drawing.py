"""Pictures without a screen: frames, videos, film strips, plots of terrain, height maps.

    from trl_suite import suite
    from trl_suite import rendering

    environment = suite.make('PD_Biped2D_Gaps_Terrain-v0', task_kwargs={'random': 1})
    environment.reset()
    image = rendering.frame(environment, ghost=True)  # (480, 640, 3) uint8

    policy = lambda time_step: environment.task.clip_action(0)
    rendering.video(rendering.frames(environment, policy, steps=90), 'rollout.mp4')

Drawing needs an OpenGL library, chosen by the environment variable MUJOCO_GL before Python starts:
egl or osmesa without a screen, glfw with one. What becomes of frames, and pictures that need no
OpenGL, are `trl_suite.rendering.pictures`.
"""

from __future__ import annotations

import contextlib
import importlib
import operator
import os
import sys
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from trl_suite.util import errors

if TYPE_CHECKING:  # a terrain can be plotted where the engine cannot be loaded
    from dm_control import composer


Policy = Callable[[Any], np.ndarray]  # from a dm_env.TimeStep to an action in [-1, 1]
GHOST_COLOUR = (1.0, 0.85, 0.35, 0.45)  # red, green, blue, opacity
_drawn_by: set[int] = set()  # the process that has drawn; a forked child has another number
GHOST_BEHIND = 0.7  # m; the ghost stands this much farther from the camera than the character


def frame(
    environment: composer.Environment,
    height: int = 480,
    width: int = 640,
    camera: str | int = 'side',
    ghost: bool = False,
) -> np.ndarray:
    """Draws the current state, and what the task marks: places, goals, directions.

    Args:
      environment: any composer environment, after `reset`.
      height: pixels.
      width: pixels.
      camera: name of a camera, short ('side', 'front') or full ('biped2d/side'), or its number; -1
        is a camera that looks at the whole model.
      ghost: also draw the reference clip, translucent and set back a little to the side. It walks
        its own way from the start of the episode, so the distance between the two shows.

    Returns:
      The picture, shape (height, width, 3), uint8.

    Raises:
      ValueError: unknown camera, a size that is not positive or above the model's limit, or a ghost
        where the task has no reference clip.
      RuntimeError: there is no OpenGL to draw with (the message names MUJOCO_GL and its choices), this
        process was forked from one that has drawn, or another thread uses the environment.
    """
    with getattr(environment, 'one_thread', contextlib.nullcontext()):
        return _frame(environment, height, width, camera, ghost)


def _frame(
    environment: composer.Environment, height: int, width: int, camera: str | int, ghost: bool
) -> np.ndarray:
    physics = environment.physics
    limits = physics.model.vis.global_
    for name, size, limit in (
        ('height', height, limits.offheight),
        ('width', width, limits.offwidth),
    ):
        if not 0 < operator.index(size) <= limit:
            raise ValueError(f'{name} is {size}; expected 1 to {limit} pixels')
    if ghost and getattr(environment.task, 'reference_pose', None) is None:
        raise ValueError(
            f'the task {type(environment.task).__name__} has no reference clip to draw as a ghost'
        )
    camera_id = _camera(physics, camera)
    _check_gl(physics)
    task: Any = environment.task
    additions = [_ghost(task)] if ghost else []
    if hasattr(task, 'markers'):
        additions.append(markers(task))

    def add(physics: Any, scene: Any) -> None:
        for addition in additions:
            addition(physics, scene)

    return physics.render(height, width, camera_id, scene_callback=add if additions else None)


def frames(
    environment: composer.Environment, policy: Policy, steps: int = 256, **options: Any
) -> Iterator[np.ndarray]:
    """Runs a policy from a reset on, over ends of episodes, and draws every state.

    Where a step lasts longer than 1/30 s (gaits), every 1/30 s is drawn instead of every state.

    Args:
      environment: is reset and stepped.
      policy: time step -> action; not asked at the end of an episode.
      steps: control steps.
      **options: of `frame`.

    Yields:
      One picture per state: steps of them, one more for every reset.
    """
    within: list[np.ndarray] = []

    def look() -> None:
        within.append(frame(environment, **options))

    time_step = environment.reset()
    yield frame(environment, **options)
    for _ in range(steps):
        if time_step.last():
            time_step = environment.reset()
            yield frame(environment, **options)
        within.clear()
        with watching(environment, look) as watched:
            time_step = environment.step(policy(time_step))
        if not watched:
            look()
        yield from within


@contextlib.contextmanager
def watching(environment: composer.Environment, look: Callable[[], None]) -> Iterator[bool]:
    """Has `look` called every 1/30 s where steps last longer; yields whether that is so."""
    task: Any = environment.task
    watched = hasattr(task, 'watch')
    if watched:
        task.watch = look
    try:
        yield watched
    finally:
        if watched:
            task.watch = None


def _camera(physics: Any, camera: str | int) -> int:
    names = [physics.model.id2name(i, 'camera') for i in range(physics.model.ncam)]
    if not isinstance(camera, str):
        if not -1 <= operator.index(camera) < len(names):
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


def _check_gl(physics: Any) -> None:
    """Makes the drawing context at the first picture."""
    process = os.getpid()
    if _drawn_by and process not in _drawn_by:
        raise RuntimeError(
            'drawing does not survive a fork: the OpenGL context stays in the parent, which has drawn '
            "already. Draw there, or start processes with multiprocessing's 'spawn'"
        )
    try:
        _use_chosen_library()
        _ = physics.contexts
    # What fails here depends on the library: RuntimeError, AttributeError, FatalError, GLError.
    except Exception as error:
        raise RuntimeError(no_gl(error)) from error
    _drawn_by.add(process)


def _use_chosen_library() -> None:
    """Lets dm_control take the library that MUJOCO_GL names now, if the one it took cannot draw.

    dm_control reads the variable when it is imported. Who imports it before this package, as sorted
    imports do, leaves it with GLFW, also where there is no screen.
    """
    render = sys.modules.get('dm_control._render')
    if getattr(render, 'BACKEND', None) != 'glfw' or _screen():
        return
    if os.environ.get('MUJOCO_GL') not in ('egl', 'osmesa'):
        # GLFW itself would warn, and leave a half-made context that fails once more at exit.
        raise RuntimeError('GLFW finds no screen')
    assert render is not None
    importlib.reload(render)


def _screen() -> bool:
    return sys.platform != 'linux' or bool(
        os.environ.get('DISPLAY') or os.environ.get('WAYLAND_DISPLAY')
    )


def no_gl(error: Exception) -> str:
    """Returns the sentence for a machine on which nothing can be drawn."""
    set_to = os.environ.get('MUJOCO_GL')
    state = 'is not set' if set_to is None else f'is {set_to!r}'
    reason = str(error).strip().partition('\n')[0].rstrip('.')
    return (
        f'nothing can be drawn, since there is no OpenGL ({reason}); MUJOCO_GL {state}: set it '
        'before Python starts, to egl or osmesa (no screen needed), glfw (with a screen), or '
        'disable (no pictures). `trl-suite doctor` tells which can draw here'
    )


def _ghost(task: Any) -> Callable[[Any, Any], None]:
    """Returns a scene callback that adds the reference pose to what is drawn."""
    import mujoco

    def add(physics: Any, scene: Any) -> None:
        # Data of its own on the same model: neither the model nor the simulation is touched.
        model, data = physics.model.ptr, mujoco.MjData(physics.model.ptr)
        addresses = task.figure.pose_qpos
        data.qpos[addresses] = task.reference_pose(0)
        mujoco.mj_kinematics(model, data)
        before = scene.ngeom
        mujoco.mjv_addGeoms(
            model, data, mujoco.MjvOption(), mujoco.MjvPerturb(), mujoco.mjtCatBit.mjCAT_DYNAMIC,
            scene,
        )  # fmt: skip
        root = model.jnt_bodyid[np.flatnonzero(model.jnt_qposadr == addresses[0])[0]]
        for geom in scene.geoms[before : scene.ngeom]:
            # Moving boxes have no ghosts.
            own = model.body_rootid[model.geom_bodyid[geom.objid]] == model.body_rootid[root]
            geom.pos[1] += GHOST_BEHIND
            geom.rgba = GHOST_COLOUR if own else np.zeros(4)
            geom.matid = -1

    return add


def markers(task: Any) -> Callable[[Any, Any], None]:
    """Returns a scene callback that adds a task's markers to what is drawn."""
    import mujoco

    def add(physics: Any, scene: Any) -> None:
        for marker in task.markers(0):
            if scene.ngeom == scene.maxgeom:
                return
            scene.ngeom += 1
            geom = scene.geoms[scene.ngeom - 1]
            cosine, sine = np.cos(marker.yaw), np.sin(marker.yaw)
            if marker.shape == 'arrow':  # they point along their z axis
                axes = np.array([[0, -sine, cosine], [0, cosine, sine], [-1, 0, 0]])
            else:
                axes = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
            mujoco.mjv_initGeom(
                geom, getattr(mujoco.mjtGeom, f'mjGEOM_{marker.shape.upper()}'),
                np.array(marker.size, float), np.array(marker.position, float), axes.ravel(),
                np.array(marker.colour, np.float32),
            )  # fmt: skip
            geom.category = mujoco.mjtCatBit.mjCAT_DECOR

    return add
