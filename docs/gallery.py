"""The pictures of the documentation, which `generate.py` and the configuration of the site make.

Files in the folder: characters/NAME.jpg; families/NAME.jpg; suite.webp, which are tracked; and
environments/ID.jpg, a film strip; curves/ID.png, for shipped policies; terrains/NAME.png, or .jpg in three
dimensions, which the build of the site makes. Each has at most about 40 kB, except suite.webp and some
maps. The site can have moving/ID.webp, too, 4 s of each environment.
"""

from __future__ import annotations

import contextlib
import dataclasses
import fnmatch
import functools
import hashlib
import io
import itertools
import pathlib
import tempfile
from collections.abc import Callable, Iterator
from typing import Any

import moving
import numpy as np
import tqdm

from trl_suite import characters, motion, policies, rendering, suite
from trl_suite import terrain as terrains
from trl_suite.arenas.scene import LOOKS
from trl_suite.environments import named_policies as acting
from trl_suite.environments.environment import Environment
from trl_suite.registry import catalogue
from trl_suite.registry.build import task_type
from trl_suite.rendering.kinematic_viewer import KinematicViewer
from trl_suite.util import files, resources
from trl_suite.util.digest import digest

BUILT = 'curves', 'environments', 'terrains'  # folders that only the site has
LARGEST = 40_000  # bytes of a picture
QUALITIES = (85, 75, 65, 55, 45, 35)  # of JPEG, tried until the file is small enough
COLOURS = 64  # of a palette
SEED = 1  # of every environment
SECONDS, LONGER = 4.0, 12.0  # duration of a film strip; of one for tasks with plans
# Episodes and times that are typical of an environment, if its first seconds are not: seed, begin
# and end in s, camera.
SCENES = {
    'PD_Biped3D_HLC_Soccer-v0': (8, 6.0, 16.0, 'back'),
    'PD_Biped3D_Terrain_Soccer_Hard-v0': (5, 3.0, 8.5, 'back'),
    'PD_Biped3D_HLC_Conveyors-v0': (2, 15.0, 25.0, 'back'),
    'PD_Biped3D_HLC_Conveyors_Wide-v0': (2, 9.0, 18.0, 'back'),
}
COLUMNS = 6  # pictures of a film strip
STRIP_SIZE = (180, 240)  # height and width of each, pixels
CHARACTER_SIZE = (360, 480)
TERRAIN_LENGTH = {False: 24.0, True: 60.0}  # m; planar, three-dimensional
CLOSE_LENGTH = 12.0  # m; for ground with small features
CLOSE = ('var3d_checkers', 'var3d_ramp', 'var3d_stairs')
TERRAIN_DRAWS = 2
# Frames that represent each family and the suite: id and time, s.
FAMILIES = {
    'imitation': ('PD_Raptor2D_LLC_Imitate_Flat-v0', 2.0),
    'plaid': ('PD_Biped2D_Gaps_Terrain-v0', 2.0),
    'terrainrl': ('FSM_Dog2D_Terrain_Gaps-v0', 1.6),
    'deeploco': ('PD_Biped3D_HLC_Soccer-v0', 12.0),
}
SUITE = (
    ('PD_Biped2D_Walls_Terrain-v0', 'PD_Dog2D_Slopes_Mixed_Terrain-v0',
     'FSM_Raptor2D_Terrain_Cliffs-v0'),
    ('FSM_Goat2D_Terrain_Variable_Steps-v0', 'PD_Biped3D_HLC_Forest-v0',
     'PD_Biped3D_HLC_Soccer-v0'),
)  # fmt: skip
SUITE_SIZE, SUITE_SECONDS = (200, 320), 4.0  # pixels of each picture


@dataclasses.dataclass(frozen=True)
class Item:
    """One picture of the gallery.

    Attributes:
      path: path in the folder, with / between parts.
      draw: function that returns the picture, (h, w, 3) uint8, or a sequence of pictures if it is
        animated.
      source: digest of the policy or the record that it shows; '' if it shows neither.
    """

    path: str
    draw: Callable[[], Any] = dataclasses.field(repr=False)
    source: str = ''


def items() -> Iterator[Item]:
    """Yields the still pictures of the gallery, and the animated picture of the suite."""
    draw = functools.partial(moving.side_by_side, SUITE, SUITE_SECONDS, SUITE_SIZE)
    yield Item('suite.webp', draw, ' '.join(_policy_digest(id) for row in SUITE for id in row))
    for name, scene in FAMILIES.items():
        source = _policy_digest(scene[0]) + digest(LOOKS[name])
        yield Item(f'families/{name}.jpg', functools.partial(moment, *scene), source)
    for name in characters.CHARACTERS:
        yield Item(character_path(name), functools.partial(character, name))
    for name in (*terrains.PRESETS, *terrains.PRESETS3D):
        yield Item(terrain_path(name), functools.partial(terrain, name))
    for id in filter(record, catalogue.BY_ID):
        yield Item(curve_path(id), functools.partial(curve, id), _digest(f'{id}.json'))
    for id in catalogue.BY_ID:
        yield Item(strip_path(id), functools.partial(film_strip, id), _policy_digest(id))


