"""What tasks measure of a body, planar or spatial, and its observation blocks and controls.

The heading frame of a body has its origin on the ground under the root, x along the root's heading, y to
the left and z up. A planar body is measured as a spatial one in the plane y = 0 with heading 0; while its
trunk points backwards, only `cosine` is -1, so that x of its heading frame points backwards, too. Rules
that are written for measurements are for both.
"""

from __future__ import annotations

import abc
import math
from typing import Any, NamedTuple

import numpy as np

from trl_suite.actuation.action_map import ActionMap, Drive
from trl_suite.bodies.blocks import Block, columns, slices
from trl_suite.bodies.state import FLAG, PLACE, REAL, allocated
from trl_suite.characters import Character
from trl_suite.engine import World, native
from trl_suite.util.compiled import Compiled, compiled, compiled_inline, packed

MAX_JOINT_SPEED = 200.0  # rad/s; above it a simulation counts as diverged
CLEARANCE = 0.001  # m; between links and ground after the initial placement


class Measurement(NamedTuple):
    """What is measured of n bodies.

    Attributes:
      root, com: positions of the root and of the centre of mass, (n, 3) m.
      heading: heading of the root, rad to the left of +x, (n,).
      cosine, sine: cosine and sine of the heading, (n,).
      under: height of the ground under the root, (n,) m.
      feet: world positions of the end effectors' joints, (n, E, 3) m.
      com_velocity: velocity of the centre of mass, world axes, (n, 3) m/s.
      contact: 1 where an end effector touches the ground, (n, E).
      fallen: whether a fall link touches the ground, (n,).
      pose, velocity: the observation blocks of these names.
      features: features to compare with a reference, (n, F); see `feature_columns`.
    """

    feet: np.ndarray
    contact: np.ndarray
    pose: np.ndarray
    velocity: np.ndarray
    features: np.ndarray
    root: np.ndarray = PLACE
    com: np.ndarray = PLACE
    heading: np.ndarray = REAL
    cosine: np.ndarray = REAL
    sine: np.ndarray = REAL
    under: np.ndarray = REAL
    com_velocity: np.ndarray = PLACE
    fallen: np.ndarray = FLAG


def feature_columns(rotations: int, angles: int, rates: int, effectors: int) -> dict[str, slice]:
    """Returns name -> columns of the features of a body, from the number of numbers of each.

    `rotations`: quaternions of the root without its heading and of the ball joints; `angles`: of
    the hinges, and of a planar root first, rad; `rates`: of the root in the heading frame and of all
    joints, rad/s; `effectors`: end effector positions in the heading frame (in the plane in world
    axes), x and y from the centre of mass or the root, z above the ground, m; `com_velocity`: in world
    axes, m/s; `height`: of the root above the ground, m.
    """
    sizes = {
        'rotations': rotations,
        'angles': angles,
        'rates': rates,
        'effectors': 3 * effectors,
        'com_velocity': 3,
        'height': 1,
    }
    return slices(sizes)


@compiled_inline
def ahead_and_left(i: int, x: float, y: float, measurement: Measurement) -> tuple[float, float]:
    """Converts a horizontal vector from world axes to the heading frame."""
    cosine, sine = measurement.cosine[i], measurement.sine[i]
    return cosine * x + sine * y, cosine * y - sine * x


@compiled_inline
def polar(i: int, x: float, y: float, measurement: Measurement) -> tuple[float, float]:
    """Returns bearing (rad to the left) and length of a horizontal vector in world axes."""
    ahead, left = ahead_and_left(i, x, y, measurement)
    return math.atan2(left, ahead), math.sqrt(ahead * ahead + left * left)


class Travel(NamedTuple):
    """Start and distance travelled of each body.

    Attributes:
      origin: x, y (m) and heading (rad) at the start, (n, 3).
      distance: distance of the root from the start, (n,) m.
    """

    origin: np.ndarray = PLACE
    distance: np.ndarray = REAL


@compiled
def write_distance(i: int, along: bool, measurement: Measurement, travel: Travel) -> None:
    """Writes the distance of the root from the start, along the first heading or in any direction."""
    x = measurement.root[i, 0] - travel.origin[i, 0]
    y = measurement.root[i, 1] - travel.origin[i, 1]
    if along:
        travel.distance[i] = math.cos(travel.origin[i, 2]) * x + math.sin(travel.origin[i, 2]) * y
    else:
        travel.distance[i] = math.sqrt(x * x + y * y)


class BodyData(NamedTuple):
    """A body in all simulations, for compiled functions.

    Attributes:
      ids: its ids, `PlanarIds` or `SpatialIds`.
      physics: `PlanarState` or `SpatialState`.
      ground: windows of the ground.
      ctrl: controls of the physics, (n, ...).
      columns: first columns of its blocks in the observation; -1: not observed.
      observation: to which its blocks are written, (n, ...).
      leaving: whether the body has left the middle of its ground window, which must then be moved, (n,).
      diverged: whether the physics has diverged, or the body has left its ground, (n,).
    """

    engine: native.Engine
    ids: Any
    physics: Any
    ground: Any
    drive: Drive
    ctrl: np.ndarray
    measurement: Measurement
    columns: Any
    observation: np.ndarray
    leaving: np.ndarray
    diverged: np.ndarray


