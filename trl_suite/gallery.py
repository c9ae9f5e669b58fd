"""Re-makes all pictures: terrain and film strip of every environment, and every character.

    trl-suite gallery --output gallery --only '*Dog2D*'

Files: FOLDER/environments/ID.terrain.png and ID.strip.jpg (terrain in three dimensions is a .jpg),
FOLDER/characters/NAME.jpg; at most about 40 kB each. What is there stays, unless asked otherwise.
"""

from __future__ import annotations

import dataclasses
import fnmatch
import functools
import io
import itertools
import pathlib
import tempfile
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import tqdm

from trl_suite import acting, catalogue, characters, files, motion, rendering, suite
from trl_suite import terrain as terrains
from trl_suite.environment import Environment
from trl_suite.mannequin import Mannequin

LARGEST = 40_000  # bytes of a picture
QUALITIES = (85, 75, 65, 55, 45, 35)  # of JPEG, until it is small enough
COLOURS = 64  # of a palette
SEED = 1  # of every environment
SECONDS, LONGER = 4.0, 12.0  # that a film strip covers, or until its episode ends; of plans
COLUMNS = 6  # pictures of a film strip
STRIP_SIZE = (180, 240)  # height and width of each, pixels
CHARACTER_SIZE = (360, 480)
TERRAIN_LENGTH = {False: 24.0, True: 60.0}  # m; in the plane, in space
TERRAIN_DRAWS = 2
FRAME = 1 / 30  # s between two moments that could be drawn


@dataclasses.dataclass(frozen=True)
class Item:
    """One picture that can be made.

    Attributes:
      path: below the folder, with / between parts.
      draw: returns it, (h, w, 3) uint8.
    """

    path: str
    draw: Callable[[], np.ndarray] = dataclasses.field(repr=False)


def items() -> Iterator[Item]:
    """Yields all pictures of the gallery."""
    for name in characters.CHARACTERS:
        yield Item(f'characters/{name}.jpg', functools.partial(character, name))
    for row in catalogue.ROWS:
        suffix = 'jpg' if terrains.load(row.terrain).spatial else 'png'
        path = f'environments/{row.id}'
        yield Item(f'{path}.terrain.{suffix}', functools.partial(terrain, row.terrain))
        yield Item(f'{path}.strip.jpg', functools.partial(film_strip, row.id))


def make(
    folder: files.Path, only: str = '*', again: bool = False, progress: bool = True
) -> tuple[list[pathlib.Path], dict[str, Exception]]:
    """Makes the pictures that are missing.

    Args:
      folder: where; it is made if need be.
      only: pattern in the manner of a shell, with or without `*` around it, of paths below the folder.
      again: also make those that are there.
      progress: show a bar.

    Returns:
      What was written; and what failed, by path below the folder. One that fails stops no other.

    Raises:
      ValueError: the pattern matches nothing.
      RuntimeError: there is no OpenGL to draw with.
      ImportError: the extra 'video' is not installed.
      OSError: the folder cannot be made.
    """
    folder = pathlib.Path(folder)
    chosen = [item for item in items() if fnmatch.fnmatch(item.path, f'*{only}*')]
    if not chosen:
        raise ValueError(
            f'no picture matches {only!r}; expected a part of an id or the name of a character, as '
            "'Dog2D' or 'characters/raptor'"
        )
    written: list[pathlib.Path] = []
    failed: dict[str, Exception] = {}
    with tqdm.tqdm(chosen, unit='picture', disable=None if progress else True) as bar:
        for item in bar:
            path = folder / item.path
            if path.exists() and not again:
                continue
            bar.set_description(path.name)
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                save(item.draw(), path)
                written.append(path)
            except (ValueError, OSError) as error:
                failed[item.path] = error
    return written, failed


def character(name: str) -> np.ndarray:
    """Draws a character: in the first pose of its clip if it has one, else standing straight."""
    figure = Mannequin(name)
    if name in suite.DEFAULT_CLIPS:
        figure.put(motion.load(suite.DEFAULT_CLIPS[name]).pose(0.0))
    height, width = CHARACTER_SIZE
    return figure.picture(height=height, width=width, camera='front')


def terrain(terrain: Any) -> np.ndarray:
    """Plots a terrain; see `rendering.plot_terrain`."""
    from PIL import Image

    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / 'terrain.png'
        loaded = terrains.load(terrain)
        rendering.plot_terrain(loaded, path, TERRAIN_DRAWS, TERRAIN_LENGTH[loaded.spatial])
        with Image.open(path) as image:
            return np.asarray(image.convert('RGB'))


def film_strip(id: str) -> np.ndarray:
    """Draws the first seconds of an episode under the best policy there is: see `acting.best`.

    Plans are seen from behind, with what is ahead, unless obstacles would stand in between.
    """
    height, width = STRIP_SIZE
    row = suite.find(id)
    planned, hidden = 'hierarchical' in row.tags, 'obstacles' in terrains.load(row.terrain).type
    camera = 'back' if planned and not hidden else 'side'
    moments: list[int] = []
    images: list[np.ndarray] = []
    _run(id, lambda environment: moments.append(0))  # how many there are until the episode ends
    wanted, number = set(rendering.spread(len(moments), COLUMNS)), itertools.count()

    def look(environment: Environment) -> None:
        if next(number) in wanted:
            images.append(rendering.frame(environment, height, width, camera))

    _run(id, look)
    return rendering.film_strip(images, columns=COLUMNS)


def _run(id: str, look: Callable[[Environment], None]) -> None:
    """Runs the first seconds of an episode, and has `look` called at every moment."""
    environment = suite.make(id, {'random': SEED})
    _, policy = acting.best(environment, id)
    seconds = LONGER if 'hierarchical' in suite.find(id).tags else SECONDS
    count = 0

    def seen() -> None:
        nonlocal count
        count += 1
        look(environment)

    time_step = environment.reset()
    seen()
    with rendering.watching(environment, seen) as watched:
        while count * FRAME < seconds and not time_step.last():
            time_step = environment.step(policy(time_step))
            if not watched:
                seen()
    environment.close()


def save(image: np.ndarray, path: files.Path) -> None:
    """Writes a picture, made small: a .png with a palette, or a .jpg as good as its size allows.

    Args:
      image: (h, w, 3) uint8.
      path: where to.

    Raises:
      ValueError: another suffix.
      OSError: the file cannot be written.
    """
    from PIL import Image

    path = files.check_path(path, ('.png', '.jpg'))
    picture, content = Image.fromarray(image), io.BytesIO()
    if path.suffix == '.png':
        picture.quantize(COLOURS).save(content, 'png', optimize=True)
    else:
        for quality in QUALITIES:
            content = io.BytesIO()
            picture.save(content, 'jpeg', quality=quality, optimize=True)
            if content.tell() <= LARGEST:
                break
    with files.replacing(path) as part:
        part.write_bytes(content.getvalue())
