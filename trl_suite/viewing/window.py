"""dm_control's viewer, adapted to the suite. Importing this module warns if there is no display."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from dm_control.mujoco import wrapper
from dm_control.viewer import application, viewer

from trl_suite.environments.environment import Environment
from trl_suite.rendering import overlays

AZIMUTH, ELEVATION = 90.0, -8.0  # degrees; from the right of a character that walks along x
DISTANCE = 4.0  # m; of the camera


class Window(application.Application):
    """A viewer that runs from the start and tracks the character.

    It also draws the task's markers, and uploads changed height fields. dm_control's viewer
    (1.0.50) has no public interface for any of these.
    """

    def __init__(self, environment: Environment, title: str) -> None:
        super().__init__(title)
        self._shown = environment
        self._field = np.zeros(0)  # as uploaded to the graphics card
        self._pause_subject.toggle()
        self._viewer = viewer.Viewer(
            self._viewport,
            self._window.mouse,
            self._window.keyboard,
            scene_callback=self._before_drawing,
        )

    def _perform_deferred_reload(self, params: Any) -> None:
        super()._perform_deferred_reload(params)
        if params.zoom_to_scene:  # at the first time only; later reloads keep the camera
            self._viewer.camera.settings = following(self._shown)

    def _before_drawing(self, model: Any, data: Any, scene: Any) -> None:
        for overlay in overlays.of_task(self._shown.task):
            overlay(self._shown.physics, scene.ptr)
        if model.nhfield and not np.array_equal(model.hfield_data, self._field):
            self._field = model.hfield_data.copy()
            drawn = self._renderer._mujoco_context
            if drawn is not None:  # else it will be created with this field
                with self._renderer._surface.make_current() as gl:
                    gl.call(mujoco.mjr_uploadHField, model.ptr, drawn.ptr, 0)


def following(environment: Environment) -> Any:
    """Returns the settings of a camera that tracks the character."""
    task, model = environment.task, environment.physics.model
    camera = wrapper.MjvCamera()
    camera.type_ = mujoco.mjtCamera.mjCAMERA_TRACKING
    camera.trackbodyid = int(model.jnt_bodyid[overlays.root_joint(model, task)])
    camera.fixedcamid = -1
    camera.azimuth, camera.elevation, camera.distance = AZIMUTH, ELEVATION, DISTANCE
    return camera
