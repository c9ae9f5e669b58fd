"""Mesh files: ground written for other programs, and the triangles and heights of a file."""

from __future__ import annotations

import io
import itertools
import json
import logging
import os
import pathlib
import re
import urllib.parse
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from trl_suite.terrain.generators import SPACING
from trl_suite.terrain.planar.ground import PlanarGround
from trl_suite.terrain.spatial.ground import SpatialGround
from trl_suite.terrain.spatial.layout import GRID, Boxes
from trl_suite.util import errors
from trl_suite.util.compiled import compiled
from trl_suite.util.files import LARGEST, check_path, read_bytes, replacing
from trl_suite.util.libraries import library

if TYPE_CHECKING:
    import trimesh

WRITTEN = ('.obj', '.glb', '.stl')
READ = ('.obj', '.glb', '.gltf', '.stl', '.ply')
Y_UP = ('.glb', '.gltf')  # formats whose y axis points up
MOST_PARTS = 5000  # separate meshes and nodes of a file; trimesh is slow for many
MOST_HEIGHTS = 10**10  # that are computed; of overlapping triangles each has its own
WIDTH = 2.0  # m; of the band that represents planar ground
DEPTH = 2.0  # m; of boxes on ground without a level
LARGEST_SIDE = 500.0  # m; of the exported piece

# Numbers of an element of a glTF accessor.
_NUMBERS = {
    'SCALAR': 1,
    **{f'VEC{n}': n for n in (2, 3, 4)},
    **{f'MAT{n}': n * n for n in (2, 3, 4)},
}
_PART = LARGEST // MOST_PARTS  # numbers that count for a part, or for each node above a node
# Without a handler, Python would print trimesh's warnings, which have strings of the file in them.
logging.getLogger('trimesh').addHandler(logging.NullHandler())

_Y_UP = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


def to_mesh(
    ground: PlanarGround | SpatialGround, low: npt.ArrayLike = -10.0, high: npt.ArrayLike = 10.0
) -> trimesh.Trimesh:
    """Returns a piece of ground as a mesh, whose upper side agrees with the heights of the ground.

    Planar ground becomes a band 2 m wide. Boxes stay boxes, moving ones at their initial places.

    Args:
      ground: the ground to export.
      low, high: bounds of the piece, m: of x for planar ground; otherwise two corners, (2,), or one
        number for both x and y.

    Returns:
      A `trimesh.Trimesh`; x forward, y left, z up, in m.

    Raises:
      ValueError: low is not less than high, or they are more than LARGEST_SIDE apart.
      ImportError: trimesh is not installed.
    """
    trimesh = library('trimesh', 'trimesh')
    corners = [
        np.broadcast_to(errors.floats(name, each), 2)
        for name, each in (('low', low), ('high', high))
    ]
    size = corners[1] - corners[0]
    if not ((size > 0) & (size <= LARGEST_SIDE)).all():
        raise ValueError(
            f'low is {low!r} and high {high!r}; expected low below high, at most {LARGEST_SIDE:g} m apart'
        )
    pieces = (
        _strip(ground, *corners) if isinstance(ground, PlanarGround) else _ground(ground, *corners)
    )
    return trimesh.util.concatenate([trimesh.Trimesh(*piece, process=False) for piece in pieces])


def save_mesh(
    ground: PlanarGround | SpatialGround,
    path: str | os.PathLike[str],
    low: npt.ArrayLike = -10.0,
    high: npt.ArrayLike = 10.0,
) -> None:
    """Writes a piece of ground as a mesh file.

    Args:
      ground, low, high: as for `to_mesh`.
      path: .obj, .glb (written with the y axis up, as that format requires) or .stl.

    Raises:
      ValueError: another suffix, or as for `to_mesh`.
      OSError: the file cannot be written.
    """
    target = check_path(path, WRITTEN)
    mesh = to_mesh(ground, low, high)
    if target.suffix.lower() in Y_UP:
        mesh.apply_transform(_Y_UP)
    with replacing(target) as part:
        mesh.export(part)


Piece = tuple[np.ndarray, np.ndarray]  # vertices (v, 3) m, faces (f, 3)


def _strip(strip: PlanarGround, low: np.ndarray, high: np.ndarray) -> list[Piece]:
    first, last = round(low[0] / SPACING), round(high[0] / SPACING)
    heights = strip.window(first, last - first + 1)[0]
    x = SPACING * np.arange(first, last + 1)
    return [_sheet(x, 0.5 * WIDTH * np.array([-1.0, 1.0]), np.repeat(heights[:, None], 2, 1))]


