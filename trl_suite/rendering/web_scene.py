"""A simulation shown by a viser server: the geoms that MuJoCo's renderer would draw, as meshes.

`mujoco.mjv_updateScene` fills a scene with geoms, and overlays append others. All geoms of one shape
become one batched mesh, so that a frame takes few messages. The package `mjviser` is not used: it
builds static geometry once and follows the first body that moves, whereas terrain changes during an
episode here, and the first body that moves need not be the character.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Any

import mujoco
import numpy as np

from trl_suite.arenas import PlanarArena
from trl_suite.arenas.scene import PARKED
from trl_suite.rendering.overlays import Overlay, root_joint
from trl_suite.rendering.web_meshes import (
    SHADES,
    TILE,
    ground_meshes,
    planar_mesh,
    shape_mesh,
    squares,
    to_bytes,
)

REACH = 24.0  # m; distance along x and y within which the ground has squares
NEAR_REACH = 12.0  # m; the same for large boxes, as there may be many, like those of stairs
STRIDE = 8.0  # m; distance by which the part of large boxes that has squares moves
LIFT = 0.1  # fraction of a height difference by which the view moves per frame
ROOM = 2000  # largest number of geoms of overlays and decoration
FAR_BELOW = 0.5 * PARKED  # m; geoms so far below the character are unused
AMBIENT = 0.5  # intensity of ambient light; 1 would bleach pale ground
GAMMA = 2.2  # viser expects linear colours of batched meshes; MuJoCo's are gamma-encoded
SHAFT, TIP = 0.8, 0.2  # fractions of the length of an arrow
SAMPLE_COLOUR, SAMPLE_SIZE = (242, 64, 38), 0.05  # points of observed terrain: colour; diameter, m
CAMERA = np.array([0.0, -4.0, 1.0])  # m; position of the camera from the character
FIELD_OF_VIEW = 0.8  # rad
FRONT = 4  # number of a skybox's face

# The second and third: forces on one body, and between two.
_ARROWS = (mujoco.mjtGeom.mjGEOM_ARROW, mujoco.mjtGeom.mjGEOM_ARROW1, mujoco.mjtGeom.mjGEOM_ARROW2)


class WebScene:
    """The scene of a viser server that shows an environment.

    Attributes:
      option: which visual elements MuJoCo draws, e.g. contact forces; a `mujoco.MjvOption`.
      follow: whether the view is centred on the character.
    """

    def __init__(self, server: Any, environment: Any) -> None:
        """Clears the scene of a `viser.ViserServer`; the model must not be recompiled."""
        self.option, self.follow = mujoco.MjvOption(), True
        self._server, self._physics = server, environment.physics
        model = self._model = environment.physics.model.ptr
        self._scene = mujoco.MjvScene(model, maxgeom=2 * model.ngeom + ROOM)
        self._perturbation, self._camera = mujoco.MjvPerturb(), mujoco.MjvCamera()
        self._colours = _texture_colours(model)
        self._is_ground = np.asarray(model.body_weldid[model.geom_bodyid] == 0)
        self._root = root_body(environment)
        arena = getattr(environment.task, 'arena', None)
        self._profile = arena.ground if isinstance(arena, PlanarArena) else None
        self._focus = np.full(3, np.nan)  # the point that the view follows
        self._handles: dict[str, Any] = {}
        self._laid: list[np.ndarray] = []  # data from which the meshes of the ground were made
        self._ground_handles: dict[tuple[int, str, int], Any] = {}
        with server.atomic():
            server.scene.reset()
            server.scene.set_up_direction('+z')
            server.scene.configure_environment_map(environment_intensity=AMBIENT)
            server.scene.set_background_image(_sky(model))
            server.initial_camera.position = CAMERA
            server.initial_camera.look_at = np.zeros(3)
            server.initial_camera.fov = FIELD_OF_VIEW

    def update(
        self,
        overlays: Iterable[Overlay] = (),
        samples: np.ndarray | None = None,
        jump: bool = False,
    ) -> None:
        """Draws the current state.

        Args:
          overlays: functions that append geoms, see `rendering.overlays`.
          samples: points where the terrain is observed, (k, 3) m.
          jump: whether the view moves to the character at once, as at the start of an episode.
        """
        data = self._physics.data.ptr
        options = self.option, self._perturbation, self._camera, mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(self._model, data, *options, self._scene)
        for overlay in overlays:
            overlay(self._physics, self._scene)
        root = np.array(data.xpos[self._root])
        if jump or np.isnan(self._focus[0]):
            self._focus = root
        self._focus = self._focus + (root - self._focus) * (1.0, 1.0, LIFT)
        # Every mesh gets its own position. With a common parent node, clients would apply the
        # position of the parent and those of its children at different times, and the character
        # would shake.
        offset = -self._focus if self.follow else np.zeros(3)
        with self._server.atomic():
            self._draw_shapes(offset)
            self._draw_ground(offset)
            if samples is not None:
                self._draw_samples(samples + offset)
            elif 'samples' in self._handles:
                self._handles['samples'].visible = False

    def look_at_character(self, camera: Any) -> None:
        """Puts the camera of a client, or that of further clients, beside the character."""
        middle = np.zeros(3) if self.follow else self._focus
        camera.position, camera.look_at = middle + CAMERA, middle

    def _draw_shapes(self, offset: np.ndarray) -> None:
        batches: dict[str, list[tuple[Any, ...]]] = {}
        for shape, *instance in _instances(
            self._scene, self._model, self._colours, self._is_ground, self._focus[2] + FAR_BELOW
        ):
            name = shape if instance[-1][3] >= 1 else f'{shape}_clear'
            batches.setdefault(name, []).append(tuple(instance))
        for name, batch in batches.items():
            positions, axes, sizes, colours = (
                np.array(part, float) for part in zip(*batch, strict=True)
            )
            values = {
                'batched_positions': positions + offset,
                'batched_wxyzs': _quaternions(axes),
                'batched_scales': sizes,
                'batched_colors': to_bytes(colours[:, :3] ** GAMMA),
            }
            if name.endswith('_clear'):
                values['batched_opacities'] = colours[:, 3]
            if name in self._handles:
                _assign(self._handles[name], visible=True, **values)
                continue
            mesh = shape_mesh(name.removesuffix('_clear'), self._model)
            values['flat_shading'] = not name.startswith(('sphere', 'tube'))
            self._handles[name] = self._add_mesh(f'/{name}', mesh, **values)
        for name, handle in self._handles.items():
            if name not in batches and name != 'samples':
                handle.visible = False

    def _draw_ground(self, offset: np.ndarray) -> None:
        """Moves the ground; builds its meshes again if the ground has changed."""
        model, data, ground = self._model, self._physics.data.ptr, self._is_ground
        boxes = ground & (model.geom_type == mujoco.mjtGeom.mjGEOM_BOX)
        is_wide = self._profile is None and (model.geom_size[boxes] > REACH).any()
        middle = STRIDE * np.round(self._focus / STRIDE)  # of the squares
        sources = [
            data.geom_xpos[ground],
            data.geom_xmat[ground],
            model.geom_size[ground],
            model.hfield_data,
            middle[:2] * is_wide,
        ]
        if not self._laid or not all(map(np.array_equal, sources, self._laid)):
            self._laid = [source.copy() for source in sources]
            self._lay_ground(middle, NEAR_REACH if is_wide else REACH)
        # Of an infinite plane, a finite part is drawn, which moves by multiples of two squares.
        moved = np.round(self._focus / (2 * TILE)) * 2 * TILE * (1, 1, 0)
        for (_, kind, _), handle in self._ground_handles.items():
            handle.batched_positions = (offset + moved if kind == 'plane' else offset)[None]

    def _lay_ground(self, middle: np.ndarray, reach: float) -> None:
        """Changes meshes in place: clients show the former ones until the new ones are ready."""
        if self._profile is None:
            lowest = self._focus[2] + FAR_BELOW
            meshes = ground_meshes(self._model, self._physics.data.ptr, self._is_ground, lowest)
        else:  # one surface instead of overlapping boxes
            material = int(self._model.geom_matid[self._is_ground][0])
            meshes = {(material, 'boxes'): planar_mesh(self._profile)}
        parts = {
            (material, kind, number): part
            for (material, kind), mesh in meshes.items()
            for number, part in enumerate(
                squares(mesh, np.zeros(3) if kind == 'plane' else middle, reach)
            )
            if len(part.faces)
        }
        for key, part in parts.items():
            if key in self._ground_handles:
                shape = {'vertices': part.vertices, 'faces': part.faces}
                _assign(self._ground_handles[key], visible=True, **shape)
                continue
            material, kind, number = key
            own = self._model.mat_rgba[material, :3] if material >= 0 else 1.0
            colour = SHADES[number] * own * self._colours[material]
            self._ground_handles[key] = self._add_mesh(
                f'/ground_{material}_{kind}_{number}',
                part,
                batched_wxyzs=np.array([[1.0, 0.0, 0.0, 0.0]]),
                batched_positions=np.zeros((1, 3)),
                batched_colors=to_bytes(colour**GAMMA)[None],
                flat_shading=kind != 'field',
                cast_shadow=False,
            )
        for key, handle in self._ground_handles.items():
            if key not in parts:
                handle.visible = False

    def _add_mesh(self, name: str, mesh: Any, **values: Any) -> Any:
        add = self._server.scene.add_batched_meshes_simple
        return add(name, mesh.vertices, mesh.faces, lod='off', **values)

    def _draw_samples(self, points: np.ndarray) -> None:
        points = points.astype(np.float32)
        if 'samples' in self._handles:
            _assign(self._handles['samples'], visible=True, points=points)
        else:
            values = {'point_size': SAMPLE_SIZE, 'point_shape': 'circle', 'precision': 'float32'}
            self._handles['samples'] = self._server.scene.add_point_cloud(
                '/samples', points, SAMPLE_COLOUR, **values
            )


def _assign(handle: Any, **values: Any) -> None:
    for name, value in values.items():
        setattr(handle, name, value)


def root_body(environment: Any) -> int:
    """Returns the id of the character's root body; without a character, of the first moving body."""
    model, task = environment.physics.model, environment.task
    if getattr(task, 'body', None) is None:
        return int(np.flatnonzero(model.body_weldid)[0])
    return int(model.jnt_bodyid[root_joint(model, task)])


