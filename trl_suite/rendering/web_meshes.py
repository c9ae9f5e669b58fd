"""Meshes for the web viewer: one of each shape, and those of the ground of a simulation."""

from __future__ import annotations

import functools
from typing import Any, cast

import mujoco
import numpy as np
import trimesh

from trl_suite.arenas.boxes import HALF_WIDTH
from trl_suite.terrain import SPACING
from trl_suite.terrain.planar.windows import PlanarWindows

SECTIONS = 24  # number of faces around a cylinder or cone
TILE = 1.0  # m; edge of the squares on the ground, which make motion visible
SHADES = (1.0, 0.88)  # brightness of the squares
PLANE = 60.0  # m; half side of the part of an infinite plane that is drawn
CHECKERED = 24.0  # m; half side of its part that has squares
TOLERANCE = 1e-6  # m; parts of triangles that are smaller are not cut off
DEPTH = 1.0  # m; thickness of planar ground below its lowest point
STEP = 2.0**-9  # m; heights of height fields are multiples of it, which compresses better
NEAR = 8.0  # m; distance from the centre of a height field within which all vertices are drawn


def shape_mesh(name: str, model: Any) -> trimesh.Trimesh:
    """Returns the mesh of a shape.

    Args:
      name: 'box', 'sphere', 'cylinder', 'cone' or 'tube', of size 1; or 'mesh_3' for mesh 3 of the
        model, in its own size.
      model: the model.
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
    if name == 'box':
        return trimesh.creation.box(extents=(2, 2, 2))
    if name == 'sphere':
        return trimesh.creation.icosphere(subdivisions=2)
    if name == 'cylinder':
        return trimesh.creation.cylinder(1.0, 2.0, SECTIONS)
    if name == 'cone':
        return trimesh.creation.cone(1.0, 1.0, sections=SECTIONS)
    return trimesh.creation.annulus(0.999, 1.0, 2.0, sections=SECTIONS)  # a tube


def ground_meshes(
    model: Any, data: Any, is_ground: np.ndarray, lowest: float
) -> dict[tuple[int, str], trimesh.Trimesh]:
    """Returns the geoms of the ground as one mesh per material and kind.

    Kinds are 'boxes' and 'field', in world coordinates, and 'plane' and 'far', the inner and outer
    part of infinite planes, around x = y = 0.

    Args:
      model: the model.
      data: its state.
      is_ground: which geoms are the ground, (geoms,) bool.
      lowest: height below which geoms are left out, m.
    """
    parts: dict[tuple[int, str], list[trimesh.Trimesh]] = {}
    for geom in np.flatnonzero(is_ground):
        shape, place = model.geom_type[geom], data.geom_xpos[geom]
        if place[2] < lowest:
            continue
        found = {}
        if shape == mujoco.mjtGeom.mjGEOM_PLANE:
            found = {'plane': _square(CHECKERED, place[2]), 'far': _frame(place[2])}
        elif shape == mujoco.mjtGeom.mjGEOM_HFIELD:
            found['field'] = height_field_mesh(model, data, int(geom))
        elif shape == mujoco.mjtGeom.mjGEOM_BOX:
            axes, box = data.geom_xmat[geom].reshape(3, 3), _shape('box')
            corners = (box.vertices * model.geom_size[geom]) @ axes.T + place
            found['boxes'] = trimesh.Trimesh(corners, box.faces, process=False)
        for kind, mesh in found.items():
            parts.setdefault((int(model.geom_matid[geom]), kind), []).append(mesh)
    return {
        key: cast(trimesh.Trimesh, trimesh.util.concatenate(meshes))
        for key, meshes in parts.items()
    }


def _square(half: float, height: float) -> trimesh.Trimesh:
    corners = half * np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]) + (0, 0, height)
    return trimesh.Trimesh(corners, [(0, 1, 2), (0, 2, 3)], process=False)


def _frame(height: float) -> trimesh.Trimesh:
    """Returns the part of a plane between the squares and the border."""
    corners = np.concatenate([_square(half, height).vertices for half in (PLANE, CHECKERED)])
    faces = [
        face
        for i, k in ((0, 1), (1, 2), (2, 3), (3, 0))
        for face in ((i, k, k + 4), (i, k + 4, i + 4))
    ]
    return trimesh.Trimesh(corners, faces, process=False)


def planar_mesh(ground: PlanarWindows) -> trimesh.Trimesh:
    """Returns the window of a planar ground: its profile, as wide as the boxes of the physics."""
    heights, vertical = ground.heights[0], ground.vertical[0]
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
            heights[top, left : right + 1], heights[bottom, left : right + 1],
            heights[top : bottom + 1, left], heights[top : bottom + 1, right],
        ):  # fmt: skip
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

    Args:
      vertices: number of vertices along the side.
      half: half length of the side, m.
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


def squares(mesh: trimesh.Trimesh) -> tuple[trimesh.Trimesh, ...]:
    """Cuts a mesh into squares along the world's x and y; returns those of each of the `SHADES`.

    Clients load a texture in the background; without one, they draw changed ground at once.
    """
    triangles = mesh.triangles
    for axis in (0, 1):
        done = []
        while len(triangles):
            at = triangles[:, :, axis]
            first = np.floor((at.min(1) + TOLERANCE) / TILE)
            last = np.ceil((at.max(1) - TOLERANCE) / TILE)
            is_cut = last - first > 1
            done.append(triangles[~is_cut])
            line = TILE * np.ceil(0.5 * (first + last))[is_cut]
            triangles = _cut(triangles[is_cut], axis, line)
        triangles = np.concatenate(done)
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    sizes = np.linalg.norm(normals, axis=1)
    triangles, normals, sizes = (part[sizes > 0] for part in (triangles, normals, sizes))
    # A side between two squares is of the square behind it.
    inside = triangles.mean(1) - 1e-3 * normals / sizes[:, None]
    shade = np.floor(inside[:, :2] / TILE).sum(1) % 2
    found = []
    for each in range(len(SHADES)):
        corners = triangles[shade == each].reshape(-1, 3).astype(np.float32)
        vertices, faces = np.unique(corners, axis=0, return_inverse=True)
        found.append(trimesh.Trimesh(vertices, faces.reshape(-1, 3), process=False))
    return tuple(found)


def _cut(triangles: np.ndarray, axis: int, line: np.ndarray) -> np.ndarray:
    """Cuts each triangle where the coordinate `axis` is `line`; both sides must have corners."""
    beyond = triangles[:, :, axis] > line[:, None]
    # The corner that is alone on its side comes first.
    alone = np.where(beyond.sum(1) == 1, beyond.argmax(1), beyond.argmin(1))
    order = (alone[:, None] + np.arange(3)) % 3
    first, second, third = np.moveaxis(triangles[np.arange(len(order))[:, None], order], 1, 0)
    cuts = []
    for other in (second, third):
        share = (line - first[:, axis]) / (other[:, axis] - first[:, axis])
        point = first + share[:, None] * (other - first)
        point[:, axis] = line
        cuts.append(point)
    pieces = (first, *cuts), (cuts[0], second, third), (cuts[0], third, cuts[1])
    return np.concatenate([np.stack(piece, 1) for piece in pieces])


def to_bytes(colours: np.ndarray) -> np.ndarray:
    """Converts colours from [0, 1] to uint8."""
    return (255 * np.clip(colours, 0, 1)).round().astype(np.uint8)
