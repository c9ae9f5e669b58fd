"""Ground from a user's own function, array, picture or mesh: the same in every episode.

    ramp = terrain.from_function(lambda x: 0.1 * np.maximum(x, 0), 'my_ramp')  # planar
    waves = terrain.from_function(waves)  # def waves(x, y): three-dimensional
    hill = terrain.from_image('hill.png', spacing=0.2, low=0.0, high=3.0)
    canyon = terrain.from_mesh('canyon.glb', spacing=0.1, start_span=5.0)
    across = terrain.from_mesh('canyon.glb', line=0.0)  # planar: what lies over y = 0

All return a `Terrain`, which goes wherever a preset does. Episodes start at the origin; with a
`start_span` the seed moves the ground under it. Planar ground has a vertex every SPACING,
three-dimensional ground every GRID; finer detail is lost. Beyond an array its rim goes on for ever.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import importlib
import inspect
import math
import os
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from trl_suite.terrain.parameters import Terrain
from trl_suite.terrain.planar.generators import GENERATORS, Parameters, register_line
from trl_suite.terrain.spatial.generators import GENERATORS3D, register3d
from trl_suite.terrain.spatial.layout import GRID, Layout
from trl_suite.util.files import existing

IMAGES = ('.png', '.tif', '.tiff', '.bmp', '.jpg', '.jpeg')
MESHES = ('.obj', '.glb', '.gltf', '.stl', '.ply')
Y_UP = ('.glb', '.gltf')  # formats whose y axis points up
LARGEST = 1e7  # vertices of an array

HeightFunction = Callable[..., npt.ArrayLike]


@dataclasses.dataclass(frozen=True)
class Surface(Terrain):
    """A terrain that knows how it was made, so that another process can make it again."""

    recipe: tuple[Any, ...] = dataclasses.field(default=(), compare=False, repr=False)

    def __reduce__(self) -> tuple[Any, ...]:
        return self.recipe


def from_function(
    function: HeightFunction,
    name: str | None = None,
    *,
    start_span: float = 0.0,
    replace: bool = False,
) -> Terrain:
    """Makes terrain from heights as a function of the place.

    Args:
      function: x (k,) -> heights (k,), m, of planar ground; or x, y (k, m) -> heights (k, m) of
        three-dimensional ground. It is given arrays, and must always answer the same. To cross
        processes it must be importable.
      name: of the terrain and of its type; by default the function's.
      start_span: an episode starts anywhere from -start_span to start_span, m, along x and, in
        three dimensions, along y: there the ground is moved to the origin, by whole cells.
      replace: whether an existing type of that name may be replaced.

    Raises:
      ValueError: no name, a name that is taken, a function of none or more than two arguments, or
        one that does not answer an array with an array of its shape.
      TypeError: it is no function, or none of arrays.
    """
    if not callable(function):
        raise TypeError(f'a function of x, or of x and y, is needed, not {function!r}')
    if name is None:
        name = str(getattr(function, '__name__', 'object'))
        if name == '<lambda>' or not hasattr(function, '__name__'):
            raise ValueError(f'the function {function!r} has no name of its own; give name=')
    arguments = _arguments(function)
    taken = GENERATORS if arguments == 1 else GENERATORS3D
    known = _functions.get((arguments, name))
    # A notebook's cell, run again. Of a lambda nobody knows whether it is the same.
    again = known is not None and _place(known) == _place(function)
    again &= not _place(function)[1].endswith('<lambda>')
    if name in taken and known is not function and not again and not replace:
        raise ValueError(f'terrain type {name!r} exists; pass replace=True to replace it')
    _check_answer(name, function, arguments)
    _functions[arguments, name] = function
    _register(name, function, arguments)
    recipe = functools.partial(from_function, start_span=start_span, replace=True), (function, name)
    return Surface(name, name, ({'StartSpan': start_span},), recipe)


_functions: dict[tuple[int, str], HeightFunction] = {}


def _place(function: HeightFunction) -> tuple[str, str]:
    """Where a function is written."""
    return getattr(function, '__module__', ''), getattr(function, '__qualname__', repr(function))


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
    """Asks for a few heights: what is wrong with a function is better said before an episode."""
    shape = (2, 3)[-arguments:]
    try:
        found = np.asarray(function(*[np.zeros(shape)] * arguments))
    except (TypeError, ValueError) as error:
        raise TypeError(
            f'the height function {name!r} failed where it was given an array: {error}; numpy has '
            'functions of arrays, as np.sin instead of math.sin, or np.where instead of if'
        ) from error
    if found.shape != shape or found.dtype.kind not in 'fiu':
        raise ValueError(
            f'the height function {name!r} answers an array of shape {shape} with {found.dtype} of '
            f'shape {found.shape}; expected numbers of the same shape'
        )


def _register(name: str, function: HeightFunction, arguments: int) -> None:
    if arguments == 1:
        register_line(name, function)  # type: ignore[arg-type]
        return

    @register3d(name, {'StartSpan': 0.0}, replace=True)
    def layout(parameters: Parameters, rng: np.random.Generator) -> Layout:
        most = int(parameters['StartSpan'] / GRID)
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
    """Makes terrain from an array of heights, linear in between.

    Args:
      heights: m; (k,) along x for planar ground, or (k, m) along x and along y (to the left).
      spacing: between them, m.
      name: for messages.
      first: number of the first vertex along each axis, which stands at first * spacing; by default
        the middle of the array is the origin.
      line: y in m of a line through (k, m) heights, which makes the ground planar.
      start_span: as for `from_function`.

    Raises:
      ValueError: heights of another shape, too many, or not finite; a spacing that is not positive.
    """
    heights = np.array(heights, float)
    if heights.ndim not in (1, 2) or min(heights.shape) < 2 or heights.size > LARGEST:
        raise ValueError(
            f'{name}: heights have shape {heights.shape}; expected (k,) or (k, m), 2 or more along '
            f'each axis and no more than {LARGEST:g} in all'
        )
    if not np.isfinite(heights).all():
        raise ValueError(f'{name}: heights must be finite; those at {_where(heights)} is not')
    if not 0 < spacing < math.inf:
        raise ValueError(f'{name}: spacing is {spacing}; expected a positive number of metres')
    corner = -(np.array(heights.shape) // 2) if first is None else np.atleast_1d(first)
    if corner.shape != (heights.ndim,):
        raise ValueError(
            f'{name}: first is {first}; expected a number for each of {heights.ndim} axes'
        )
    if line is not None:
        if heights.ndim == 1:
            raise ValueError(
                f'{name}: heights of shape {heights.shape} are a line already; give no line'
            )
        x = spacing * (corner[0] + np.arange(len(heights)))
        heights, corner = _Raster(heights, spacing, corner)(x, line), corner[:1]
    raster = _Raster(heights, spacing, corner)
    # Named by what it holds: whoever makes the same ground again, anywhere, finds the same type.
    digest = hashlib.sha256(heights.tobytes())
    digest.update(repr((heights.shape, spacing, corner.tolist())).encode())
    type_name = f'{name}#{digest.hexdigest()[:12]}'
    _register(type_name, raster if heights.ndim == 2 else raster.along, heights.ndim)
    again = functools.partial(from_heights, first=tuple(corner.tolist()), start_span=start_span)
    return Surface(name, type_name, ({'StartSpan': start_span},), (again, (heights, spacing, name)))


def _where(heights: np.ndarray) -> list[int]:
    return np.argwhere(~np.isfinite(heights))[0].tolist()


@dataclasses.dataclass(frozen=True, eq=False)
class _Raster:
    """Heights (k,) or (k, m) whose first vertex stands at corner * spacing."""

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
        """Heights at points, bilinear."""
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
    """Makes terrain from a height image: grey is height.

    The picture is a map: x runs to its right, y up, and the origin is the pixel in its middle.

    Args:
      path: .png, of 8 or 16 bits per pixel, or what else Pillow reads; of a picture in colours the
        mean of red, green and blue counts.
      spacing: between pixels, m.
      low: height of black, m.
      high: height of white, m.
      line: as for `from_heights`.
      start_span: as for `from_function`.

    Raises:
      ValueError: no picture, a picture without range, or as `from_heights`.
      FileNotFoundError: there is no such file; the message has similar names.
      ImportError: imageio is not installed.
    """
    file = existing(path, IMAGES)
    if not (math.isfinite(low) and math.isfinite(high)) or low == high:
        raise ValueError(f'{file}: black is {low} m and white {high} m; expected two heights')
    imageio = library('imageio.v3', "'trl_suite[video]'")
    try:
        pixels = np.asarray(imageio.imread(file, plugin='pillow'))
    except Exception as error:  # of the reader's own kinds
        raise ValueError(f'{file}: not a picture that can be read ({error})') from None
    if not np.issubdtype(pixels.dtype, np.integer) and pixels.dtype != bool:
        raise ValueError(f'{file}: pixels are {pixels.dtype}; expected whole numbers')
    full = 1 if pixels.dtype == bool else np.iinfo(pixels.dtype).max
    if pixels.ndim == 3:
        pixels = pixels[..., :3].mean(2) if pixels.shape[2] >= 3 else pixels[..., 0]
    grey = pixels.astype(float)[::-1].T / full  # rows from below, along y
    return from_heights(
        low + (high - low) * grey, spacing, file.stem, line=line, start_span=start_span
    )


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
    """Makes terrain from a mesh, seen from above: of what lies over a point the highest counts.

    Points that nothing lies over are as low as the lowest point of the mesh.

    Args:
      path: .obj, .glb, .gltf, .stl or .ply.
      spacing: between the points at which heights are taken, m.
      scale: m per unit of the file, 0.001 for one in millimetres.
      up: the file's axis that points up, 'z' or 'y' (then z points to the viewer: -y here); by
        default 'y' for .glb and .gltf, as that format has it, and 'z' for the others.
      centre: move the middle of the mesh to the origin; else its own origin is ours.
      line: as for `from_heights`.
      start_span: as for `from_function`.

    Raises:
      ValueError: no mesh, one that does not lie over the origin, too many points, or bad numbers.
      FileNotFoundError: there is no such file; the message has similar names.
    """
    file = existing(path, MESHES)
    up = up or ('y' if file.suffix.lower() in Y_UP else 'z')
    if up not in ('y', 'z'):
        raise ValueError(f"{file}: up is {up!r}; expected 'y' or 'z'")
    for name, number in (('spacing', spacing), ('scale', scale)):
        if not 0 < number < math.inf:
            raise ValueError(f'{file}: {name} is {number}; expected a positive number')
    triangles = _triangles(file) * scale
    if up == 'y':
        triangles = triangles[..., [0, 2, 1]] * (1, -1, 1)
    low, high = triangles.min((0, 1)), triangles.max((0, 1))
    if centre:
        middle = np.append(0.5 * (low + high)[:2], 0.0)
        triangles, low, high = triangles - middle, low - middle, high - middle
    if not ((low[:2] <= 0) & (high[:2] >= 0)).all():
        raise ValueError(
            f'{file}: the mesh lies over x from {low[0]:g} to {high[0]:g} m and y from {low[1]:g} to '
            f'{high[1]:g} m, not over the origin, where characters start; pass centre=True, or move it'
        )
    first = np.ceil(low[:2] / spacing - 1e-6).astype(int)
    last = np.floor(high[:2] / spacing + 1e-6).astype(int)
    count = last - first + 1
    if min(count) < 2 or math.prod(count.tolist()) > LARGEST:
        raise ValueError(
            f'{file}: {count[0]} x {count[1]} points lie over the mesh, spacing is {spacing:g} m; '
            f'expected 2 or more along each axis and no more than {LARGEST:g} in all'
        )
    x, y = (spacing * (first[i] + np.arange(count[i])) for i in (0, 1))
    heights = heights_over(triangles, x, y)
    heights[np.isinf(heights)] = low[2]
    corner = int(first[0]), int(first[1])
    return from_heights(heights, spacing, file.stem, first=corner, line=line, start_span=start_span)


def heights_over(triangles: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Returns the highest points of triangles over a grid, (k, m) m; -inf where there are none.

    Args:
      triangles: corners, (t, 3, 3) m.
      x, y: ascending, (k,) and (m,) m.
    """
    # A library's rays would need another library, and take three times as long.
    heights = np.full((len(x), len(y)), -np.inf)
    low, high = (triangles.min(1) - 1e-9).T, (triangles.max(1) + 1e-9).T
    bounds = [np.searchsorted(x, low[0]), np.searchsorted(x, high[0])]
    bounds += [np.searchsorted(y, low[1]), np.searchsorted(y, high[1])]
    spans = np.stack(bounds, 1)
    hit = (spans[:, 1] > spans[:, 0]) & (spans[:, 3] > spans[:, 2])
    for corner, (a, b, c, d) in zip(triangles[hit], spans[hit].tolist(), strict=True):
        p, u, v = corner[0], corner[1] - corner[0], corner[2] - corner[0]
        area = u[0] * v[1] - u[1] * v[0]
        if abs(area) < 1e-12:  # seen edge on
            continue
        dx, dy = x[a:b, None] - p[0], y[c:d] - p[1]
        s, t = (dx * v[1] - dy * v[0]) / area, (u[0] * dy - u[1] * dx) / area
        inside = (s >= -1e-9) & (t >= -1e-9) & (s + t <= 1 + 1e-9)
        height = np.where(inside, p[2] + s * u[2] + t * v[2], -np.inf)
        np.maximum(heights[a:b, c:d], height, out=heights[a:b, c:d])
    return heights


def _triangles(file: os.PathLike[str]) -> np.ndarray:
    """Returns the corners of a mesh file's triangles, (t, 3, 3), in its own units."""
    trimesh = library('trimesh', 'trimesh')
    try:
        mesh = trimesh.load_scene(file).to_mesh()
        triangles = np.asarray(mesh.triangles, float)
    except Exception as error:  # of the reader's own kinds
        raise ValueError(f'{file}: not a mesh that can be read ({error})') from None
    if not len(triangles) or not np.isfinite(triangles).all():
        raise ValueError(f'{file}: not a mesh: it has no triangles, or some that are not finite')
    return triangles


def library(name: str, source: str) -> Any:
    """Imports what only some need; `source` is what pip is to install where it is missing."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package = name.partition('.')[0]
        message = f'{package} is needed for this and missing; pip install {source}'
        raise ImportError(message) from error
