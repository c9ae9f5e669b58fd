"""Meshes for the web viewer: one of each shape, and those of the ground of a simulation."""

from __future__ import annotations

import functools
from typing import Any, cast

import mujoco
import numpy as np
import trimesh

from trl_suite.arenas.boxes import HALF_WIDTH
from trl_suite.terrain import SPACING
from trl_suite.terrain.planar.windows import BEFORE, PlanarWindows

SECTIONS = 24  # number of faces around a cylinder or cone
TILE = 1.0  # m; edge of the squares on the ground, which make motion visible
SHADES = (1.0, 0.88, 0.94)  # brightness of the squares, and of ground without squares
STEEP = 0.1  # vertical part of the normal below which a side has no squares
PLANE = 60.0  # m; half side of the part of an infinite plane that is drawn
TOLERANCE = 1e-6  # m; parts of triangles that are smaller are not cut off
DEPTH = 1.0  # m; thickness of planar ground below its lowest point
STEP = 2.0**-9  # m; heights of height fields are multiples of it, which compresses better
NEAR = 8.0  # m; distance from the centre of a height field within which all vertices are drawn


def shape_mesh(name: str, model: Any) -> trimesh.Trimesh:
    """Returns the mesh of a shape.

    Names are 'box', 'sphere', 'cylinder', 'cone' and 'tube', of size 1; and, for example, 'mesh_3'
    for mesh 3 of the model, in its own size.
    """
    kind, _, number = name.partition('_')
    if kind != 'mesh':
        return _shape(name)
    mesh = model.mesh(int(number))
    vertices = slice(int(mesh.vertadr[0]), int(mesh.vertadr[0] + mesh.vertnum[0]))
    faces = slice(int(mesh.faceadr[0]), int(mesh.faceadr[0] + mesh.facenum[0]))
    return trimesh.Trimesh(model.mesh_vert[vertices], model.mesh_face[faces], process=False)


@functools.cache
def _shape(name: str) -> trimesh.Trimesh:
    """Returns a mesh of size 1."""
    make = trimesh.creation
    return {
        'box': lambda: make.box(extents=(2, 2, 2)),
        'sphere': lambda: make.icosphere(subdivisions=2),
        'cylinder': lambda: make.cylinder(1.0, 2.0, SECTIONS),
        'cone': lambda: make.cone(1.0, 1.0, sections=SECTIONS),
        'tube': lambda: make.annulus(0.999, 1.0, 2.0, sections=SECTIONS),
    }[name]()


def ground_meshes(
    model: Any, data: Any, is_ground: np.ndarray, lowest: float
) -> dict[tuple[int, str], trimesh.Trimesh]:
    """Returns the geoms of the ground as one mesh per material and kind.

    Kinds are 'boxes' and 'field', in world coordinates, and 'plane', around x = y = 0. Geoms below
    the height `lowest`, m, are left out.
    """
    parts: dict[tuple[int, str], list[trimesh.Trimesh]] = {}
    for geom in np.flatnonzero(is_ground):
        shape, place = model.geom_type[geom], data.geom_xpos[geom]
        if place[2] < lowest:
            continue
        if shape == mujoco.mjtGeom.mjGEOM_PLANE:
            corners = PLANE * np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
            corners[:, 2] = place[2]
            kind, mesh = 'plane', trimesh.Trimesh(corners, [(0, 1, 2), (0, 2, 3)], process=False)
        elif shape == mujoco.mjtGeom.mjGEOM_HFIELD:
            kind, mesh = 'field', height_field_mesh(model, data, int(geom))
        elif shape == mujoco.mjtGeom.mjGEOM_BOX:
            axes, box = data.geom_xmat[geom].reshape(3, 3), _shape('box')
            corners = (box.vertices * model.geom_size[geom]) @ axes.T + place
            kind, mesh = 'boxes', trimesh.Trimesh(corners, box.faces, process=False)
        else:
            continue
        parts.setdefault((int(model.geom_matid[geom]), kind), []).append(mesh)
    return {
        key: cast(trimesh.Trimesh, trimesh.util.concatenate(meshes))
        for key, meshes in parts.items()
    }