def moving_items() -> Iterator[Item]:
    """Yields the animated pictures of all environments."""
    for id in catalogue.BY_ID:
        draw = functools.partial(moving.moving_picture, id)
        yield Item(f'moving/{id}.webp', draw, _policy_digest(id))


def _policy_digest(id: str) -> str:
    """Returns a digest of the policy that is shipped for an environment, '' if none is."""
    if id not in policies.available():
        return ''
    own, preference = _digest(f'{policies.trained_for(id)}.npz'), policies.preference_for(id)
    return f'{own} {preference:g}' if preference else own


def character_path(name: str) -> str:
    """Returns the path in the folder of a character's picture."""
    return f'characters/{name}.jpg'


def terrain_path(name: str) -> str:
    """Returns the path in the folder of a preset's picture."""
    suffix = 'jpg' if terrains.load(name).spatial else 'png'
    return f'terrains/{name.replace("/", "_")}.{suffix}'


def strip_path(id: str) -> str:
    """Returns the path in the folder of an environment's film strip."""
    return f'environments/{id}.jpg'


def curve_path(id: str) -> str:
    """Returns the path in the folder of an environment's learning curve."""
    return f'curves/{id}.png'


def record(name: str) -> dict[str, Any]:
    """Returns a file of trained/ (see its README.md), such as the record of an environment; {} if none."""
    path = resources.directory('trained') / f'{name}.json'
    return files.read_json(path) if path.exists() else {}


def shipped_run(found: dict[str, Any]) -> dict[str, Any]:
    """Returns the run of a training record whose policy is shipped."""
    return next(run for run in found['runs'] if run['seed'] == found['shipped'])


def evaluation(id: str) -> dict[str, Any]:
    """Returns the evaluation of the policy that an environment has, {} if none.

    Of several seeds: in other episodes than those in which one was chosen.
    """
    shared, found = record('shared'), record(id)
    if id in shared:
        return shared[id].get('shipped_again', shared[id]['evaluation'])
    return found.get('shipped_again') or shipped_run(found)['evaluation'] if found else {}


def _digest(name: str) -> str:
    content = (resources.directory('trained') / name).read_bytes()
    return hashlib.sha256(content).hexdigest()[:16]


def make(
    folder: files.Path,
    only: str = '*',
    again: bool = False,
    moves: bool = False,
) -> tuple[list[pathlib.Path], dict[str, Exception]]:
    """Makes the pictures that are missing, or that show a policy that has been replaced.

    Args:
      folder: output folder; created if necessary.
      only: shell-style pattern of paths in the folder, in upper or lower case; `*` is added on both
        sides.
      again: whether to replace existing pictures.
      moves: make the animated pictures of environments instead of the others.

    Returns:
      Paths of written files; and errors by path in the folder. An error does not stop the others.

    Raises:
      ValueError: the pattern matches nothing.
      RuntimeError: no OpenGL library works.
      ImportError: the extra 'video' is not installed.
      OSError: the folder cannot be created.
    """
    folder = pathlib.Path(folder)
    choices = moving_items() if moves else items()
    pattern = f'*{only}*'.lower()
    chosen = [item for item in choices if fnmatch.fnmatchcase(item.path.lower(), pattern)]
    if not chosen:
        raise ValueError(
            f'no picture matches {only!r}; expected a part of an id or the name of a character, as '
            "'Dog2D' or 'characters/raptor'"
        )
    written: list[pathlib.Path] = []
    failed: dict[str, Exception] = {}
    with tqdm.tqdm(chosen, unit='picture', disable=None) as bar:
        for item in bar:
            path = folder / item.path
            if path.exists() and not again and item.source in ('', _source(path)):
                continue
            bar.set_description(path.name)
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                save(item.draw(), path, item.source)
                written.append(path)
            except (ValueError, OSError) as error:
                failed[item.path] = error
    return written, failed


def character(name: str) -> np.ndarray:
    """Renders a character in the first pose of its clip, or standing straight if it has no clip."""
    figure = KinematicViewer(name)
    clip = characters.CHARACTERS[name].clip
    if clip is not None:
        figure.put(motion.load(clip).pose(0.0))
    height, width = CHARACTER_SIZE
    return figure.picture(height=height, width=width, camera='front')


def terrain(terrain: Any) -> np.ndarray:
    """Plots a terrain; see `rendering.plot_terrain`."""
    from PIL import Image

    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / 'terrain.png'
        loaded = terrains.load(terrain)
        rendering.plot_terrain(loaded, path, TERRAIN_DRAWS, terrain_length(loaded))
        with Image.open(path) as image:
            return np.asarray(image.convert('RGB'))


def terrain_length(terrain: terrains.Terrain) -> float:
    """Returns the length of a plot of a terrain, m: ahead, or the side of a map."""
    return CLOSE_LENGTH if terrain.type in CLOSE else TERRAIN_LENGTH[terrain.spatial]


