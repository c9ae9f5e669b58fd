"""Draws a clip as a film strip: python mocap/recipes/strip.py NAME OUT.png (needs MUJOCO_GL)."""

from __future__ import annotations

import sys

import checks
import figure
import imageio.v3 as imageio
import mujoco
import numpy as np

from trl_suite import motion

FRAMES = 8


def strip(clip: motion.Clip, character: str, frames: int = FRAMES, size: int = 300) -> np.ndarray:
    """Returns pictures over one cycle side by side, RGB (height, width, 3)."""
    model = figure.model(character, ground=True)
    model.vis.headlight.ambient[:] = 0.45
    model.vis.headlight.diffuse[:] = 0.6
    data = mujoco.MjData(model)
    camera = mujoco.MjvCamera()
    camera.azimuth, camera.elevation, camera.distance = 90, -6, 2.4
    address = [model.jnt_qposadr[model.joint(name).id] for name in clip.joints]
    pictures = []
    with mujoco.Renderer(model, size, size) as renderer:
        for pose in clip.pose(np.arange(frames) / frames * clip.duration):
            data.qpos[:3], data.qpos[address] = pose[:3], pose[3:]
            mujoco.mj_forward(model, data)
            camera.lookat[:] = pose[0], 0, 0.5
            renderer.update_scene(data, camera)
            renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
            pictures.append(renderer.render())
    return np.concatenate(pictures, axis=1)


if __name__ == '__main__':
    name, path = sys.argv[1:]
    imageio.imwrite(path, strip(motion.load(name), checks.CHARACTERS[name]))