def planar_mesh(ground: PlanarWindows) -> trimesh.Trimesh:
    """Returns the window of a planar ground: its profile, as wide as the boxes of the physics."""
    heights, vertical = ground.heights[0, BEFORE:], ground.vertical[0, BEFORE:]
    x = (ground.start[0] + np.arange(len(heights))) * SPACING
    # Vertical faces stand in the middle of their cells.
    face = np.flatnonzero(vertical[1:])
    middle = 0.5 * (x[face] + x[face + 1])
    x, z = (
        np.insert(line, np.repeat(face + 1, 2), np.stack(pair, 1).ravel())
        for line, *pair in ((x, middle, middle), (heights, heights[face], heights[face + 1]))
    )
    slope = np.diff(z) / np.maximum(np.diff(x), 1e-9)
    kept = np.concatenate([[True], np.abs(np.diff(slope)) > 1e-6, [True]])
    x, z = x[kept], z[kept]
    bottom = np.full(len(x), z.min() - DEPTH)
    front, back = -HALF_WIDTH, HALF_WIDTH
    strips = [((front, z), (back, z)), ((front, bottom), (front, z)), ((back, z), (back, bottom))]
    corners = []
    for (y_right, z_right), (y_left, z_left) in strips:
        right = np.stack([x, np.full(len(x), y_right), z_right], 1)
        left = np.stack([x, np.full(len(x), y_left), z_left], 1)
        corners.append(
            np.stack([right[:-1], right[1:], left[1:], right[:-1], left[1:], left[:-1]], 1)
        )
    vertices = np.concatenate(corners).reshape(-1, 3)
    return trimesh.Trimesh(vertices, np.arange(len(vertices)).reshape(-1, 3), process=False)


def height_field_mesh(model: Any, data: Any, geom: int) -> trimesh.Trimesh:
    """Returns the surface of a height field in world coordinates, to `STEP` in height.

    Cells farther than `NEAR` from its middle are twice as wide.
    """
    field = int(model.geom_dataid[geom])
    rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
    start = int(model.hfield_adr[field])
    x, y, z, _ = model.hfield_size[field]
    heights = (z * model.hfield_data[start : start + rows * columns]).reshape(rows, columns)
    # Fine cells are those between the first and last of these rows and columns.
    top, left = _first_fine(rows, y), _first_fine(columns, x)
    bottom, right = rows - 1 - top, columns - 1 - left
    if top or left:  # no cracks: along the border fine cells are as straight as coarse ones
        for line in (
            heights[top, left : right + 1],
            heights[bottom, left : right + 1],
            heights[top : bottom + 1, left],
            heights[top : bottom + 1, right],
        ):
            line[1:-1:2] = 0.5 * (line[:-2:2] + line[2::2])
    across, along = np.meshgrid(np.linspace(-x, x, columns), np.linspace(-y, y, rows))
    local = np.stack([across.ravel(), along.ravel(), heights.ravel()], axis=1)
    row, column = np.mgrid[0 : rows - 1, 0 : columns - 1]
    fine = (row >= top) & (row < bottom) & (column >= left) & (column < right)
    coarse = ~fine & (row % 2 == 0) & (column % 2 == 0)
    faces = np.concatenate([_cells(fine, 1, columns), _cells(coarse, 2, columns)])
    used, faces = np.unique(faces, return_inverse=True)
    local, faces = local[used], faces.reshape(-1, 3)
    turned = local @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
    turned[:, 2] = STEP * np.round(turned[:, 2] / STEP)
    return trimesh.Trimesh(turned.astype(np.float32), faces, process=False)


def _first_fine(vertices: int, half: float) -> int:
    """Returns from which vertex of a side, as far as to its mirror image, cells are fine.

    `half` is half the length of the side, m.
    """
    cells = vertices - 1
    if cells % 2:  # cannot be paired
        return 0
    return 2 * int(max(0.0, np.ceil(0.5 * (0.5 * cells - NEAR * cells / (2 * half)))))


def _cells(kept: np.ndarray, size: int, columns: int) -> np.ndarray:
    """Returns two triangles for each cell of a grid, as indices of vertices."""
    row, column = np.nonzero(kept)
    corner = row * columns + column
    right, above = corner + size, corner + size * columns
    beyond = above + size
    return np.concatenate(
        [np.stack([corner, right, beyond], 1), np.stack([corner, beyond, above], 1)]
    )


