"""A character: links and joints from an MJCF file, and parameters that MJCF cannot express."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from dm_control import composer, mjcf

from trl_suite.util import errors, resources
from trl_suite.util.options import Range, checked

GROUP_COLLISION = 3  # geom group of the collision boxes; group 0 has the visual geoms
DIGITS = 6  # decimals of the values in a digest
# The fields of a model whose values are in a digest.
_OF_BODIES = (
    *('body_mass', 'body_inertia', 'body_ipos', 'body_pos', 'body_quat'),
    *('jnt_type', 'jnt_pos', 'jnt_axis', 'jnt_range', 'jnt_actfrcrange'),
)
_OF_GEOMS = ('geom_size', 'geom_pos', 'geom_quat', 'geom_friction')


@dataclasses.dataclass(frozen=True)
class Joint:
    """Parameters of one actuated joint that its MJCF element does not contain.

    Units are those of a revolute joint (hinge). For a prismatic joint (slide) read m for rad and N
    for N m throughout; a spherical joint (ball) has the same gains about every axis. The type of a
    joint is that of its MJCF element.

    Attributes:
      kp: position gain, N m/rad.
      kd: damping gain, N m s/rad.
      weight: weight in the pose and velocity terms of the imitation reward, before normalisation.
      target: working posture of position control, rad; for a ball joint a rotation vector, or 0.
      original_range: limits in rad by which the original scales position actions, if they differ
        from the joint's limits; for a spherical joint the extremes over its three axes.
      armature: inertia in kg m^2 that is added so that stiff servos of light links are stable.

    Raises:
      ValueError: a gain, a weight or an armature is negative, or a value is not finite or has the
        wrong shape.
    """

    kp: float
    kd: float
    weight: float
    target: float | tuple[float, float, float] = 0.0
    original_range: tuple[float, float] | None = None
    armature: float = 0.01

    def __post_init__(self) -> None:
        for name in ('kp', 'kd', 'weight', 'armature'):
            checked(f'{name} of a joint', getattr(self, name), float, at_least=0)
        if self.original_range is not None:
            checked('original_range of a joint', self.original_range, Range)
            if not np.ndim(self.original_range):
                raise ValueError(
                    f'original_range of a joint is {self.original_range}; expected two limits'
                )
        if np.shape(errors.floats('target of a joint', self.target)) not in ((), (3,)):
            raise ValueError(
                f'target of a joint is {self.target!r}; expected a number, or a rotation vector'
            )


@dataclasses.dataclass(frozen=True)
class CharacterSpec:
    """One character as data.

    Attributes:
      name: name of the character and of its MJCF file under xml/.
      joints: joints by name in link order; link i+1 is the child of joint i and has its name.
      fall_links: links whose contact with the ground is a fall.
      end_effectors: links whose joint positions are compared by the imitation reward.
      stumble_exempt: links that may touch the ground without a stumble.
      description: one line.
      root_weight: weight of the root in the imitation reward.
      spatial: whether its root is free in three dimensions, instead of moving in the x-z plane.
      xml, assets: MJCF text instead of a file, and its meshes and pictures by name.
      bodies: names of the links, root first, if they are not 'root' and those of the joints.
      collision_geoms: names of the geoms that can touch the ground; by default one for each link,
        with its name, unless its default class is group0.
      notes: assumptions that were made about the character, as sentences.
      clip: name of the clip in mocap/ that it tracks by default.
      torque_curves: name of its torque limits by joint angle, see `actuation.strength_curves`.
      differences: sentences on differences from the original, by actuation model or 'gait'.
    """

    name: str
    joints: Mapping[str, Joint]
    fall_links: tuple[str, ...]
    end_effectors: tuple[str, ...]
    stumble_exempt: tuple[str, ...]
    description: str
    root_weight: float = 1.0
    spatial: bool = False
    xml: str | None = dataclasses.field(default=None, repr=False)
    assets: Mapping[str, bytes] = dataclasses.field(default_factory=dict, repr=False)
    bodies: tuple[str, ...] | None = None
    collision_geoms: tuple[str, ...] | None = None
    notes: tuple[str, ...] = ()
    clip: str | None = None
    torque_curves: str | None = None
    differences: Mapping[str, tuple[str, ...]] = dataclasses.field(default_factory=dict, repr=False)

    @property
    def links(self) -> tuple[str, ...]:
        """Names of all links, root first, in the order of all arrays per link."""
        return ('root', *self.joints) if self.bodies is None else self.bodies

    @property
    def mirror(self) -> tuple[tuple[str, str], ...]:
        """Pairs of right and left joints (and links); none for characters with `bodies`."""
        if self.bodies is not None:
            return ()
        return tuple(
            (name, name.replace('right_', 'left_', 1))
            for name in self.joints
            if name.startswith('right_')
        )

    @functools.cached_property
    def weights(self) -> np.ndarray:
        """Normalised reward weights of root and joints, shape (1 + number of joints,)."""
        raw = np.array([self.root_weight, *(joint.weight for joint in self.joints.values())])
        return raw / raw.sum()

    @functools.cached_property
    def digest(self) -> str:
        """Name and digest of all physical properties, gains included; compiles the character.

        Independent of visual properties and of the formatting of the MJCF.
        """
        model = mjcf.Physics.from_mjcf_model(Character(self).mjcf_model).model
        figures: list[Any] = [getattr(model, name) for name in _OF_BODIES]
        figures += [getattr(model, name)[_solid(self, model)] for name in _OF_GEOMS]
        figures.append([(joint.kp, joint.kd, joint.armature) for joint in self.joints.values()])
        digest = hashlib.sha256()
        for array in figures:
            digest.update((np.asarray(array, float).round(DIGITS) + 0.0).tobytes())
        return f'{self.name} {digest.hexdigest()[:16]}'


class Character(composer.Entity):
    """An articulated figure, planar or in three dimensions, that can be attached to any arena.

    The entity owns its MJCF tree. Gains, limits and muscles become actuators
    only when an actuation model is added (see `trl_suite.actuation`).
    """

    def _build(self, spec: CharacterSpec, name: str | None = None) -> None:
        self.spec = spec
        if spec.xml is not None:
            self._mjcf_root = mjcf.from_xml_string(spec.xml, assets=dict(spec.assets))
        else:
            self._mjcf_root = mjcf.from_path(str(resources.directory('xml') / f'{spec.name}.xml'))
        if name is not None:
            self._mjcf_root.model = name
        # Names that the file lacks raise here.
        _ = *self.joints, *self.bodies, *self.end_effectors
        for (joint, given), (low, high), ball in zip(
            spec.joints.items(), self.joint_ranges, self.spherical, strict=True
        ):
            if np.ndim(given.target) and not ball:
                raise ValueError(
                    f'character {spec.name!r}: target of {joint!r} is {given.target}; expected a number, as '
                    'it is no ball joint'
                )
            if ball and not np.ndim(given.target) and given.target:
                raise ValueError(
                    f'character {spec.name!r}: target of {joint!r} is {given.target}; expected a rotation '
                    'vector, or 0, as it is a ball joint'
                )
            target = np.linalg.norm(given.target) if np.ndim(given.target) else given.target
            if not low - 1e-6 <= target <= high + 1e-6:
                raise ValueError(
                    f'character {spec.name!r}: target of {joint!r} is {target:g}; expected {low:g} to '
                    f'{high:g}, its limits'
                )

    @property
    def mjcf_model(self) -> mjcf.RootElement:
        return self._mjcf_root

    def create_root_joints(self, frame: mjcf.Element) -> tuple[mjcf.Element, ...]:
        """Adds the root joints of an attached character: in three dimensions, or in the x-z plane.

        Args:
          frame: the attachment frame that `arena.attach(character)` returned.

        Returns:
          The joints root_x (m), root_z (m) and root_pitch (rad, positive lifts the front); of a
          spatial character one free joint, root.
        """
        if self.spec.spatial:
            return (frame.add('freejoint', name='root'),)
        root = {'limited': False, 'damping': 0, 'armature': 0}
        return (
            frame.add('joint', name='root_x', type='slide', axis=(1, 0, 0), **root),
            frame.add('joint', name='root_z', type='slide', axis=(0, 0, 1), **root),
            frame.add('joint', name='root_pitch', type='hinge', axis=(0, -1, 0), **root),
        )

    @property
    def root_body(self) -> mjcf.Element:
        return self._find('body', self.spec.links[0])

    @property
    def bodies(self) -> list[mjcf.Element]:
        """Bodies in link order, the root body first."""
        return [self._find('body', name) for name in self.spec.links]

    @property
    def joints(self) -> list[mjcf.Element]:
        """Actuated joints in link order."""
        return [self._find('joint', name) for name in self.spec.joints]

    @property
    def end_effectors(self) -> list[mjcf.Element]:
        return [self._find('body', name) for name in self.spec.end_effectors]

    @property
    def collision_geoms(self) -> list[mjcf.Element]:
        """The geoms that can touch the ground; shipped characters have at most one per link."""
        if self.spec.collision_geoms is not None:
            return [self._find('geom', name) for name in self.spec.collision_geoms]
        geoms = [self._find('geom', name) for name in self.spec.links]
        return [geom for geom in geoms if geom.contype != 0 or geom.conaffinity != 0]

    @property
    def prismatic(self) -> np.ndarray:
        """Which joints are prismatic, shape (number of joints,) bool."""
        return np.array([joint.type == 'slide' for joint in self.joints])

    @property
    def spherical(self) -> np.ndarray:
        """Which joints are ball joints, shape (number of joints,) bool."""
        return np.array([joint.type == 'ball' for joint in self.joints])

    @property
    def dofs(self) -> np.ndarray:
        """Degrees of freedom: 3 of a ball joint, otherwise 1, shape (number of joints,) int."""
        return np.where(self.spherical, 3, 1)

    @property
    def torque_limits(self) -> np.ndarray:
        """Largest joint torques in N m, forces in N where prismatic, shape (number of joints,).

        For a ball joint the largest norm.
        """
        return np.array([joint.actuatorfrcrange[1] for joint in self.joints])

    @property
    def joint_ranges(self) -> np.ndarray:
        """Joint limits in rad, in m where prismatic, shape (number of joints, 2); infinite if free.

        For a ball joint 0 and the largest angle of its rotation.
        """
        free = (-np.inf, np.inf)
        return np.array([free if joint.range is None else joint.range for joint in self.joints])

    def _find(self, namespace: str, name: str) -> mjcf.Element:
        element = self._mjcf_root.find(namespace, name)
        if element is None:
            file = f'xml/{self.spec.name}.xml' if self.spec.xml is None else 'its XML'
            raise ValueError(
                f'character {self.spec.name!r}: {file} has no {namespace} named {name!r}'
            )
        return element


def body_figures(character: Character) -> dict[str, Any]:
    """Compiles a character alone and returns its whole-body properties in the zero pose.

    Returns:
      A dict of total `mass` (kg), `com` relative to the root (m, (3,)), `inertia` about the centre
      of mass (kg m^2, diagonal (3,)) and `standing_height` of the root above the sole (m).
    """
    physics = mjcf.Physics.from_mjcf_model(character.mjcf_model)
    model, data = physics.model, physics.data  # body 1 is the root
    low, _ = extent(model, data, np.flatnonzero(_solid(character.spec, model)))
    return {
        'mass': float(model.body_subtreemass[1]),
        'com': data.subtree_com[1].copy(),
        'inertia': data.crb[1, :3].copy(),
        'standing_height': -float(low[2]),
    }


def extent(model: Any, data: Any, geoms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the lowest and the highest corner, (3,) m, of the bounding box of geoms."""
    axes, boxes = data.geom_xmat[geoms].reshape(-1, 3, 3), model.geom_aabb[geoms]
    middle = data.geom_xpos[geoms] + np.einsum('nij,nj->ni', axes, boxes[:, :3])
    half = np.einsum('nij,nj->ni', np.abs(axes), boxes[:, 3:])
    return (middle - half).min(0), (middle + half).max(0)


def _solid(spec: CharacterSpec, model: Any) -> np.ndarray:
    """Which geoms of a character compiled alone are physical, not only visual, (geoms,) bool."""
    if spec.collision_geoms is None:
        return model.geom_group == GROUP_COLLISION
    return np.isin([model.id2name(i, 'geom') for i in range(model.ngeom)], spec.collision_geoms)
