"""Pictures made without OpenGL: film strips and plots of terrain.

`trl_suite.rendering` also exports these names. A file appears under its name only when it is
complete. PNG files and plots need `pip install 'trl_suite[video]'`.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import tqdm

from trl_suite import terrain as terrains
from trl_suite.rendering.video import check_image
from trl_suite.util.files import Path, check_path, replacing
from trl_suite.util.libraries import library
from trl_suite.util.options import checked

STRIP_MARGIN = 4  # pixels of white between the pictures of a film strip
MAX_SPAN = 300.0  # m; of a plot of three-dimensional terrain
MOST_DRAWS = 100  # in one plot
MAP_POINTS = 400  # largest number of points along each axis of such a plot
IMAGE_SUFFIXES = ('.png',)
REPLAY_SUFFIXES = ('.html',)


def film_strip(
    frames: Iterable[np.ndarray], path: Path | None = None, columns: int = 8
) -> np.ndarray:
    """Puts evenly spaced frames side by side, including the first and the last.

    Args:
      frames: pictures (h, w, 3) uint8, all of one size.
      path: .png file to write; None for none.
      columns: number of pictures; all of them if there are fewer.

    Returns:
      The strip, shape (h, about columns * w, 3), uint8.

    Raises:
      ValueError: no pictures, pictures of different sizes, columns below 1, or another suffix.
    """
    columns = checked('columns', columns, int, at_least=1)
    target = None if path is None else check_path(path, IMAGE_SUFFIXES)
    images = [check_image(image) for image in frames]
    if not images:
        raise ValueError('a film strip needs at least one frame')
    if len({image.shape for image in images}) > 1:
        raise ValueError('the frames of a film strip must all have the same size')
    chosen = spread(len(images), columns)
    margin = np.full((len(images[0]), STRIP_MARGIN, 3), 255, np.uint8)
    parts = [part for i in chosen for part in (margin, images[i])]
    strip = np.concatenate(parts[1:], axis=1)
    if target is not None:
        picture = library('PIL.Image', 'trl_suite[video]').fromarray(strip)
        with replacing(target) as part:
            picture.save(part)
    return strip


def spread(count: int, chosen: int) -> list[int]:
    """Returns up to `chosen` indices below `count`, evenly spaced, including first and last."""
    if chosen == 1:
        return [0]
    return sorted(set(np.linspace(0, count - 1, min(chosen, count)).round().astype(int).tolist()))


def plot_terrain(
    terrain: Any,
    path: Path,
    draws: int = 3,
    length: float = 40.0,
    seed: int = 0,
    terrain_level: float = 0.0,
) -> None:
    """Plots several random grounds of a terrain: profiles below each other, or maps side by side.

    Maps of three-dimensional terrain have x to the right and y up; an arrow marks a start.

    Args:
      terrain: an argument of `trl_suite.terrain.load`.
      path: file to write; .png.
      draws: number of grounds.
      length: extent ahead of the start, m; for a map its side, at most 300 m, around the origin.
      seed: ground i has the seed sequence (seed, i).
      terrain_level: index of the terrain's parameter set.

    Raises:
      ValueError: invalid arguments; see also `trl_suite.terrain.load`.
    """
    terrain = terrains.load(terrain)
    target = check_path(path, IMAGE_SUFFIXES)
    draws = checked('draws', draws, int, at_least=1, at_most=MOST_DRAWS)
    longest = MAX_SPAN if terrain.spatial else 10_000.0
    checked('length', length, float, 'm', above=0, at_most=longest)
    seed = checked('seed', seed, int, at_least=0)
    # `Figure` needs no display and does not affect the user's pyplot.
    make = library('matplotlib.figure', 'trl_suite[video]').Figure
    if terrain.spatial:
        figure = make(figsize=(1.6 + 3.6 * draws, 4.0), layout='constrained')
        _plot_maps(figure, terrain, draws, length, seed, terrain_level)
    else:
        figure = make(figsize=(10, 0.8 + 1.3 * draws), layout='constrained')
        _plot_profiles(figure, terrain, draws, length, seed, terrain_level)
    with replacing(target) as part:
        figure.savefig(part, dpi=100)


def _plot_profiles(
    figure: Any,
    terrain: terrains.Terrain,
    draws: int,
    length: float,
    seed: int,
    terrain_level: float,
) -> None:
    # Panels that share axes take time that grows with the square of their number.
    panels = figure.subplots(draws, 1, squeeze=False)[:, 0]
    first = round(-2 / terrains.SPACING)
    count = round(length / terrains.SPACING) - first + 1
    x = (first + np.arange(count)) * terrains.SPACING
    grounds = []
    for i in range(draws):
        strip = terrains.PlanarGround(
            terrain, np.random.SeedSequence((seed, i)), terrain_level=terrain_level
        )
        grounds.append(strip.window(first, count)[0])
    low, high = min(map(np.min, grounds)), max(map(np.max, grounds))
    room = 0.15 * max(high - low, 1.0)
    for panel, heights in zip(panels, grounds, strict=True):
        panel.fill_between(x, heights, low - room, color='0.75', linewidth=0)
        panel.plot(x, heights, color='0.2', linewidth=1)
        panel.axvline(0, color='tab:red', linewidth=0.8, linestyle=':')  # start of episodes
        panel.set(xlim=(x[0], x[-1]), ylim=(low - room, high + room), ylabel='z (m)')
        panel.tick_params(labelbottom=panel is panels[-1])
    panels[0].set_title(f'{terrain.name} ({terrain.type})')
    panels[-1].set_xlabel('x (m)')


def _plot_maps(
    figure: Any,
    terrain: terrains.Terrain,
    draws: int,
    length: float,
    seed: int,
    terrain_level: float,
) -> None:
    panels = figure.subplots(1, draws, squeeze=False)[0]
    count = min(MAP_POINTS, max(2, round(length / (0.25 * terrains.GRID))))
    # Centres of pixels.
    places = ((np.arange(count) + 0.5) / count - 0.5) * length
    maps, starts = [], []
    for i in tqdm.tqdm(range(draws), unit='map', delay=1, disable=None):
        sequence = np.random.SeedSequence((seed, i))
        ground = terrains.SpatialGround(terrain, sequence, terrain_level=terrain_level)
        starts.append(ground.spawn(np.random.default_rng(sequence)))
        # Line by line, as each line intersects few of the boxes.
        heights = np.stack([ground.height(places, y) for y in places])
        heights[~np.isfinite(heights)] = np.nan  # where there is no ground
        maps.append(heights)
    low, high = float(np.nanmin(maps)), float(np.nanmax(maps))
    if low == high:
        low, high = low - 0.5, high + 0.5
    half = 0.5 * length
    extent, scale = (-half, half, -half, half), {'vmin': low, 'vmax': high, 'cmap': 'viridis'}
    for panel, heights, (x, y, heading) in zip(panels, maps, starts, strict=True):
        image = panel.imshow(
            heights, origin='lower', extent=extent, interpolation='nearest', **scale
        )
        panel.annotate(
            '',
            xytext=(x, y),
            xy=(x + 0.06 * length * np.cos(heading), y + 0.06 * length * np.sin(heading)),
            arrowprops={'arrowstyle': '->', 'color': 'tab:red', 'linewidth': 1.5},
        )
        panel.set_xlabel('x (m)')
        panel.tick_params(labelleft=panel is panels[0])
    panels[0].set_ylabel('y (m)')
    figure.suptitle(f'{terrain.name} ({terrain.type})')
    figure.colorbar(image, ax=list(panels), label='z (m)')