def squares(mesh: trimesh.Trimesh, middle: np.ndarray, reach: float) -> tuple[trimesh.Trimesh, ...]:
    """Cuts a mesh into squares along the world's x and y.

    Returns the parts of each of the `SHADES`: two kinds of squares, and the rest.

    Clients load a texture in the background; without one, they draw changed ground at once.

    The ground is cut around the point `middle`, within the distance `reach` along x and y, m, both
    of them multiples of `TILE`.
    """
    upward = mesh.face_normals[:, 2]
    # Sides, if they are seen from above.
    outside = [mesh.triangles[(upward > -TOLERANCE) & (upward < STEEP)]]
    triangles = mesh.triangles[upward >= STEEP]
    for axis, sign in ((0, -1), (0, 1), (1, -1), (1, 1)):
        line = np.full(len(triangles), middle[axis] + sign * reach)
        outside.append(_clip(triangles, axis, line, sign)[0])
        triangles, _ = _clip(triangles, axis, line, -sign)
    for axis in (0, 1):
        triangles = _strips(triangles, axis)
    shade = np.floor(triangles.mean(1)[:, :2] / TILE).sum(1) % 2
    found = []
    for part in (triangles[shade == 0], triangles[shade == 1], np.concatenate(outside)):
        corners = part.reshape(-1, 3).astype(np.float32)
        vertices, faces = np.unique(corners, axis=0, return_inverse=True)
        found.append(trimesh.Trimesh(vertices, faces.reshape(-1, 3), process=False))
    return tuple(found)


def _strips(triangles: np.ndarray, axis: int) -> np.ndarray:
    """Cuts triangles wherever the coordinate `axis` is a multiple of `TILE`."""
    at = triangles[:, :, axis]
    first = np.floor((at.min(1) + TOLERANCE) / TILE).astype(int)
    last = np.ceil((at.max(1) - TOLERANCE) / TILE).astype(int)
    counts = np.maximum(last - first, 1)
    source = np.repeat(np.arange(len(counts)), counts)
    low = TILE * (first + counts - np.cumsum(counts))[source] + TILE * np.arange(len(source))
    triangles, kept = _clip(triangles[source], axis, low, 1)
    return _clip(triangles, axis, low[kept] + TILE, -1)[0]


def _clip(
    triangles: np.ndarray, axis: int, line: np.ndarray, sign: int
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the parts of triangles (n, 3, 3) beyond a line, and to which triangle each belongs.

    On the line of each triangle, the coordinate `axis` is `line`, (n,) m. The sign is 1 for parts
    above the line, -1 for those below.
    """
    distance = sign * (triangles[:, :, axis] - line[:, None])
    beyond = distance > TOLERANCE
    count = beyond.sum(1)
    # A triangle on the line itself is above it.
    is_whole = (distance >= -TOLERANCE).all(1) & ((count > 0) | (sign > 0))
    parts, sources = [triangles[is_whole]], [np.flatnonzero(is_whole)]
    for number in (1, 2):  # of the corners beyond the line
        source = np.flatnonzero((count == number) & ~is_whole)
        # The corner that is alone on its side comes first.
        alone = (beyond if number == 1 else ~beyond)[source].argmax(1)
        order = (alone[:, None] + np.arange(3)) % 3
        first, *others = np.moveaxis(triangles[source[:, None], order], 1, 0)
        cuts = []
        for other in others:
            share = (line[source] - first[:, axis]) / (other[:, axis] - first[:, axis])
            point = first + share[:, None] * (other - first)
            point[:, axis] = line[source]
            cuts.append(point)
        second, third = others
        pieces = [(first, *cuts)]
        if number == 2:
            pieces = [(cuts[0], second, third), (cuts[0], third, cuts[1])]
        parts += [np.stack(piece, 1) for piece in pieces]
        sources += [source] * len(pieces)
    return np.concatenate(parts), np.concatenate(sources)


def to_bytes(colours: np.ndarray) -> np.ndarray:
    """Converts colours from [0, 1] to uint8."""
    return (255 * np.clip(colours, 0, 1)).round().astype(np.uint8)