class Body(abc.ABC):
    """One body in every simulation of a world.

    Attributes:
      character, arena: the character, attached to the arena.
      blocks: its observation blocks: terrain, pose, velocity, and strain of muscles.
      columns: columns of the features in `Measurement`, after `bind`.
      ids: its ids in the compiled model.
      data: ids, physics, ground and measurement, for compiled functions.
      measurement: the last measurement.
      pose_qpos, pose_dof: addresses of the columns of a pose and of a velocity.
      links, effectors: body ids, in link order.
      geoms: ids of the collision geoms.
    """

    fields: tuple[str, ...] = ()  # further fields of MjData to bind, see `World`
    control_all: Compiled
    measure_all: Compiled
    physics_fields: Any  # type of `data.physics`: fields of MjData that are measured
    character: Character
    arena: Any
    blocks: tuple[Block, ...]
    columns: dict[str, slice]
    data: Any
    pose_qpos: np.ndarray
    pose_dof: np.ndarray
    _world: World

    def _add_sensor(self, link: str, kind: str, **ground: Any) -> str:
        """Adds a sensor of the contacts between a link and the ground; returns its name."""
        model = self.character.mjcf_model
        name, body = f'{model.model}_{link}_{kind}', model.find('body', link)
        contact = {'body1': body, 'num': 1, 'data': 'found', **ground}
        self.arena.mjcf_model.sensor.add('contact', name=name, **contact)
        return name

    def bind(
        self,
        world: World,
        action_map: ActionMap,
        observation: np.ndarray,
        observed: tuple[Block, ...],
        about_com: bool = True,
    ) -> None:
        """Resolves ids in a compiled world.

        Args:
          world: the simulations.
          action_map: the map from actions to the actuators of the joints.
          observation: array to which the body's blocks are written, (n, ...).
          observed: the blocks of this array, of which some are the body's.
          about_com: whether end effector positions are relative to the centre of mass, not to the root.
        """
        self._world, character = world, self.character
        self.arena.bind(world)
        self.links = world.body_ids([body.full_identifier for body in character.bodies])
        self.effectors = world.body_ids([b.full_identifier for b in character.end_effectors])
        self.geoms = world.geom_ids([g.full_identifier for g in character.collision_geoms])
        mass, scope = world.models[0].body_mass[self.links], f'{character.mjcf_model.model}/'
        self._share = mass / mass.sum()
        self.ids = self._resolve(about_com)
        first = world.control_addresses([scope + action_map.actuators[0]])[0]  # of consecutive ones
        sizes = {block.name: block.size for block in self.blocks}
        self.measurement = allocated(
            Measurement,
            world.n,
            feet=np.zeros((len(self.effectors), 3)),
            contact=np.zeros(len(self.effectors)),
            pose=np.zeros(sizes['pose']),
            velocity=np.zeros(sizes['velocity']),
            features=np.zeros(self.columns['height'].stop),
        )
        self.data = BodyData(
            engine=world.engine,
            ids=self.ids,
            physics=self.physics_fields(*(getattr(world, n) for n in self.physics_fields._fields)),
            ground=self._ground(),
            drive=action_map.drive(int(first)),
            ctrl=world.ctrl,
            measurement=self.measurement,
            columns=columns(observed, self.blocks),
            observation=observation,
            leaving=np.zeros(world.n, bool),
            diverged=np.zeros(world.n, bool),
        )
        self.pack = packed(self.data)

    @abc.abstractmethod
    def _resolve(self, about_com: bool) -> Any:
        """Returns the ids of the body; sets `pose_qpos`, `pose_dof` and `columns`."""

    @abc.abstractmethod
    def _ground(self) -> Any:
        """Returns the ground of all simulations, for compiled functions."""

    def apply_action(self, action: np.ndarray, env_ids: np.ndarray) -> None:
        """Writes the controls of some simulations; moves ground windows if necessary.

        Args:
          action: actions of all simulations, (n, k), which are clipped to [-1, 1].
          env_ids: indices of simulations.
        """
        if self.control_all(env_ids, action, self.pack):
            self.recentre(env_ids[self.data.leaving[env_ids]])

    @abc.abstractmethod
    def recentre(self, env_ids: np.ndarray) -> None:
        """Moves the ground windows of some simulations to the positions of their bodies."""

    @abc.abstractmethod
    def heights(self, env_ids: np.ndarray, places: np.ndarray) -> np.ndarray:
        """Returns the heights of the ground of some simulations (m,) at places (m, 2), m."""

    @abc.abstractmethod
    def level_ground(self, n: int) -> Any:
        """Returns level ground of height 0 for n bodies, for compiled functions."""

    def measure(self, env_ids: np.ndarray | None = None, stepped: bool = False) -> Measurement:
        """Measures the bodies of some simulations, or of all, and writes their observation blocks.

        Args:
          env_ids: indices of simulations.
          stepped: whether the physics was advanced: `data.diverged` is then written, and bodies
            whose physics has diverged, or that have left their ground, keep the last measurement.

        Returns:
          The measurement of all simulations.
        """
        self.measure_all(self._world.all_ids if env_ids is None else env_ids, stepped, self.pack)
        return self.measurement