def _ground(ground: SpatialGround, low: np.ndarray, high: np.ndarray) -> list[Piece]:
    layout, pieces = ground.layout, []
    if layout.level is not None:
        x, y = np.stack([low, high], 1)
        pieces.append(_sheet(x, y, np.full((2, 2), layout.level)))
    if layout.grid is not None:
        i, j = (
            np.arange(round(a / GRID), round(b / GRID) + 1) for a, b in zip(low, high, strict=True)
        )
        pieces.append(_sheet(GRID * i, GRID * j, layout.vertices(i, j)))
    groups = [layout.boxes_in(low, high)]
    if layout.belts is not None:
        groups.append(layout.belts.boxes)
    if layout.movers is not None:
        groups.append(ground.movers())
    for boxes in groups:
        for k in np.flatnonzero(boxes.touching(low, high)).tolist():
            pieces.append(_box(boxes.select(np.array([k])), layout.level, low, high))
    return pieces


def _sheet(x: np.ndarray, y: np.ndarray, heights: np.ndarray) -> Piece:
    """A height grid; cells are split from back left to front right, as in the ground."""
    k, m = heights.shape
    points = np.stack([*np.meshgrid(x, y, indexing='ij'), heights], 2).reshape(-1, 3)
    near = (np.arange(k - 1)[:, None] * m + np.arange(m - 1)).ravel()
    back_left, front_right, far = near + 1, near + m, near + m + 1
    faces = [[near, front_right, back_left], [far, back_left, front_right]]
    return points, np.concatenate([np.stack(face, 1) for face in faces])


def _box(box: Boxes, level: float | None, low: np.ndarray, high: np.ndarray) -> Piece:
    """One box with vertical sides, clipped to the bounds if its yaw is 0."""
    trimesh = library('trimesh', 'trimesh')
    position, half, yaw, top, slope = (part[0] for part in box)
    if not yaw:
        begin, end = np.maximum(position - half, low), np.minimum(position + half, high)
        top = top + slope * (0.5 * (begin + end) - position)[0]
        position, half = 0.5 * (begin + end), 0.5 * (end - begin)
    unit = trimesh.creation.box((2, 2, 2))
    signs = np.asarray(unit.vertices)
    along, across = (signs[:, :2] * half).T
    upper = top + slope * along
    bottom = upper.min() - DEPTH if level is None else level
    cosine, sine = np.cos(yaw), np.sin(yaw)
    x = position[0] + cosine * along - sine * across
    y = position[1] + sine * along + cosine * across
    z = np.where(signs[:, 2] > 0, upper, bottom)
    return np.stack([x, y, z], 1), np.asarray(unit.faces)


def read_triangles(file: pathlib.Path) -> np.ndarray:
    """Returns the corners of a mesh file's triangles, (t, 3, 3), in its own units.

    Materials and textures are not read, nor any other file, except buffers of a .gltf in its folder.
    """
    trimesh = library('trimesh', 'trimesh')
    content, kind = read_bytes(file), file.suffix.lower()[1:]
    try:
        if kind == 'obj':
            content = _triangles_only(content)
        elif kind == 'stl' and content.lower().count(b'endsolid') > MOST_PARTS:
            raise ValueError(f'expected at most {MOST_PARTS} solids')
        elif kind == 'ply':
            _check_ply(content)
        elif kind == 'gltf':
            _check_gltf(content)
        elif kind == 'glb':  # begins with five numbers; the fourth is the length of its JSON
            _check_gltf(content[20 : 20 + int.from_bytes(content[12:16], 'little')])
        # Unprocessed: merging equal corners takes most of the time, and changes no height.
        mesh = trimesh.load_scene(
            io.BytesIO(content), kind, _Buffers(file.parent), process=False, skip_materials=True
        ).to_mesh()
        triangles = np.asarray(mesh.triangles, float)
    except Exception as error:  # the reader raises types of its own
        raise ValueError(f'{file}: cannot be read as a mesh ({error})') from None
    if not len(triangles) or not np.isfinite(triangles).all():
        raise ValueError(f'{file}: not a mesh: no triangles, or vertices that are not finite')
    if triangles.shape[1:] != (3, 3):  # of files whose vertices have one or two coordinates
        raise ValueError(f'{file}: not a mesh: vertices without three coordinates')
    return triangles


def _triangles_only(content: bytes) -> bytes:
    """Returns the vertices and faces of an .obj, without groups, materials and texture coordinates."""
    text = content.replace(b'\r\n', b'\n').replace(b'\\\n', b'')
    return re.sub(rb'/\S*', b'', b'\n'.join(re.findall(rb'^[vf][ \t].*', text, re.MULTILINE)))


