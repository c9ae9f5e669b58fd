"""Locomotion environments over random terrain: Terrain RL Simulator on MuJoCo and dm_control.

from trl_suite import suite

environment = suite.make('PD_Biped2D_Gaps_Terrain-v0', task_kwargs={'random': 1})
time_step = environment.reset()
"""

import contextlib
import ctypes.util
import importlib
import os
import sys
from typing import Any

if (
    sys.platform == 'linux'
    and not os.environ.get('MUJOCO_GL')
    and not (os.environ.get('DISPLAY') or os.environ.get('WAYLAND_DISPLAY'))
    and ctypes.util.find_library('EGL')  # without this library, importing dm_control would fail
):
    # dm_control would choose GLFW, which cannot render without a display. This creates no context.
    os.environ['MUJOCO_GL'] = 'egl'

if os.environ.get('MUJOCO_GL') == 'egl':
    # PyTorch for CUDA imports Triton at its first optimizer. This ends the process if dm_control has
    # loaded Mesa before, which has another LLVM; the other order works.
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
