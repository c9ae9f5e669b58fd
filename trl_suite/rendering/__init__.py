"""Pictures without a screen: frames, videos, film strips, plots of terrain, height maps."""

from trl_suite.rendering.drawing import Policy, frame, frames, markers, no_gl, watching
from trl_suite.rendering.pictures import (
    CONTROL_FPS,
    IMAGE_SUFFIXES,
    STRIP_MARGIN,
    VIDEO_SUFFIXES,
    Video,
    film_strip,
    height_map,
    plot_terrain,
    spread,
    video,
)

__all__ = [
    'CONTROL_FPS',
    'IMAGE_SUFFIXES',
    'STRIP_MARGIN',
    'VIDEO_SUFFIXES',
    'Policy',
    'Video',
    'film_strip',
    'frame',
    'frames',
    'height_map',
    'markers',
    'no_gl',
    'plot_terrain',
    'spread',
    'video',
    'watching',
]  # fmt: skip
