"""Rendering without a display: frames, videos, film strips, plots of terrain.

Whatever writes a file raises an ImportError if the extra that it needs is not installed, 'video' or
for replays 'viewer', and an OSError if the file cannot be written.
"""

from trl_suite.rendering.drawing import (
    Policy,
    calling_each_frame,
    check_gl,
    check_options,
    frame,
    frames,
    has_display,
    no_gl,
    played,
    replay,
)
from trl_suite.rendering.pictures import (
    IMAGE_SUFFIXES,
    REPLAY_SUFFIXES,
    STRIP_MARGIN,
    film_strip,
    plot_terrain,
    spread,
)
from trl_suite.rendering.video import CONTROL_FPS, VIDEO_SUFFIXES, Video, video

__all__ = [
    'CONTROL_FPS',
    'IMAGE_SUFFIXES',
    'REPLAY_SUFFIXES',
    'STRIP_MARGIN',
    'VIDEO_SUFFIXES',
    'Policy',
    'Video',
    'calling_each_frame',
    'check_gl',
    'check_options',
    'film_strip',
    'frame',
    'frames',
    'has_display',
    'no_gl',
    'played',
    'plot_terrain',
    'replay',
    'spread',
    'video',
]
