"""Common settings of all arenas: solver options, contacts of the ground, sky and light."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from dm_control import mjcf

from trl_suite.engine import GRAVITY

Colour = tuple[float, float, float]
CONTACTS = {  # of geoms of the ground
    'friction': (
        0.81,
        0.005,
        0.0001,
    ),  # 0.9 * 0.9: the original multiplies, MuJoCo takes the larger
    'solref': (0.005, 1),
    'solimp': (0.95, 0.99, 0.001),
    'condim': 3,
}
PARKED = -60.0  # m; z of unused boxes


class Look(NamedTuple):
    """Colours of a scene: red, green, blue in [0, 1]."""

    ground: tuple[Colour, Colour]  # light and dark squares
    sky: tuple[Colour, Colour]  # above, and below; their mean is the horizon
    light: Colour  # of the camera's lamp, which adds to the sun that follows each character


OLIVE = Look(
    ground=((0.47, 0.52, 0.44), (0.42, 0.47, 0.40)),
    sky=((0.62, 0.76, 0.92), (0.95, 0.97, 1.0)),
    light=(0.45, 0.45, 0.45),
)
LOOKS = {  # by family; combinations of users are olive
    'imitation': Look(  # a studio
        ground=((0.66, 0.68, 0.71), (0.60, 0.62, 0.65)),
        sky=((0.80, 0.84, 0.89), (0.97, 0.97, 0.98)),
        light=(0.42, 0.43, 0.46),
    ),
    'plaid': Look(  # limestone at noon
        ground=((0.82, 0.78, 0.69), (0.75, 0.71, 0.62)),
        sky=((0.45, 0.67, 0.90), (0.93, 0.95, 0.96)),
        light=(0.48, 0.45, 0.40),
    ),
    'terrainrl': Look(  # dry grass
        ground=((0.70, 0.72, 0.50), (0.64, 0.66, 0.45)),
        sky=((0.52, 0.74, 0.93), (0.94, 0.97, 0.99)),
        light=(0.45, 0.46, 0.42),
    ),
    'deeploco': Look(  # pale stone in the evening
        ground=((0.64, 0.63, 0.58), (0.58, 0.57, 0.53)),
        sky=((0.55, 0.63, 0.82), (0.99, 0.89, 0.78)),
        light=(0.47, 0.43, 0.40),
    ),
}


def prepare(root: mjcf.RootElement, look: Look = OLIVE) -> None:
    """Sets the options of the physics, and adds sky and light (the sun follows each character)."""
    # composer's arena sets an elliptic cone and noslip iterations; neither is wanted.
    root.option.cone = 'pyramidal'
    root.option.noslip_iterations = 0
    root.option.integrator = 'implicitfast'
    root.option.gravity = (0, 0, -GRAVITY)
    root.compiler.boundmass = 0
    root.compiler.boundinertia = 0
    # Sky and light cost so little that one model is used for both physics and rendering.
    root.visual.quality.shadowsize = 2048
    root.visual.quality.offsamples = 0
    getattr(root.visual, 'global').offwidth = 1920
    getattr(root.visual, 'global').offheight = 1080
    root.statistic.extent = 3  # m; of the character, not of the ground, so that shadows are sharp
    # In units of the extent. Ground beyond the range of shadows is speckled; zfar is the horizon.
    root.visual.map.shadowclip = 8
    root.visual.map.znear, root.visual.map.zfar = 0.01, 400
    root.visual.headlight.set_attributes(
        ambient=(0.35, 0.35, 0.35), diffuse=look.light, specular=(0.1, 0.1, 0.1)
    )
    # Contact forces, which viewers can show: red instead of MuJoCo's pale blue.
    root.visual.rgba.contactforce = (0.9, 0.2, 0.15, 1)
    root.visual.scale.forcewidth = 0.2
    root.visual.rgba.haze = (*np.mean(look.sky, axis=0), 1)  # no line along the horizon
    sky = {'type': 'skybox', 'builtin': 'gradient', 'width': 64, 'height': 64}
    root.asset.add('texture', name='sky', rgb1=look.sky[0], rgb2=look.sky[1], **sky)


def paint(
    root: mjcf.RootElement,
    name: str,
    colours: tuple[Colour, Colour],
    repeat: float = 1,
    **more: Any,
) -> None:
    """Adds a checkered texture, and its material; `more` are attributes of the texture."""
    checker = {'type': '2d', 'builtin': 'checker', 'width': 256, 'height': 256}
    root.asset.add('texture', name=name, rgb1=colours[0], rgb2=colours[1], **checker, **more)
    tiles = {'texuniform': True, 'texrepeat': (repeat, repeat)}
    root.asset.add('material', name=name, texture=name, reflectance=0, specular=0, **tiles)
