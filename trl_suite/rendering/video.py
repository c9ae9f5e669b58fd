"""Videos written frame by frame, without OpenGL; needs `pip install 'trl_suite[video]'`.

`trl_suite.rendering` also exports these names. A file gets its name only when it is complete.
"""

from __future__ import annotations

import contextlib
import math
import subprocess
from collections.abc import Iterable
from types import TracebackType
from typing import Any

import numpy as np
import tqdm

from trl_suite.util import interrupts
from trl_suite.util.files import Path, check_path, replacing
from trl_suite.util.libraries import library
from trl_suite.util.options import checked

CONTROL_FPS = 30.0  # one frame per control step of 1/30 s plays in real time
VIDEO_SUFFIXES = ('.mp4', '.gif')


def video(frames: Iterable[np.ndarray], path: Path, fps: float = CONTROL_FPS) -> None:
    """Writes frames as a video; equivalent to `Video`, in one call.

    Args:
      frames: pictures (h, w, 3) uint8, all of one size; may be a generator such as
        `rendering.frames`. Their number is shown while writing takes longer than 1 s.
      path: file to write; .mp4 (h264) or .gif.
      fps: frames per second; 30 is real time. In a .gif each frame lasts a multiple of 1/100 s.

    Raises:
      ValueError: another suffix, no pictures, pictures of different sizes, or an odd size for h264.
    """
    with Video(path, fps) as writer:
        # disable=None: no bar where stderr is not a terminal; a notebook always has one.
        for image in tqdm.tqdm(frames, unit='picture', delay=1, disable=None):
            writer.add(image)


class Video:
    """A video to which frames are added one by one; an .mp4 keeps none of them in memory.

    Used as a context manager; the file is created at the end, and not after an exception.
    Arguments and errors are those of `video`.
    """

    _encoder: subprocess.Popen[bytes] | None = None

    def __init__(self, path: Path, fps: float = CONTROL_FPS) -> None:
        self._path = check_path(path, VIDEO_SUFFIXES).absolute()
        self._images: list[Any] = []  # of a .gif, whose frames last at least 0.01 s
        self._h264 = self._path.suffix.lower() == '.mp4'
        self._fps = checked('fps', fps, float, above=0, at_most=math.inf if self._h264 else 100)
        module = 'imageio_ffmpeg' if self._h264 else 'PIL.Image'
        self._library = library(module, 'trl_suite[video]')
        self._shape: tuple[int, ...] | None = None
        self._files = contextlib.ExitStack()

    def __enter__(self) -> Video:
        self._part = self._files.enter_context(replacing(self._path))
        return self

    def add(self, image: np.ndarray) -> None:
        """Adds a picture, shape (h, w, 3), uint8."""
        image = check_image(image)
        if self._shape is None:
            self._shape = image.shape
            if self._h264 and (image.shape[0] % 2 or image.shape[1] % 2):
                raise ValueError(
                    f'{self._path}: frames are {image.shape[1]}x{image.shape[0]} pixels; h264 needs '
                    'even numbers'
                )
        elif image.shape != self._shape:
            raise ValueError(
                f'{self._path}: a frame has shape {image.shape}, those before it {self._shape}'
            )
        if not self._h264:
            self._images.append(self._library.fromarray(image))
            return
        if self._encoder is None:
            self._start(*image.shape[:2])
        assert self._encoder is not None
        assert self._encoder.stdin is not None
        try:
            self._encoder.stdin.write(np.ascontiguousarray(image).data)
        except OSError:
            raise self._failure(self._encoder) from None

    def _start(self, height: int, width: int) -> None:
        """Starts ffmpeg, whose exit status tells whether all was written; imageio ignores it."""
        source = f'-f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {self._fps} -i -'
        options = f'-y -loglevel error {source} -c:v libx264 -pix_fmt yuv420p -crf 15'.split()
        # After file: a name with a colon is no address.
        command = [self._library.get_ffmpeg_exe(), *options, f'file:{self._part}']
        # An interrupt between the start and the return would leave an encoder that nobody ends, and
        # that creates the file after it was removed.
        with interrupts.postponed():
            self._encoder = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                start_new_session=True,  # an interrupt from the keyboard is for this process alone
            )

    def _failure(self, encoder: subprocess.Popen[bytes]) -> OSError:
        """Returns why the encoder ended, which it must have done."""
        assert encoder.stderr is not None
        lines = encoder.stderr.read().decode(errors='replace').split('\n')
        said = next((line.strip() for line in reversed(lines) if line.strip()), '')
        return OSError(
            f'{self._path}: the encoder failed: {said or f"exit status {encoder.wait()}"}'
        )

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        try:
            if kind is None:
                self._finish()
        except BaseException as failure:
            kind, error, traceback = type(failure), failure, failure.__traceback__
            raise
        finally:
            if self._encoder is not None:
                self._encoder.kill()  # no effect if it has ended
                with contextlib.suppress(OSError, ValueError):
                    self._encoder.communicate()
            self._files.__exit__(kind, error, traceback)  # removes the part after an exception

    def _finish(self) -> None:
        if self._shape is None:
            raise ValueError(f'{self._path}: no frames were given')
        if self._encoder is None:
            first, *others = self._images
            first.save(
                self._part, save_all=True, append_images=others, duration=1000 / self._fps, loop=0
            )
            return
        assert self._encoder.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._encoder.stdin.close()
        failure = self._failure(self._encoder)
        if self._encoder.wait():
            raise failure


def check_image(image: np.ndarray) -> np.ndarray:
    """Returns a picture (h, w, 3) uint8; raises a ValueError for anything else."""
    image = np.asarray(image)
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
        raise ValueError(
            f'a frame has shape {image.shape} and type {image.dtype}; expected (h, w, 3) of uint8'
        )
    return image
