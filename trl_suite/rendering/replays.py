"""Replays: episodes as one HTML file with an orbit camera, which loads nothing from other hosts.

The file is a recording made by viser: its client, which `trl-suite view --browser` uses as well,
and the messages that it was sent.
"""

from __future__ import annotations

import html
from types import TracebackType
from typing import TYPE_CHECKING, Any

from trl_suite.rendering import overlays, web_scene, web_server
from trl_suite.rendering.pictures import REPLAY_SUFFIXES
from trl_suite.util.files import Path, check_path, write_text
from trl_suite.util.options import checked

if TYPE_CHECKING:
    from dm_control import composer


class Replay:
    """A recording of an environment to which states are added one by one.

    Used as a context manager, inside which the environment must not be closed. The file is written at
    the end, and not after an exception. A notebook displays the object as the page.

    Attributes:
      html: the page, once the context has been left.
    """

    def __init__(
        self,
        environment: composer.Environment,
        path: Path | None = None,
        fps: float = 30.0,
        ghost: bool = False,
    ) -> None:
        """Starts a recording.

        Args:
          environment: any composer environment, after `reset`.
          path: file to write, .html; None for none.
          fps: states per second; 30 is real time, as for `rendering.video`.
          ghost: also show the reference clip, as `rendering.frame` does.

        Raises:
          ValueError: another suffix, an fps that is not positive, or a ghost although the task has
            no reference clip.
        """
        self._path = None if path is None else check_path(path, REPLAY_SUFFIXES).absolute()
        checked('fps', fps, float, above=0)
        self._overlays = overlays.of_task(environment.task, ghost)
        web_server.load_viser()
        self._environment, self._seconds = environment, 1 / fps
        self._recording: Any = None
        self.html = ''

    def __enter__(self) -> Replay:
        self._server = web_server.start_server('127.0.0.1', 0)
        try:
            self._scene = web_scene.WebScene(self._server, self._environment)
        except BaseException:
            self._server.stop()
            raise
        return self

    def add(self, jump: bool = False) -> None:
        """Adds the current state.

        Args:
          jump: whether the camera moves to the character at once, as at the start of an episode,
            instead of following it smoothly.
        """
        if self._recording is not None:
            self._recording.insert_sleep(self._seconds)
        self._scene.update(self._overlays, jump=jump)
        if self._recording is None:  # the recording begins with the whole scene
            self._recording = self._server.get_scene_serializer()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if kind is None and self._recording is None:
                raise ValueError('the replay has no states')
            if kind is None:
                self._recording.insert_sleep(self._seconds)
                self.html = self._recording.as_html().replace('<title>Viser<', '<title>Replay<', 1)
                if self._path is not None:
                    write_text(self.html, self._path)
        finally:
            web_server.stop_server(self._server)

    def _repr_html_(self) -> str:
        return (
            f'<iframe srcdoc="{html.escape(self.html)}" width="100%" height="400" '
            'style="border: none"></iframe>'
        )
