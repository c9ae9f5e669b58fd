"""What all arenas have in common: solver options, contact of the ground, sky and light."""

from __future__ import annotations

from dm_control import mjcf

FRICTION = (0.81, 0.005, 0.0001)  # 0.9 * 0.9: the original multiplies, MuJoCo takes the larger
SOLREF = (0.005, 1)
SOLIMP = (0.95, 0.99, 0.001)
PARKED = -60.0  # m; depth at which unused boxes lie


def prepare(root: mjcf.RootElement) -> None:
    """Sets the options of the physics and decorates the stage."""
    # composer's arena brings an elliptic cone and noslip iterations; neither is wanted.
    root.option.cone = 'pyramidal'
    root.option.noslip_iterations = 0
    root.option.integrator = 'implicitfast'
    root.option.gravity = (0, 0, -9.8)
    root.compiler.boundmass = 0
    root.compiler.boundinertia = 0
    _decorate(root)


def _decorate(root: mjcf.RootElement) -> None:
    """Sky and ground (the sun follows each character), cheap enough that one model serves pictures and physics."""
    root.visual.quality.shadowsize = 2048
    root.visual.quality.offsamples = 0
    getattr(root.visual, 'global').offwidth = 1920
    getattr(root.visual, 'global').offheight = 1080
    root.statistic.extent = 3  # m; of what is looked at, not of the ground: shadows stay sharp
    # In extents. Ground farther off than shadows reach is speckled; the horizon is drawn to.
    root.visual.map.shadowclip = 8
    root.visual.map.znear, root.visual.map.zfar = 0.01, 400
    root.visual.headlight.set_attributes(
        ambient=(0.35, 0.35, 0.35), diffuse=(0.45, 0.45, 0.45), specular=(0.1, 0.1, 0.1)
    )
    root.asset.add(
        'texture', name='sky', type='skybox', builtin='gradient', rgb1=(0.62, 0.76, 0.92),
        rgb2=(0.95, 0.97, 1.0), width=64, height=64,
    )  # fmt: skip
