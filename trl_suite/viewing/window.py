"""dm_control's viewer as it suits the suite. Where GLFW finds no screen, importing this warns."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from dm_control.mujoco import wrapper
from dm_control.viewer import application, viewer

from trl_suite import rendering
from trl_suite.environments.environment import Environment

AZIMUTH, ELEVATION = 90.0, -8.0  # degrees; who walks along x is seen from the right
DISTANCE = 4.0  # m; of the camera


class Window(application.Application):
    """A viewer that is under way at once and follows the character.

    It also draws what the task marks, and a height field anew that has changed on the way. dm_control's
    own (1.0.50) has no public way to any of this.
    """

    def __init__(self, environment: Environment, title: str) -> None:
        super().__init__(title)
        self._shown = environment
        self._field = np.zeros(0)  # as the graphics card has it
        self._pause_subject.toggle()
        self._viewer = viewer.Viewer(
            self._viewport, self._window.mouse, self._window.keyboard,
            scene_callback=self._before_drawing,
        )  # fmt: skip

    def _perform_deferred_reload(self, params: Any) -> None:
        super()._perform_deferred_reload(params)
        if params.zoom_to_scene:  # for the first time; later the camera stays as it was
            self._viewer.camera.settings = following(self._shown)

    def _before_drawing(self, model: Any, data: Any, scene: Any) -> None:
        task: Any = self._shown.task
        if hasattr(task, 'markers'):
            rendering.markers(task)(None, scene.ptr)
        if model.nhfield and not np.array_equal(model.hfield_data, self._field):
            self._field = model.hfield_data.copy()
            drawn = self._renderer._mujoco_context
            if drawn is not None:  # else it is about to be made, with this very field
                with self._renderer._surface.make_current() as gl:
                    gl.call(mujoco.mjr_uploadHField, model.ptr, drawn.ptr, 0)


def following(environment: Environment) -> Any:
    """Returns the settings of a camera that looks at the character, wherever it goes."""
    task, model = environment.task, environment.physics.model
    joint = int(np.flatnonzero(model.jnt_qposadr == task.figure.pose_qpos[0])[0])
    camera = wrapper.MjvCamera()
    camera.type_ = mujoco.mjtCamera.mjCAMERA_TRACKING
    camera.fixedcamid, camera.trackbodyid = -1, int(model.jnt_bodyid[joint])
    camera.azimuth, camera.elevation, camera.distance = AZIMUTH, ELEVATION, DISTANCE
    return camera
