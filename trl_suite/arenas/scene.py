"""Common settings of all arenas: solver options, contacts of the ground, sky and light."""

from __future__ import annotations

from typing import Any, NamedTuple

from dm_control import mjcf

Colour = tuple[float, float, float]
FRICTION = (0.81, 0.005, 0.0001)  # 0.9 * 0.9: the original multiplies, MuJoCo takes the larger
SOLREF = (0.005, 1)
SOLIMP = (0.95, 0.99, 0.001)
PARKED = -60.0  # m; z of unused boxes


class Look(NamedTuple):
    """Colours of a scene: red, green, blue in [0, 1].

    Attributes:
      ground: light and dark squares.
      sky: above, and at the horizon.
      light: light of the camera's lamp, which adds to the sun that follows each character.
    """

    ground: tuple[Colour, Colour]
    sky: tuple[Colour, Colour]
    light: Colour


OLIVE = Look(
    ((0.47, 0.52, 0.44), (0.42, 0.47, 0.40)), ((0.62, 0.76, 0.92), (0.95, 0.97, 1.0)),
    (0.45, 0.45, 0.45),
)  # fmt: skip
LOOKS = {  # by family; combinations of users are olive
    'imitation': Look(  # a studio
        ((0.66, 0.68, 0.71), (0.60, 0.62, 0.65)), ((0.80, 0.84, 0.89), (0.97, 0.97, 0.98)),
        (0.42, 0.43, 0.46),
    ),
    'plaid': Look(  # limestone at noon
        ((0.82, 0.78, 0.69), (0.75, 0.71, 0.62)), ((0.45, 0.67, 0.90), (0.93, 0.95, 0.96)),
        (0.48, 0.45, 0.40),
    ),
    'terrainrl': Look(  # dry grass
        ((0.70, 0.72, 0.50), (0.64, 0.66, 0.45)), ((0.52, 0.74, 0.93), (0.94, 0.97, 0.99)),
        (0.45, 0.46, 0.42),
    ),
    'deeploco': Look(  # pale stone in the evening
        ((0.64, 0.63, 0.58), (0.58, 0.57, 0.53)), ((0.55, 0.63, 0.82), (0.99, 0.89, 0.78)),
        (0.47, 0.43, 0.40),
    ),
}  # fmt: skip


def prepare(root: mjcf.RootElement, look: Look = OLIVE) -> None:
    """Sets the options of the physics, and adds sky and light."""
    # composer's arena sets an elliptic cone and noslip iterations; neither is wanted.
    root.option.cone = 'pyramidal'
    root.option.noslip_iterations = 0
    root.option.integrator = 'implicitfast'
    root.option.gravity = (0, 0, -9.8)
    root.compiler.boundmass = 0
    root.compiler.boundinertia = 0
    _decorate(root, look)


def _decorate(root: mjcf.RootElement, look: Look) -> None:
    """Adds sky and light (the sun follows each character).

    They cost so little that one model is used for both physics and rendering.
    """
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
    root.asset.add(
        'texture', name='sky', type='skybox', builtin='gradient', rgb1=look.sky[0],
        rgb2=look.sky[1], width=64, height=64,
    )  # fmt: skip


def paint(
    root: mjcf.RootElement, name: str, colours: tuple[Colour, Colour], repeat: int = 1, **more: Any
) -> None:
    """Adds a checkered texture, and its material; `more` are attributes of the texture."""
    root.asset.add(
        'texture', name=name, type='2d', builtin='checker', width=256, height=256,
        rgb1=colours[0], rgb2=colours[1], **more,
    )  # fmt: skip
    root.asset.add(
        'material', name=name, texture=name, texuniform=True, reflectance=0, specular=0,
        texrepeat=(repeat, repeat),
    )  # fmt: skip