def scene(id: str) -> tuple[int, float, float, str]:
    """Returns what a film strip shows: seed, begin and end (s), camera.

    Tasks with plans are rendered from behind.
    """
    spec = suite.find(id)
    if spec.id in SCENES:
        return SCENES[spec.id]
    if 'hierarchical' not in spec.tags:
        return SEED, 0.0, SECONDS, 'side'
    return SEED, 0.0, LONGER, 'back'


def film_strip(id: str) -> np.ndarray:
    """Renders `scene`, or until the episode ends, with the best policy: `acting.best`."""
    moments: list[int] = []
    _run(id, lambda environment: moments.append(0))  # counts frames until the episode ends
    first = min(round(scene(id)[1] / moving.FRAME), len(moments) - 1)
    spread = rendering.spread(len(moments) - first, COLUMNS)
    images = _draw(id, {first + number for number in spread}, STRIP_SIZE)
    return rendering.film_strip(images, columns=COLUMNS)


def moment(id: str, time: float) -> np.ndarray:
    """Renders one frame of such an episode.

    Args:
      id: id of the environment.
      time: since the start of the episode, s.
    """
    return _draw(id, {round(time / moving.FRAME)}, STRIP_SIZE)[-1]


def _draw(id: str, wanted: set[int], size: tuple[int, int]) -> list[np.ndarray]:
    """Renders the frames `wanted` of an episode, by number; they are moving.FRAME apart."""
    camera = scene(id)[-1]
    images: list[np.ndarray] = []
    number = itertools.count()

    def look(environment: Environment) -> None:
        if next(number) in wanted:
            images.append(rendering.frame(environment, *size, camera))

    _run(id, look)
    return images


def _run(id: str, look: Callable[[Environment], None]) -> None:
    """Runs an episode to the end of the scene, and calls `look` for every frame."""
    seed, _, seconds, _ = scene(id)
    environment = suite.make(id, {'random': seed})
    _, policy = acting.best(environment, id)
    count = 0

    def seen() -> None:
        nonlocal count
        count += 1
        look(environment)

    time_step = environment.reset()
    seen()
    while count * moving.FRAME < seconds and not time_step.last():
        with rendering.calling_each_frame(environment, seen):
            time_step = environment.step(policy(time_step))
    environment.close()


def curve(id: str) -> np.ndarray:
    """Plots the learning curves of all seeds, that of the shipped policy in front."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    found, spec = record(id), suite.find(id)
    if not found:
        raise ValueError(f'no policy is shipped for {id!r}')
    type_ = task_type(spec)
    gait = type_.score == 'distance'
    value = 'distance' if gait else 'normalized_return'
    unit, number = (1e6, 'million') if type_.samples == 'control steps' else (1e3, 'thousand')
    figure = Figure(figsize=(4.2, 2.4), layout='constrained')
    axis = figure.subplots()
    for run in sorted(found['runs'], key=lambda run: run['seed'] == found['shipped']):
        front = run['seed'] == found['shipped']
        axis.plot(
            [point['samples'] / unit for point in run['curve']],
            [point.get(value) for point in run['curve']],
            color='tab:blue' if front else '0.75', linewidth=1.5 if front else 1, marker='.',
            markersize=3,
        )  # fmt: skip
    axis.set(
        xlabel=f'{number} {type_.samples}',
        ylabel='distance (m)' if gait else 'return / maximum',
        xlim=(0, None),
    )
    axis.set_ylim(0, None if gait else 1)
    axis.grid(alpha=0.3)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.array(canvas.buffer_rgba())[..., :3]


def save(image: Any, path: files.Path, source: str = '') -> None:
    """Writes a small picture: a .png with a palette, or a .jpg of the best quality that fits.

    A .jpg of the lowest quality may have more than `LARGEST` bytes.

    Args:
      image: (h, w, 3) uint8; for an animated .webp a sequence of pictures.
      path: file to write.
      source: digest to store in the file, see `Item`.
    """
    from PIL import Image, PngImagePlugin

    path = files.check_path(path, ('.png', '.jpg', *moving.SUFFIXES))
    if path.suffix in moving.SUFFIXES:
        moving.save(image, path, source)
        return
    picture, content = Image.fromarray(image), io.BytesIO()
    if path.suffix == '.png':
        notes = PngImagePlugin.PngInfo()
        notes.add_text('comment', source)
        picture.quantize(COLOURS).save(content, 'png', optimize=True, pnginfo=notes)
    else:
        for quality in QUALITIES:
            content = io.BytesIO()
            picture.save(content, 'jpeg', quality=quality, optimize=True, comment=source)
            if content.tell() <= LARGEST:
                break
    with files.replacing(path) as part:
        part.write_bytes(content.getvalue())


def _source(path: pathlib.Path) -> str:
    """Returns the digest that `save` stored in a file, '' if there is none."""
    from PIL import Image

    with (
        contextlib.suppress(OSError),
        Image.open(path, formats=('PNG', 'JPEG', 'WEBP')) as image,
    ):
        kept = image.info.get('comment') or image.info.get('xmp', '')
        return kept.decode() if isinstance(kept, bytes) else kept
    return ''