def _instances(
    scene: Any, model: Any, texture_colours: np.ndarray, is_ground: np.ndarray, lowest: float
) -> Iterator[tuple[Any, ...]]:
    """Yields shape, position, axes, scales and colour of the geoms in a scene.

    Omits the ground, and geoms below the height `lowest`, m.
    """
    kinds, of_model = mujoco.mjtGeom, int(mujoco.mjtObj.mjOBJ_GEOM)
    for geom in scene.geoms[: scene.ngeom]:
        position, colour, kind = geom.pos.copy(), geom.rgba.copy(), geom.type
        if colour[3] == 0 or position[2] < lowest:
            continue
        if geom.objtype == of_model and is_ground[geom.objid]:
            continue
        axes, size = geom.mat.copy(), geom.size.copy()
        if geom.matid >= 0:
            colour[:3] *= texture_colours[geom.matid]
        if kind == kinds.mjGEOM_BOX:
            yield 'box', position, axes, size, colour
        elif kind in (kinds.mjGEOM_SPHERE, kinds.mjGEOM_ELLIPSOID):
            yield 'sphere', position, axes, size, colour
        elif kind == kinds.mjGEOM_CYLINDER:
            yield 'cylinder', position, axes, size, colour
        elif kind == kinds.mjGEOM_CAPSULE:
            end, ball = size[2] * axes[:, 2], np.full(3, size[0])
            yield 'tube', position, axes, size, colour
            yield 'sphere', position + end, axes, ball, colour
            yield 'sphere', position - end, axes, ball, colour
        elif kind in _ARROWS:
            half, along, width = 0.5 * SHAFT * size[2], axes[:, 2], size[0]
            yield 'cylinder', position + half * along, axes, (width, width, half), colour
            tip = (2 * width, 2 * width, TIP * size[2])
            yield 'cone', position + 2 * half * along, axes, tip, colour
        elif kind == kinds.mjGEOM_MESH:
            yield f'mesh_{model.geom_dataid[geom.objid]}', position, axes, np.ones(3), colour


