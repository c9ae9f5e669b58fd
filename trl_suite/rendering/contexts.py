"""OpenGL contexts that move between threads, in place of those of dm_control.

dm_control leaves a context current in the thread that used it last, where no other thread can use
or free it. These are current only while they are used.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import importlib
import os
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any

from dm_control import _render
from dm_control._render import base, executor
from dm_control._render.base import _CURRENT_CONTEXT_FOR_THREAD, _CURRENT_THREAD_FOR_CONTEXT

from trl_suite.rendering.drawing import has_display, no_gl

# What makes no context current, by class of dm_control; the argument is its module.
_RELEASES: dict[str, Callable[[Any], object]] = {
    'EGLContext': lambda egl: egl.EGL.eglMakeCurrent(
        egl.EGL_DISPLAY, egl.EGL.EGL_NO_SURFACE, egl.EGL.EGL_NO_SURFACE, egl.EGL.EGL_NO_CONTEXT
    ),
    'GLFWContext': lambda glfw: glfw.glfw.make_context_current(None),
    'OSMesaContext': lambda mesa: mesa.osmesa.OSMesaMakeCurrent(None, None, mesa.GL.GL_FLOAT, 0, 0),
}
_current = threading.local()  # .make makes the context current again that this thread uses
_making = threading.RLock()  # GLFW makes and frees contexts in one thread at a time
_owner: int | None = None  # id of the process that has rendered; a forked child has another id


def install() -> None:
    """Makes dm_control use these contexts from its next one on."""
    if not isinstance(_render.Renderer, functools.partial):
        _render.Renderer = functools.partial(_make, _render.Renderer)


def _forked() -> bool:
    """Whether this process was forked from one that has rendered."""
    return _owner not in (None, os.getpid())


def _check_process() -> None:
    if _forked():
        raise RuntimeError(
            'cannot render after a fork: the OpenGL context belongs to the parent process, which has '
            "rendered. Render there, or use multiprocessing's start method 'spawn'"
        )


def _make(kind: Any, max_width: int, max_height: int) -> Any:
    """Makes a context of a class of dm_control, or of the library that MUJOCO_GL now names.

    dm_control reads the variable when it is imported. If it is imported before this package, as
    with sorted imports, it chooses GLFW, even if there is no display. MuJoCo must not try that: its
    next attempt would end the process, whatever the library.
    """
    global _owner
    _check_process()
    try:
        if _render.BACKEND == 'glfw' and not has_display():
            name = os.environ.get('MUJOCO_GL')
            if name not in ('egl', 'osmesa'):
                raise RuntimeError('GLFW finds no display')
            module = importlib.import_module(f'dm_control._render.pyopengl.{name}_renderer')
            kind = module.EGLContext if name == 'egl' else module.OSMesaContext
        made = _moving(kind)(max_width, max_height)
    # Errors depend on the library: ImportError, AttributeError, GLError.
    except Exception as error:
        raise RuntimeError(no_gl(error)) from error
    _owner = os.getpid()
    return made


@functools.cache
def _moving(kind: Any) -> Any:
    if kind.__name__ not in _RELEASES:
        return kind  # raises an error: rendering is disabled
    module = sys.modules[kind.__module__]
    if kind.__name__ == 'EGLContext':
        # It would wait in a forked child, at the end, for threads that only the parent has.
        terminate = functools.partial(atexit.unregister, module.EGL.eglTerminate)
        os.register_at_fork(after_in_child=terminate)
    release = functools.partial(_RELEASES[kind.__name__], module)
    return type(kind.__name__, (_Moving, kind), {'_release': staticmethod(release)})


class _Moving(base.ContextBase):
    """A context that is current in a thread only while it is used there."""

    _context: Any = None
    _patients: Any = ()  # if the context is freed because it could not be made
    _release: Callable[[], object]

    def __init__(self, max_width: int, max_height: int) -> None:
        with _making:
            base.ContextBase.__init__(
                self, max_width, max_height, executor.PassthroughRenderExecutor
            )
        if not self._context:
            raise RuntimeError(f'{type(self).__name__} cannot be made')

    @property
    def terminated(self) -> bool:
        return _forked() or super().terminated

    @contextlib.contextmanager
    def make_current(self) -> Iterator[Any]:
        _check_process()
        with self._render_executor.execution_context() as calls, self._in_use():
            try:
                yield calls
            except BaseException as error:
                if self._refcount:
                    raise
                # MuJoCo's part could not be made. Its destructor needs a terminated context.
                self._free_unconditionally()
                if isinstance(error, Exception):
                    raise RuntimeError(no_gl(error)) from error
                raise

    def _free_unconditionally(self) -> None:
        if not self.terminated:
            super()._free_unconditionally()

    def _free_on_executor_thread(self) -> None:
        with _making, self._in_use():
            super()._free_on_executor_thread()

    @contextlib.contextmanager
    def _in_use(self) -> Iterator[None]:
        # Garbage collection may free this context while another one is in use.
        outer = getattr(_current, 'make', None)
        _current.make = self._platform_make_current
        # One that dm_control left current here has to be made current again before its next use.
        left = _CURRENT_CONTEXT_FOR_THREAD.pop(threading.current_thread(), None)
        _CURRENT_THREAD_FOR_CONTEXT.pop(left, None)
        try:
            self._platform_make_current()
            yield
        finally:
            _current.make = outer
            (outer or self._release)()
