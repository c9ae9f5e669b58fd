"""Meshes of a user's character: their addresses, and the formats that MuJoCo does not read."""

from __future__ import annotations

import os
import pathlib
import re
import urllib.parse
from collections.abc import Iterable

import mujoco
import numpy as np
from lxml import etree

from trl_suite.util import libraries

CONVERTED = ('.dae', '.ply', '.stl')  # .stl as text only


def prepare(spec: mujoco.MjSpec, file: pathlib.Path) -> None:
    """Finds the files of all meshes, and replaces those that MuJoCo does not read by their content.

    The path of the model's file is absolute.
    """
    bodies = users(spec)
    for mesh in spec.meshes:
        if not mesh.file:
            continue
        mesh.name = mesh.name or pathlib.PurePath(mesh.file).stem
        try:
            mesh.file = _path(mesh.file, file)
            name = os.path.basename(mesh.file) if spec.strippath else mesh.file
            path = file.parent / spec.meshdir / name
            if not path.is_file():
                if file.suffix.lower() == '.urdf':
                    raise ValueError(f'there is no file {mesh.file!r}')
            elif _is_foreign(path):
                corners, faces = _triangles(path)
                mesh.file, mesh.uservert, mesh.userface = '', corners.ravel(), faces.ravel()
        except ValueError as error:
            raise ValueError(
                f'{described(mesh.name, bodies.get(mesh.name, ()))}: {error}'
            ) from None


def users(spec: mujoco.MjSpec) -> dict[str, dict[str, bool]]:
    """Returns for every mesh the names of its bodies, and whether the inertia of each is given."""
    found: dict[str, dict[str, bool]] = {}
    for body in spec.bodies:
        for geom in body.geoms:
            found.setdefault(geom.meshname, {})[body.name] = bool(body.explicitinertial)
    return found


def described(name: str, bodies: Iterable[str]) -> str:
    """Returns the name of a mesh with those of its bodies, for messages."""
    return f'mesh {name!r} of {", ".join(map(repr, bodies)) or "no link"}'


def _path(address: str, file: pathlib.Path) -> str:
    """Returns the path of a mesh from its address in a file."""
    scheme, colon, rest = address.partition(':')
    if not colon or not re.fullmatch(r'[A-Za-z][\w+.-]+', scheme):  # one letter is a drive
        return address
    if scheme == 'file':
        host, slash, path = rest[2:].partition('/') if rest.startswith('//') else ('', '', rest)
        path = slash + path
        if host not in ('', 'localhost') or not path.startswith('/'):
            raise ValueError(
                f'{address!r} is not the address of a file on this machine; expected an absolute '
                'path after file://, such as file:///robots/leg.stl'
            )
        return urllib.parse.unquote(path)
    package, _, inside = rest.lstrip('/').partition('/')
    if scheme != 'package':
        raise ValueError(
            f'{address!r} cannot be read; expected a path, or an address that begins with '
            'package:// or file://'
        )
    places = [
        parent / part
        for parent in file.resolve().parents
        for part in (inside, f'{package}/{inside}')
    ]
    found = next((place for place in places if place.is_file()), None)
    if found is None:
        raise ValueError(
            f'there is no {inside!r}, from the address {address!r}, in the folders that contain the '
            'model; expected the model inside its package'
        )
    return str(found)


def _is_foreign(path: pathlib.Path) -> bool:
    """Whether a mesh is in a format of `CONVERTED`."""
    suffix = path.suffix.lower()
    if suffix != '.stl':
        return suffix in CONVERTED
    with path.open('rb') as content:
        head = content.read(84)
    binary = len(head) == 84 and path.stat().st_size == 84 + 50 * int.from_bytes(
        head[80:], 'little'
    )
    return head.startswith(b'solid') and not binary


def _unit(path: pathlib.Path) -> float:
    """Returns the unit of a COLLADA file, m; programs of ROS apply it, and ignore its up axis."""
    try:
        tree = etree.parse(path, etree.XMLParser(resolve_entities=False))
    except etree.XMLSyntaxError as error:
        raise ValueError(f'{path}: cannot be read as a mesh ({error})') from None
    if tree.docinfo.doctype:
        raise ValueError(f'{path}: expected no document type, which may define entities')
    meter = tree.find('{*}asset/{*}unit')
    return 1.0 if meter is None else float(meter.get('meter', 1))


def _triangles(path: pathlib.Path) -> tuple[np.ndarray, np.ndarray]:
    """Returns corners (k, 3) m and faces (m, 3) of a mesh that trimesh reads."""
    import trimesh  # takes time, and few files need it

    from trl_suite.terrain.mesh import read_triangles

    if path.suffix.lower()[1:] not in trimesh.available_formats():
        raise ValueError(
            f'{path}: {libraries.missing("pycollada", "pycollada")}, or convert the mesh to .stl '
            'or .obj'
        )
    unit = _unit(path) if path.suffix.lower() == '.dae' else 1.0
    triangles = read_triangles(path)
    corners, faces = np.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)
    return unit * corners, faces.reshape(-1, 3)