def _sky(model: Any) -> np.ndarray | None:
    """Returns the sky of a model as a picture, (h, 1, 3) uint8: its colours above the horizon.

    None if it has no sky.
    """
    skies = np.flatnonzero(model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX)
    if not len(skies):
        return None
    pixels = _pixels(model, skies[0])
    size = pixels.shape[1]
    column = pixels[FRONT * size : FRONT * size + size // 2, :1]
    return np.concatenate([column, np.repeat(column[-1:], size // 2, axis=0)])


def _texture_colours(model: Any) -> np.ndarray:
    """Returns the mean colour of each material's texture, (materials + 1, 3); the last is for none.

    Geoms of a scene have the other colour of their material already.
    """
    colours = np.ones((model.nmat + 1, 3))
    textures = model.mat_texid[:, int(mujoco.mjtTextureRole.mjTEXROLE_RGB)]
    for i in np.flatnonzero(textures >= 0):
        colours[i] = _pixels(model, textures[i]).mean((0, 1)) / 255
    return colours


def _pixels(model: Any, texture: int) -> np.ndarray:
    """Returns the red, green and blue of a texture, (height, width, 3) uint8."""
    shape = model.tex_height[texture], model.tex_width[texture], model.tex_nchannel[texture]
    start = model.tex_adr[texture]
    return model.tex_data[start : start + math.prod(shape)].reshape(shape)[..., :3]


def _quaternions(axes: np.ndarray) -> np.ndarray:
    """Returns unit quaternions wxyz, (k, 4), of rotation matrices (k, 3, 3)."""
    found = np.empty((len(axes), 4))
    for quaternion, matrix in zip(found, axes.reshape(-1, 9).astype(float), strict=True):
        mujoco.mju_mat2Quat(quaternion, matrix)
    return found.astype(np.float32)