def _check_ply(content: bytes) -> None:
    """Refuses elements that are not used: one edge may ask for any amount of memory."""
    elements = re.findall(
        rb'^\s*element\s+(\S+)', content.partition(b'end_header')[0], re.MULTILINE
    )
    for name in elements:
        if name not in (b'vertex', b'face'):
            raise ValueError(f'expected the elements vertex and face, not {name.decode()!r}')


class _Buffers:
    """The buffers of a .gltf by name, which are files in the same folder."""

    def __init__(self, folder: pathlib.Path) -> None:
        self._folder, self._read = folder, dict[str, bytes]()

    def __getitem__(self, uri: str) -> bytes:
        name = urllib.parse.unquote(uri)
        if pathlib.PurePath(name).name != name:
            raise ValueError(f'the buffer {uri!r} is not in the folder of the file')
        if name not in self._read:
            left = LARGEST - sum(map(len, self._read.values()))
            self._read[name] = read_bytes(self._folder / name, left)
        return self._read[name]


def _check_gltf(content: bytes) -> None:
    """Refuses a glTF scene that is large though its file is small: parts of it may share bytes."""
    tree: dict[str, Any] = json.loads(content.decode())
    nodes = tree.get('nodes', ())
    sizes = [_NUMBERS[each['type']] * abs(each['count']) for each in tree.get('accessors', ())]

    def size(part: dict[str, Any]) -> int:
        accessors = {**part['attributes'], 'indices': part.get('indices')}
        return _PART + sum(sizes[i] for i in accessors.values() if i is not None)

    meshes = [sum(map(size, mesh['primitives'])) for mesh in tree.get('meshes', ())]
    total = sum(abs(view['byteLength']) // 4 for view in tree.get('bufferViews', ()))
    total += sum(sizes) + sum(meshes)
    level = [i for scene in tree.get('scenes', ()) for i in scene.get('nodes', ())]
    depth = 0
    while level and total <= LARGEST:
        depth += 1
        used = [nodes[i] for i in level]
        total += sum(meshes[node['mesh']] for node in used if 'mesh' in node)
        children = [node.get('children', ()) for node in used]
        total += _PART * (depth * len(level) + sum(map(len, children)))
        level = [*itertools.chain(*children)] if total <= LARGEST else []
    if not total <= LARGEST:
        raise ValueError(
            f'expected at most {LARGEST:.3g} numbers in all, and {MOST_PARTS} meshes and nodes'
        )
    if any('bufferView' not in each for each in tree.get('accessors', ())):  # zeros without bytes
        raise ValueError('expected a bufferView in each accessor')


def heights_over(triangles: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Returns the highest points of triangles over a grid, (k, m) m; -inf where there are none.

    Args:
      triangles: corners, (t, 3, 3) m.
      x, y: ascending, (k,) and (m,) m.
    """
    # Ray casting by trimesh would need another library, and take three times as long.
    heights = np.full((len(x), len(y)), -np.inf)
    low, high = (triangles.min(1) - 1e-9).T, (triangles.max(1) + 1e-9).T
    bounds = [np.searchsorted(x, low[0]), np.searchsorted(x, high[0])]
    bounds += [np.searchsorted(y, low[1]), np.searchsorted(y, high[1])]
    spans = np.stack(bounds, 1)
    count = (spans[:, 1] - spans[:, 0]) @ (spans[:, 3] - spans[:, 2])
    if count > MOST_HEIGHTS:
        raise ValueError(
            f'the triangles cover {count:.3g} points in all; expected at most {MOST_HEIGHTS:.3g}'
        )
    _raise_heights(np.ascontiguousarray(triangles), spans, x, y, heights)
    return heights


@compiled
def _raise_heights(
    triangles: np.ndarray, spans: np.ndarray, x: np.ndarray, y: np.ndarray, heights: np.ndarray
) -> None:
    """Raises heights (k, m) to triangles, each over the points of its span."""
    for t in range(len(triangles)):
        corner = triangles[t]
        px, py, pz = corner[0, 0], corner[0, 1], corner[0, 2]
        ux, uy, uz = corner[1, 0] - px, corner[1, 1] - py, corner[1, 2] - pz
        vx, vy, vz = corner[2, 0] - px, corner[2, 1] - py, corner[2, 2] - pz
        area = ux * vy - uy * vx
        if abs(area) < 1e-12:  # seen edge on
            continue
        for i in range(spans[t, 0], spans[t, 1]):
            for j in range(spans[t, 2], spans[t, 3]):
                dx, dy = x[i] - px, y[j] - py
                along, across = (dx * vy - dy * vx) / area, (ux * dy - uy * dx) / area
                if along >= -1e-9 and across >= -1e-9 and along + across <= 1 + 1e-9:
                    heights[i, j] = max(heights[i, j], pz + along * uz + across * vz)
