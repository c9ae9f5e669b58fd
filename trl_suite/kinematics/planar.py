"""Measurements of a planar character on planar ground, for all planar tasks."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from trl_suite.actuation.action_map import Drive, drive
from trl_suite.engine import native
from trl_suite.terrain.planar import windows as planar_ground
from trl_suite.terrain.planar.windows import PlanarWindows
from trl_suite.util.compiled import compiled

MAX_JOINT_SPEED = 200.0  # rad/s; above it a simulation counts as diverged
_UPRIGHT = np.pi / 2  # rad; below this pitch a trunk points forwards


class PlanarIds(NamedTuple):
    """A character's ids in a compiled model; links and joints in link order.

    Attributes:
      qpos, dof: addresses of x, z, pitch and the joints, (3 + J,).
      links: body ids, the root body first, (L,).
      effectors: body ids of the end effectors, (E,).
      share: mass of each link over the total mass, (L,).
      about_com: whether end effector positions are relative to the centre of mass, not to the root.
      samples: x of observed ground heights, relative to the root, (S,) m.
      fall, contact: addresses of contact sensors of fall links and of end effectors.
      terrain, pose, velocity: first columns of these blocks in an observation.
    """

    qpos: np.ndarray
    dof: np.ndarray
    links: np.ndarray
    effectors: np.ndarray
    share: np.ndarray
    about_com: bool
    samples: np.ndarray
    fall: np.ndarray
    contact: np.ndarray
    terrain: int
    pose: int
    velocity: int


class PlanarState(NamedTuple):
    """Fields of the physics that planar tasks read, each (n, ...); see `engine.World`."""

    qpos: np.ndarray
    qvel: np.ndarray
    xpos: np.ndarray
    xipos: np.ndarray
    cvel: np.ndarray
    subtree_com: np.ndarray
    sensordata: np.ndarray
    ten_length: np.ndarray


class PlanarMeasurement(NamedTuple):
    """Results of `measure` in addition to the observation.

    Attributes:
      facing: 1, or -1 while the trunk points backwards, (n,).
      under: height of the ground under the root, (n,) m.
      height: height of the root above the ground, (n,) m.
      effectors: end effectors: all x relative to the centre of mass, or to the root, then all z
        above the ground, (n, 2 * E) m.
      com_velocity: velocity of the centre of mass, (n, 2) m/s.
    """

    facing: np.ndarray
    under: np.ndarray
    height: np.ndarray
    effectors: np.ndarray
    com_velocity: np.ndarray


class PlanarBodyData(NamedTuple):
    """A character in all simulations, for compiled functions.

    Attributes:
      ctrl: controls of the physics, (n, ...).
      leaving: whether the character has left its ground window, which must then be moved, (n,).
    """

    engine: native.Engine
    ids: PlanarIds
    physics: PlanarState
    ground: PlanarWindows
    drive: Drive
    ctrl: np.ndarray
    measurement: PlanarMeasurement
    leaving: np.ndarray


def empty_measurement(n: int, body: PlanarIds) -> PlanarMeasurement:
    """Allocates the results of `measure` for n characters."""
    return PlanarMeasurement(
        np.ones(n), np.zeros(n), np.zeros(n), np.zeros((n, 2 * len(body.effectors))),
        np.zeros((n, 2)),
    )  # fmt: skip


@compiled
def measure(
    i: int, body: PlanarIds, state: PlanarState, ground: PlanarWindows, observation: np.ndarray,
    measurement: PlanarMeasurement,
) -> None:  # fmt: skip
    """Writes the blocks terrain, pose and velocity, and the other measurements.

    Positions are relative to the root, heights to the ground under it; x is mirrored while the trunk
    points backwards.
    """
    pitch = state.qpos[i, body.qpos[2]]
    facing = -1.0 if abs(pitch) > _UPRIGHT and math.cos(pitch) < 0.0 else 1.0
    x, z = state.qpos[i, body.qpos[0]], state.qpos[i, body.qpos[1]]
    root = body.links[0]
    com_x, com_z = state.subtree_com[i, root, 0], state.subtree_com[i, root, 2]
    under = planar_ground.height(i, x, ground)
    measurement.facing[i], measurement.under[i], measurement.height[i] = facing, under, z - under

    speed_x = speed_z = 0.0
    observation[i, body.pose] = z - under
    for k in range(len(body.links)):
        link = body.links[k]
        link_x, link_z = state.xipos[i, link, 0], state.xipos[i, link, 2]
        # Spatial velocities are about the centre of mass of the whole tree: v + w x r.
        spin = state.cvel[i, link, 1]
        v_x = state.cvel[i, link, 3] + (link_z - com_z) * spin
        v_z = state.cvel[i, link, 5] - (link_x - com_x) * spin
        speed_x += v_x * body.share[k]
        speed_z += v_z * body.share[k]
        observation[i, body.pose + 1 + 2 * k] = (link_x - x) * facing
        observation[i, body.pose + 2 + 2 * k] = link_z - z
        observation[i, body.velocity + 2 * k] = v_x * facing
        observation[i, body.velocity + 2 * k + 1] = v_z
    measurement.com_velocity[i, 0], measurement.com_velocity[i, 1] = speed_x, speed_z

    for k in range(len(body.samples)):
        level = planar_ground.height(i, x + body.samples[k] * facing, ground)
        observation[i, body.terrain + k] = level - under
    count = len(body.effectors)
    about = com_x if body.about_com else state.xpos[i, root, 0]
    for k in range(count):
        place = state.xpos[i, body.effectors[k], 0]
        level = planar_ground.height(i, place, ground)
        measurement.effectors[i, k] = place - about
        measurement.effectors[i, count + k] = state.xpos[i, body.effectors[k], 2] - level


@compiled
def has_fallen(i: int, body: PlanarIds, state: PlanarState) -> bool:
    """Returns whether a fall link touches the ground."""
    for sensor in body.fall:
        if state.sensordata[i, sensor] != 0.0:
            return True
    return False


@compiled
def is_lost(i: int, body: PlanarIds, state: PlanarState, ground: PlanarWindows) -> bool:
    """Returns whether a character is where no ground is drawn; its episode then ends as diverged."""
    return planar_ground.is_lost(i, state.qpos[i, body.qpos[0]], ground)


@compiled
def leaves(i: int, body: PlanarIds, state: PlanarState, ground: PlanarWindows) -> bool:
    """Returns whether a character has left its ground window, which must be moved."""
    return planar_ground.has_left(i, state.qpos[i, body.qpos[0]], ground)


@compiled
def look(i: int, body: PlanarBodyData, observation: np.ndarray) -> None:
    """Measures a character, and writes the blocks terrain, pose and velocity."""
    measure(i, body.ids, body.physics, body.ground, observation, body.measurement)


@compiled
def breaks_down(i: int, body: PlanarBodyData) -> bool:
    """Returns whether a simulation diverged or a character left its ground."""
    return (
        native.diverged(i, body.engine)
        or native.too_fast(i, body.ids.dof[2:], MAX_JOINT_SPEED, body.physics.qvel)
        or is_lost(i, body.ids, body.physics, body.ground)
    )


@compiled
def control_all(env_ids: np.ndarray, action: np.ndarray, body: PlanarBodyData) -> int:
    """Writes controls; returns how many ground windows must be moved. Takes a pack."""
    leaving = 0
    for i in env_ids:
        drive(i, action, body.drive, body.ctrl)
        body.leaving[i] = leaves(i, body.ids, body.physics, body.ground)
        leaving += body.leaving[i]
    return leaving
