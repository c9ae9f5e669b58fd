"""Locomotion environments over random terrain: Terrain RL Simulator on MuJoCo and dm_control.

from trl_suite import suite

environment = suite.make('PD_Biped2D_Gaps_Terrain-v0', task_kwargs={'random': 1})
time_step = environment.reset()
"""

import contextlib
import ctypes
import ctypes.util
import importlib
import os
import sys
from typing import Any


def _egl_devices() -> int:
    """Returns the number of devices on which EGL could render: 0 without the library, or a driver."""
    library = ctypes.util.find_library('EGL')
    try:
        find = ctypes.CDLL(library).eglGetProcAddress if library else None
    except (OSError, AttributeError):
        find = None
    if find is None:
        return 0
    find.restype, find.argtypes = ctypes.c_void_p, [ctypes.c_char_p]
    if (address := find(b'eglQueryDevicesEXT')) is None:
        return 0
    count = ctypes.c_int32()
    query = ctypes.CFUNCTYPE(ctypes.c_uint, ctypes.c_int32, ctypes.c_void_p, ctypes.c_void_p)
    return count.value if query(address)(0, None, ctypes.byref(count)) else 0


if (
    sys.platform == 'linux'
    and not os.environ.get('MUJOCO_GL')
    and not (os.environ.get('DISPLAY') or os.environ.get('WAYLAND_DISPLAY'))
    and os.environ.get('PYOPENGL_PLATFORM', 'egl') == 'egl'
    and _egl_devices()  # without one, as in a container without a driver, importing dm_control would fail
):
    # dm_control would choose GLFW, which cannot render without a display. This creates no context.
    os.environ['MUJOCO_GL'] = 'egl'

if os.environ.get('MUJOCO_GL') == 'egl' and 'OpenGL' not in sys.modules:
    # PyTorch for CUDA imports Triton at its first optimizer. This ends the process if dm_control has
    # loaded Mesa before, by OpenGL, which has another LLVM; the other order works.
    with contextlib.suppress(Exception):  # of a broken Triton PyTorch complains
        importlib.import_module('triton')

__version__ = '0.1.0'

_FROM_SUITE = (
    'ALL_IDS', 'ALL_TASKS', 'BENCHMARKING', 'TASKS_BY_DOMAIN', 'build', 'load', 'make',
    'reference_policy',
)  # fmt: skip
__all__ = ['suite', *_FROM_SUITE]


def __getattr__(name: str) -> Any:
    # Imported on first use: `import trl_suite` stays fast, and terrain and motion do not import
    # MuJoCo.
    if name in _FROM_SUITE:
        return getattr(importlib.import_module('trl_suite.suite'), name)
    if name == 'suite':
        return importlib.import_module('trl_suite.suite')
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
