"""Draws a clip, or one step, from side and front: python strip3d.py NAME[:INDEX] OUT.png."""

from __future__ import annotations

import sys

import checks3d
import figure3d
import imageio.v3 as imageio
import mujoco
import numpy as np
import step3d

from trl_suite import motion

FRAMES = 8
VIEWS = ((90.0, -6.0), (180.0, -6.0))  # azimuth and elevation: from the right, from the front


def strip(clip: motion.Clip, character: str, frames: int = FRAMES, size: int = 300) -> np.ndarray:
    """Returns pictures over the clip side by side, a row per view, RGB (height, width, 3)."""
    model = figure3d.model(character, ground=True)
    model.vis.headlight.ambient[:] = 0.45
    model.vis.headlight.diffuse[:] = 0.6
    data = mujoco.MjData(model)
    camera = mujoco.MjvCamera()
    camera.distance = 2.4
    address = checks3d.place(model, clip)
    times = np.linspace(0, clip.duration, frames, endpoint=not clip.loop)
    rows = []
    with mujoco.Renderer(model, size, size) as renderer:
        for azimuth, elevation in VIEWS:
            camera.azimuth, camera.elevation = azimuth, elevation
            pictures = []
            for pose in clip.pose(times):
                data.qpos[address] = pose
                mujoco.mj_forward(model, data)
                camera.lookat[:] = pose[0], pose[1], 0.65
                renderer.update_scene(data, camera)
                renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
                pictures.append(renderer.render())
            rows.append(np.concatenate(pictures, axis=1))
    return np.concatenate(rows)


if __name__ == '__main__':
    name, path = sys.argv[1:]
    name, _, index = name.partition(':')
    if index:
        picture = strip(motion.load_steps(name).clip(int(index)), step3d.character(name))
    else:
        picture = strip(motion.load(name), checks3d.CHARACTERS[name])
    imageio.imwrite(path, picture)
