"""Ground from a user's own function, array, image or mesh: the same in every episode.

    ramp = terrain.from_function(lambda x: 0.1 * np.maximum(x, 0), 'my_ramp')  # planar
    waves = terrain.from_function(waves)  # def waves(x, y): three-dimensional
    hill = terrain.from_image('hill.png', spacing=0.2, low=0.0, high=3.0)
    canyon = terrain.from_mesh('canyon.glb', spacing=0.1, start_span=5.0)
    across = terrain.from_mesh('canyon.glb', line=0.0)  # planar: the section at y = 0

All return a `Terrain`, which can be used wherever a preset can. Episodes start at the origin; with
a `start_span` the ground is shifted at random. Planar ground has a vertex every SPACING,
three-dimensional ground every GRID; finer detail is lost. Beyond an array, the heights of its rim
continue.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import math
import os
import pathlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from trl_suite.terrain import mesh
from trl_suite.terrain.generators import (
    START_SPAN,
    Parameters,
    register3d,
    register_line,
)
from trl_suite.terrain.parameters import Terrain
from trl_suite.terrain.spatial.layout import GRID, Layout
from trl_suite.util import errors
from trl_suite.util.digest import digest
from trl_suite.util.files import check_size, existing
from trl_suite.util.libraries import library
from trl_suite.util.options import checked

FARTHEST = 1e6  # m; of a vertex of a mesh
_FORMATS = {'PNG': '.png', 'TIFF': '.tif .tiff', 'BMP': '.bmp', 'JPEG': '.jpg .jpeg'}  # of Pillow
IMAGES = {suffix: kind for kind, suffixes in _FORMATS.items() for suffix in suffixes.split()}
LARGEST = 1e7  # largest number of vertices of an array, and of pixels of a picture

RIM = 1e-6  # cells by which points may lie beside a mesh, whose numbers are often rounded

HeightFunction = Callable[..., npt.ArrayLike]


@dataclasses.dataclass(frozen=True)
class CustomTerrain(Terrain):
    """A terrain that is pickled as the call that made it, so that other processes can repeat it."""

    recipe: tuple[Any, ...] = dataclasses.field(default=(), compare=False, repr=False)

    @property
    def contents(self) -> tuple[Any, ...]:
        # The type of an array is named by a hash of it.
        source = self.recipe[1][0]
        return self.type, self.parameter_sets, source if callable(source) else None

    def __reduce__(self) -> tuple[Any, ...]:
        return self.recipe


def from_function(
    function: HeightFunction,
    name: str | None = None,
    *,
    start_span: float = 0.0,
    replace: bool = False,
) -> Terrain:
    """Makes terrain from heights as a function of x, or of x and y.

    Args:
      function: x (k,) -> heights (k,), m, of planar ground; or x, y (k, m) -> heights (k, m) of
        three-dimensional ground. It is called with arrays, and must be deterministic. For use in
        other processes it must be importable.
      name: name of the terrain and of its type; by default the function's.
      start_span: episodes start at random from -start_span to start_span, m, along x and, in three
        dimensions, along y: the ground is shifted so that this place is at the origin. In three
        dimensions it is shifted by whole cells.
      replace: whether an existing type of that name may be replaced.

    Raises:
      ValueError: there is no name, or it is taken; or the function does not have one or two
        arguments, or does not return an array of the shape of its arguments.
      TypeError: it is not a function, or fails for arrays.
    """
    if not callable(function):
        raise TypeError(f'a function of x, or of x and y, is needed, not {function!r}')
    _check_span(start_span)
    if name is None:
        name = str(getattr(function, '__name__', 'object'))
        if name == '<lambda>' or not hasattr(function, '__name__'):
            raise ValueError(f'the function {function!r} has no name; pass name=')
    arguments = _arguments(function)
    _check_answer(name, function, arguments)
    _register(name, function, arguments, replace)
    recipe = functools.partial(from_function, start_span=start_span, replace=True), (function, name)
    return CustomTerrain(name, name, ({'StartSpan': start_span},), recipe)


def _check_span(start_span: float) -> None:
    limits = START_SPAN['StartSpan']
    checked('start_span', start_span, float, 'm', at_least=limits.low, at_most=limits.high)


def _arguments(function: HeightFunction) -> int:
    kinds = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    parameters = [p for p in inspect.signature(function).parameters.values() if p.kind in kinds]
    count = sum(p.default is p.empty for p in parameters)
    if count not in (1, 2):
        raise ValueError(
            f'heights are a function of x (planar) or of x and y (three-dimensional); '
            f'{getattr(function, "__name__", function)!r} takes {count} arguments'
        )
    return count


def _check_answer(name: str, function: HeightFunction, arguments: int) -> None:
    """Queries a few heights, so that errors of a function are reported before an episode."""
    shape = (2, 3)[-arguments:]
    try:
        found = np.asarray(function(*[np.zeros(shape)] * arguments))
    except (TypeError, ValueError) as error:
        raise TypeError(
            f'the height function {name!r} failed with an array as its argument: {error}; use '
            'functions of arrays: np.sin instead of math.sin, np.where instead of if'
        ) from error
    if found.shape != shape or found.dtype.kind not in 'fiu':
        raise ValueError(
            f'the height function {name!r} returned {found.dtype} of shape {found.shape} for an '
            f'array of shape {shape}; expected numbers of the same shape'
        )


def _register(name: str, function: Any, arguments: int, replace: bool = True) -> None:
    if arguments == 1:
        register_line(name, function, replace=replace)
        return

    @register3d(name, START_SPAN, replace=replace)
    @functools.wraps(function, updated=())
    def layout(parameters: Parameters, rng: np.random.Generator) -> Layout:
        most = int(parameters['StartSpan'] / GRID + 1e-9)
        p, q = rng.integers(-most, most + 1, 2).tolist()

        def grid(i: np.ndarray, j: np.ndarray) -> np.ndarray:
            x, y = GRID * (i + p), GRID * (j + q)
            return np.asarray(function(*np.meshgrid(x, y, indexing='ij')))

        return Layout(level=None, grid=grid)


def from_heights(
    heights: npt.ArrayLike,
    spacing: float,
    name: str = 'heights',
    *,
    first: tuple[int, int] | int | None = None,
    line: float | None = None,
    start_span: float = 0.0,
) -> Terrain:
    """Makes terrain from an array of heights, with linear interpolation.

    Args:
      heights: m; (k,) along x for planar ground, or (k, m) along x and along y (to the left).
      spacing: distance of neighbouring heights, m.
      name: for messages.
      first: index of the first vertex along each axis, which is at first * spacing; by default the
        middle of the array is at the origin.
      line: y in m of a section through (k, m) heights, within them, which makes the ground planar.
      start_span: as for `from_function`.

    Raises:
      ValueError: heights of another shape, too many, or not finite; a spacing that is not positive.
    """
    heights = errors.floats(f'{name}: heights', heights)
    if heights.ndim not in (1, 2) or min(heights.shape) < 2 or heights.size > LARGEST:
        raise ValueError(
            f'{name}: heights have shape {heights.shape}; expected (k,) or (k, m), 2 or more along '
            f'each axis and no more than {LARGEST:g} in all'
        )
    checked(f'{name}: spacing', spacing, float, 'm', above=0)
    _check_span(start_span)
    if first is None:
        corner = -(np.array(heights.shape) // 2)
    else:
        given = (first,) if errors.is_number(first) else first
        most = {'at_least': -LARGEST, 'at_most': LARGEST}
        corner = np.array(checked(f'{name}: first', given, Sequence[int], **most), int)
    if corner.shape != (heights.ndim,):
        raise ValueError(
            f'{name}: first is {first}; expected a number for each of {heights.ndim} axes'
        )
    if line is not None:
        if heights.ndim == 1:
            raise ValueError(
                f'{name}: heights of shape {heights.shape} are planar already; do not pass line'
            )
        right, left = spacing * (corner[1] + np.array([0, heights.shape[1] - 1]))
        checked(f'{name}: line', line, float, 'm', at_least=right, at_most=left)
        x = spacing * (corner[0] + np.arange(len(heights)))
        heights, corner = _Raster(heights, spacing, corner)(x, line), corner[:1]
    raster = _Raster(heights, spacing, corner)
    # Named by its content, so that the same ground has the same type in every process.
    type_name = f'{name}#{digest((heights, spacing, corner))}'
    _register(type_name, raster if heights.ndim == 2 else raster.along, heights.ndim)
    again = functools.partial(from_heights, first=tuple(corner.tolist()), start_span=start_span)
    return CustomTerrain(
        name, type_name, ({'StartSpan': start_span},), (again, (heights, spacing, name))
    )


@dataclasses.dataclass(frozen=True, eq=False)
class _Raster:
    """Heights (k,) or (k, m) whose first vertex is at corner * spacing."""

    heights: np.ndarray
    spacing: float
    corner: np.ndarray

    def _weights(self, x: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
        last = self.heights.shape[axis] - 1
        u = np.clip(x / self.spacing - self.corner[axis], 0, last)
        i = np.minimum(u.astype(int), last - 1)
        return i, u - i

    def along(self, x: np.ndarray) -> np.ndarray:
        """Heights at x."""
        i, u = self._weights(x, 0)
        return self.heights[i] + u * (self.heights[i + 1] - self.heights[i])

    def __call__(self, x: np.ndarray, y: npt.ArrayLike) -> np.ndarray:
        """Heights at points, by bilinear interpolation."""
        (i, u), (j, v) = self._weights(x, 0), self._weights(np.asarray(y), 1)
        near, far = (
            self.heights[i + k, j] + v * (self.heights[i + k, j + 1] - self.heights[i + k, j])
            for k in (0, 1)
        )
        return near + u * (far - near)


def from_image(
    path: str | os.PathLike[str],
    spacing: float,
    low: float = 0.0,
    high: float = 1.0,
    *,
    line: float | None = None,
    start_span: float = 0.0,
) -> Terrain:
    """Makes terrain from a height image: the brightness of a pixel is its height.

    The image is a map: x points to its right, y up, and the origin is the pixel in its middle.

    Args:
      path: .png, .tif, .bmp or .jpg, of 8 or 16 bits per pixel, in the format of its suffix; of
        colour images the mean of red, green and blue is used, and of animated ones the first frame.
      spacing: between pixels, m.
      low: height of black, m.
      high: height of white, m.
      line: as for `from_heights`.
      start_span: as for `from_function`.

    Raises:
      ValueError: the file is not an image, low or high is invalid, or as `from_heights`.
      FileNotFoundError: there is no such file; the message has similar names.
      ImportError: Pillow is not installed.
    """
    file = existing(path, tuple(IMAGES))
    errors.floats(f'{file}: low and high', [low, high])
    if low == high:
        raise ValueError(f'{file}: black is {low} m and white {high} m; expected two heights')
    pixels = _pixels(file)
    if not np.issubdtype(pixels.dtype, np.integer) and pixels.dtype != bool:
        raise ValueError(f'{file}: pixels are {pixels.dtype}; expected whole numbers')
    full = 1 if pixels.dtype == bool else np.iinfo(pixels.dtype).max
    if pixels.ndim == 3:
        pixels = pixels[..., :3].mean(2) if pixels.shape[2] >= 3 else pixels[..., 0]
    grey = pixels.astype(float)[::-1].T / full  # rows from below, along y
    return from_heights(
        low + (high - low) * grey, spacing, file.stem, line=line, start_span=start_span
    )


def _pixels(file: pathlib.Path) -> np.ndarray:
    """Reads a picture, (h, w) or (h, w, channels), of a checked size."""
    check_size(file)
    image, kind = library('PIL.Image', 'trl_suite[video]'), IMAGES[file.suffix.lower()]
    try:
        # Other formats, which Pillow would recognise by their content, may start other programs.
        with image.open(file, formats=(kind,)) as picture:
            if min(picture.size) < 2 or math.prod(picture.size) > LARGEST:
                raise ValueError(
                    f'{picture.height} x {picture.width} pixels; expected 2 or more along each axis and '
                    f'no more than {LARGEST:g} in all'
                )
            if picture.mode == 'P':
                return np.asarray(picture.convert(picture.palette.mode))
            # Some versions of Pillow widen the 16 bits of a .png; those of a .tif may have a sign.
            widened = kind == 'PNG' and picture.mode == 'I'
            if picture.mode in ('I', 'F') and not widened:
                raise ValueError(
                    f'pixels have mode {picture.mode}, signed, wide or real numbers; expected 8 or 16 bits '
                    'without sign. For elevations in m, read them with another library and use from_heights'
                )
            if picture.mode in ('CMYK', 'YCbCr', 'LAB', 'HSV'):
                return np.asarray(picture.convert('RGB'))
            return np.asarray(picture.convert('I;16') if widened else picture)
    except Exception as error:  # of the reader's own kinds
        raise ValueError(f'{file}: cannot be read as {kind} ({error})') from None


def from_mesh(
    path: str | os.PathLike[str],
    spacing: float = GRID,
    *,
    scale: float = 1.0,
    up: str | None = None,
    centre: bool = False,
    line: float | None = None,
    start_span: float = 0.0,
) -> Terrain:
    """Makes terrain from a mesh: the height at a point is that of the highest triangle there.

    Holes, and gaps between its outline and the rectangle around it, have the height of its lowest point.
    Beyond this rectangle the heights at its rim go on.

    Args:
      path: .obj, .glb, .gltf, .stl or .ply.
      spacing: distance of the points at which heights are sampled, m.
      scale: m per unit of the file, 0.001 for one in millimetres.
      up: the file's axis that points up, 'z' or 'y' (its z axis is then -y of the terrain); by
        default 'y' for .glb and .gltf, as that format requires, and 'z' for the others.
      centre: whether to move the middle of the mesh to the origin; otherwise its origin is kept.
      line: as for `from_heights`.
      start_span: as for `from_function`.

    Raises:
      ValueError: the file is not a mesh, the mesh does not cover the origin, there are too many
        points, or a number is invalid.
      FileNotFoundError: there is no such file; the message has similar names.
    """
    file = existing(path, mesh.READ)
    up = up or ('y' if file.suffix.lower() in mesh.Y_UP else 'z')
    if up not in ('y', 'z'):
        raise ValueError(f"{file}: up is {up!r}; expected 'y' or 'z'")
    checked(f'{file}: spacing', spacing, float, 'm', above=0)
    checked(f'{file}: scale', scale, float, above=0)
    triangles = mesh.read_triangles(file) * scale
    if up == 'y':
        triangles = triangles[..., [0, 2, 1]] * (1, -1, 1)
    low, high = triangles.min((0, 1)), triangles.max((0, 1))
    if max(-low.min(), high.max()) > FARTHEST:
        raise ValueError(
            f'{file}: the mesh reaches {max(-low.min(), high.max()):g} m; expected no more than '
            f'{FARTHEST:g} m from its origin'
        )
    if centre:
        middle = np.append(0.5 * (low + high)[:2], 0.0)
        triangles, low, high = triangles - middle, low - middle, high - middle
    if not ((low[:2] <= 0) & (high[:2] >= 0)).all():
        raise ValueError(
            f'{file}: the mesh lies over x from {low[0]:g} to {high[0]:g} m and y from {low[1]:g} to '
            f'{high[1]:g} m, not over the origin, where characters start; pass centre=True, or move it'
        )
    first = np.ceil(low[:2] / spacing - RIM).astype(int)
    last = np.floor(high[:2] / spacing + RIM).astype(int)
    count = last - first + 1
    if min(count) < 2 or math.prod(count.tolist()) > LARGEST:
        raise ValueError(
            f'{file}: {count[0]} x {count[1]} points lie over the mesh, spacing is {spacing:g} m; '
            f'expected 2 or more along each axis and no more than {LARGEST:g} in all'
        )
    points = (spacing * (first[i] + np.arange(count[i])) for i in (0, 1))
    x, y = (np.clip(at, low[i], high[i]) for i, at in enumerate(points))
    with errors.naming(file):
        heights = mesh.heights_over(triangles, x, y)
    heights[np.isinf(heights)] = low[2]
    corner = int(first[0]), int(first[1])
    return from_heights(heights, spacing, file.stem, first=corner, line=line, start_span=start_span)
