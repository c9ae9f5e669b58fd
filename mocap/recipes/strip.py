"""Draws a clip, or a step as biped3d_mocap:7, as a film strip: python strip.py NAME[:INDEX] OUT.png."""

from __future__ import annotations

import sys

import checks
import checks3d
import figure
import figure3d
import imageio.v3 as imageio
import mujoco
import numpy as np
import step3d

from trl_suite import motion

FRAMES, SIZE = 8, 300
VIEWS = ((90.0, -6.0), (180.0, -6.0))  # azimuth and elevation: from the right, from the front


def strip(clip: motion.Clip, model: mujoco.MjModel, address: list[int], views: int) -> np.ndarray:
    """Returns pictures over the clip side by side, a row per view, RGB (height, width, 3).

    Args:
      clip: the clip.
      model: its character.
      address: addresses of its columns in qpos.
      views: number of views.
    """
    model.vis.headlight.ambient[:] = 0.45
    model.vis.headlight.diffuse[:] = 0.6
    data = mujoco.MjData(model)
    camera = mujoco.MjvCamera()
    camera.distance = 2.4
    times = np.linspace(0, clip.duration, FRAMES, endpoint=not clip.loop)
    rows = []
    with mujoco.Renderer(model, SIZE, SIZE) as renderer:
        for camera.azimuth, camera.elevation in VIEWS[:views]:
            pictures = []
            for pose in clip.pose(times):
                data.qpos[address] = pose
                mujoco.mj_forward(model, data)
                root = data.body('root').xpos
                camera.lookat[:] = root[0], root[1], 0.6
                renderer.update_scene(data, camera)
                renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
                pictures.append(renderer.render())
            rows.append(np.concatenate(pictures, axis=1))
    return np.concatenate(rows)


if __name__ == '__main__':
    name, path = sys.argv[1:]
    name, _, index = name.partition(':')
    if name in checks.CHARACTERS:
        clip, model = motion.load(name), figure.model(checks.CHARACTERS[name], ground=True)
        address = [0, 1, 2, *(model.jnt_qposadr[model.joint(each).id] for each in clip.joints)]
        picture = strip(clip, model, address, 1)
    else:
        clip = motion.load_steps(name).clip(int(index)) if index else motion.load(name)
        character = step3d.character(name) if index else checks3d.CHARACTERS[name]
        model = figure3d.model(character, ground=True)
        picture = strip(clip, model, checks3d.place(model, clip), 2)
    imageio.imwrite(path, picture)
