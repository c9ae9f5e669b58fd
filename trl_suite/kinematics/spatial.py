"""Measurements of a character in three dimensions, for all spatial tasks.

The heading frame of a character has its origin on the ground under the root, x along the root's
heading, y to the left and z up.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np

from trl_suite.actuation.action_map import Drive, drive
from trl_suite.engine import native
from trl_suite.kinematics.planar import MAX_JOINT_SPEED
from trl_suite.terrain.spatial import windows as spatial_ground
from trl_suite.terrain.spatial.windows import SpatialWindows
from trl_suite.util.compiled import compiled, compiled_inline

LINK_POSE, LINK_VELOCITY = 7, 6  # numbers of each link in the blocks pose and velocity


class SpatialIds(NamedTuple):
    """A character's ids in a compiled model; links and joints in link order.

    Attributes:
      qpos, dof: addresses of the columns of a pose and of a velocity, as `motion.Layout` has them:
        root, then joints.
      joint_dof: addresses of the joints' rates.
      balls: addresses of the quaternions of ball joints, four each.
      hinges: addresses of the angles of the other joints.
      links: body ids, the root body first, (L,).
      effectors: body ids of the end effectors, (E,).
      share: mass of each link over the total mass, (L,).
      about_com: whether end effector positions are relative to the centre of mass, not to the root.
      fall: addresses of the contact sensors of fall links.
      contact: addresses of the contact sensors of end effectors, (E, sensors per end effector).
    """

    qpos: np.ndarray
    dof: np.ndarray
    joint_dof: np.ndarray
    balls: np.ndarray
    hinges: np.ndarray
    links: np.ndarray
    effectors: np.ndarray
    share: np.ndarray
    about_com: bool
    fall: np.ndarray
    contact: np.ndarray


class SpatialState(NamedTuple):
    """Fields of the physics that spatial tasks read, each (n, ...); see `engine.World`."""

    qpos: np.ndarray
    qvel: np.ndarray
    xpos: np.ndarray
    xquat: np.ndarray
    xipos: np.ndarray
    cvel: np.ndarray
    subtree_com: np.ndarray
    sensordata: np.ndarray


class SpatialMeasurement(NamedTuple):
    """Results of `measure` for n simulations.

    Attributes:
      root, com: positions of the root and of the centre of mass, (n, 3) m.
      heading: heading of the root, rad to the left of +x, (n,).
      cosine, sine: cosine and sine of the heading, (n,).
      under: height of the ground under the root, (n,) m.
      feet: world positions of the end effectors' joints, (n, E, 3) m.
      com_velocity: velocity of the centre of mass, world axes, (n, 3) m/s.
      contact: 1 where an end effector touches the ground, (n, E).
      fallen: whether a fall link touches the ground, (n,).
      pose: height of the root above the ground, then for each link the position of its centre from
        the root (3) and its orientation (4), w not negative, in the heading frame, (n, 7L + 1).
      velocity: for each link the velocity of its centre relative to the ground under the root (3)
        and its angular velocity (3), in the heading frame, (n, 6L).
      features: features to compare with a reference, (n, F); see `feature_columns`.
    """

    root: np.ndarray
    com: np.ndarray
    heading: np.ndarray
    cosine: np.ndarray
    sine: np.ndarray
    under: np.ndarray
    feet: np.ndarray
    com_velocity: np.ndarray
    contact: np.ndarray
    fallen: np.ndarray
    pose: np.ndarray
    velocity: np.ndarray
    features: np.ndarray


def empty_measurement(n: int, body: SpatialIds) -> SpatialMeasurement:
    """Allocates the results of `measure` for n characters."""
    links, effectors = len(body.links), len(body.effectors)
    columns = feature_columns(body)
    return SpatialMeasurement(
        np.zeros((n, 3)), np.zeros((n, 3)), np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n),
        np.zeros((n, effectors, 3)),
        np.zeros((n, 3)), np.zeros((n, effectors)), np.zeros(n, bool),
        np.zeros((n, LINK_POSE * links + 1)), np.zeros((n, LINK_VELOCITY * links)),
        np.zeros((n, columns['height'].stop)),
    )  # fmt: skip


def feature_columns(body: SpatialIds) -> dict[str, slice]:
    """Returns name -> columns of the features of a character.

    `rotations`: quaternions of the root without its heading and of the ball joints; `angles`: of
    the hinges, rad; `rates`: of the root in the heading frame and of all joints, rad/s;
    `effectors`: end effector positions in the heading frame, x and y from the centre of mass or the
    root (see `SpatialIds.about_com`), z above the ground, m; `com_velocity`: in world axes, m/s;
    `height`: of the root above the ground, m.
    """
    sizes = {
        'rotations': 4 + len(body.balls), 'angles': len(body.hinges),
        'rates': 3 + len(body.joint_dof), 'effectors': 3 * len(body.effectors),
        'com_velocity': 3, 'height': 1,
    }  # fmt: skip
    stops = itertools.accumulate(sizes.values())
    return {
        name: slice(stop - size, stop)
        for (name, size), stop in zip(sizes.items(), stops, strict=True)
    }


@compiled
def is_lost(i: int, body: SpatialIds, state: SpatialState, ground: SpatialWindows) -> bool:
    """Returns whether a character is where there is no ground; its episode then ends as diverged."""
    root = state.xpos[i, body.links[0]]
    return spatial_ground.is_lost(i, root[0], root[1], root[2], ground)


@compiled
def measure(
    i: int, body: SpatialIds, state: SpatialState, ground: SpatialWindows,
    measurement: SpatialMeasurement,
) -> None:  # fmt: skip
    """Measures the character of simulation i."""
    body_id = body.links[0]
    root_x, root_y, root_z = (
        state.xpos[i, body_id, 0], state.xpos[i, body_id, 1], state.xpos[i, body_id, 2],
    )  # fmt: skip
    com_x, com_y, com_z = (
        state.subtree_com[i, body_id, 0], state.subtree_com[i, body_id, 1],
        state.subtree_com[i, body_id, 2],
    )  # fmt: skip
    w, x = state.xquat[i, body_id, 0], state.xquat[i, body_id, 1]
    y, z = state.xquat[i, body_id, 2], state.xquat[i, body_id, 3]
    heading = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    cosine, sine = math.cos(heading), math.sin(heading)
    half_cosine, half_sine = math.cos(0.5 * heading), -math.sin(0.5 * heading)
    under = spatial_ground.height(i, root_x, root_y, ground)
    drift_x = drift_y = 0.0  # velocity of the ground under the root, m/s
    if ground.box_velocity.shape[1] + ground.mover_top.shape[1] > 0:
        drift_x, drift_y = spatial_ground.velocity(i, root_x, root_y, ground)
    measurement.root[i, 0], measurement.root[i, 1], measurement.root[i, 2] = root_x, root_y, root_z
    measurement.com[i, 0], measurement.com[i, 1], measurement.com[i, 2] = com_x, com_y, com_z
    measurement.heading[i], measurement.cosine[i], measurement.sine[i] = heading, cosine, sine
    measurement.under[i] = under
    measurement.pose[i, 0] = root_z - under

    speed_x = speed_y = speed_z = 0.0
    for k in range(len(body.links)):
        link = body.links[k]
        centre_x, centre_y = state.xipos[i, link, 0], state.xipos[i, link, 1]
        centre_z = state.xipos[i, link, 2]
        spin_x, spin_y, spin_z = (
            state.cvel[i, link, 0], state.cvel[i, link, 1], state.cvel[i, link, 2],
        )  # fmt: skip
        # Spatial velocities are about the centre of mass of the whole tree: v + w x r.
        arm_x, arm_y, arm_z = centre_x - com_x, centre_y - com_y, centre_z - com_z
        v_x = state.cvel[i, link, 3] + (spin_y * arm_z - spin_z * arm_y)
        v_y = state.cvel[i, link, 4] + (spin_z * arm_x - spin_x * arm_z)
        v_z = state.cvel[i, link, 5] + (spin_x * arm_y - spin_y * arm_x)
        speed_x += v_x * body.share[k]
        speed_y += v_y * body.share[k]
        speed_z += v_z * body.share[k]

        column = 1 + LINK_POSE * k
        away_x, away_y = centre_x - root_x, centre_y - root_y
        measurement.pose[i, column] = cosine * away_x + sine * away_y
        measurement.pose[i, column + 1] = cosine * away_y - sine * away_x
        measurement.pose[i, column + 2] = centre_z - root_z
        w, x = state.xquat[i, link, 0], state.xquat[i, link, 1]
        y, z = state.xquat[i, link, 2], state.xquat[i, link, 3]
        turned_w, turned_x = half_cosine * w - half_sine * z, half_cosine * x - half_sine * y
        turned_y, turned_z = half_cosine * y + half_sine * x, half_cosine * z + half_sine * w
        if k == 0:
            measurement.features[i, 0], measurement.features[i, 1] = turned_w, turned_x
            measurement.features[i, 2], measurement.features[i, 3] = turned_y, turned_z
        sign = -1.0 if turned_w < 0.0 else 1.0
        measurement.pose[i, column + 3], measurement.pose[i, column + 4] = (
            sign * turned_w,
            sign * turned_x,
        )
        measurement.pose[i, column + 5], measurement.pose[i, column + 6] = (
            sign * turned_y,
            sign * turned_z,
        )
        column = LINK_VELOCITY * k
        v_x, v_y = v_x - drift_x, v_y - drift_y
        measurement.velocity[i, column] = cosine * v_x + sine * v_y
        measurement.velocity[i, column + 1] = cosine * v_y - sine * v_x
        measurement.velocity[i, column + 2] = v_z
        measurement.velocity[i, column + 3] = cosine * spin_x + sine * spin_y
        measurement.velocity[i, column + 4] = cosine * spin_y - sine * spin_x
        measurement.velocity[i, column + 5] = spin_z
    measurement.com_velocity[i, 0], measurement.com_velocity[i, 1] = speed_x, speed_y
    measurement.com_velocity[i, 2] = speed_z

    features = 4
    for address in body.balls:
        measurement.features[i, features] = state.qpos[i, address]
        features += 1
    for address in body.hinges:
        measurement.features[i, features] = state.qpos[i, address]
        features += 1
    for k in range(3):
        measurement.features[i, features] = measurement.velocity[i, 3 + k]
        features += 1
    for address in body.joint_dof:
        measurement.features[i, features] = state.qvel[i, address]
        features += 1
    middle_x, middle_y = (com_x, com_y) if body.about_com else (root_x, root_y)
    for k in range(len(body.effectors)):
        foot = body.effectors[k]
        foot_x, foot_y = state.xpos[i, foot, 0], state.xpos[i, foot, 1]
        foot_z = state.xpos[i, foot, 2]
        measurement.feet[i, k, 0], measurement.feet[i, k, 1], measurement.feet[i, k, 2] = (
            foot_x,
            foot_y,
            foot_z,
        )
        away_x, away_y = foot_x - middle_x, foot_y - middle_y
        measurement.features[i, features] = cosine * away_x + sine * away_y
        measurement.features[i, features + 1] = cosine * away_y - sine * away_x
        measurement.features[i, features + 2] = foot_z - spatial_ground.height(
            i, foot_x, foot_y, ground
        )
        features += 3
        touching = 0.0
        for sensor in body.contact[k]:
            if state.sensordata[i, sensor] > 0.0:
                touching = 1.0
        measurement.contact[i, k] = touching
    for k in range(3):
        measurement.features[i, features + k] = measurement.com_velocity[i, k]
    measurement.features[i, features + 3] = root_z - under
    measurement.fallen[i] = False
    for sensor in body.fall:
        if state.sensordata[i, sensor] != 0.0:
            measurement.fallen[i] = True


@compiled_inline
def ahead_and_left(
    i: int, x: float, y: float, measurement: SpatialMeasurement
) -> tuple[float, float]:
    """Converts a horizontal vector from world axes to the heading frame."""
    cosine, sine = measurement.cosine[i], measurement.sine[i]
    return cosine * x + sine * y, cosine * y - sine * x


@compiled_inline
def polar(i: int, x: float, y: float, measurement: SpatialMeasurement) -> tuple[float, float]:
    """Returns bearing (rad to the left) and length of a horizontal vector in world axes."""
    ahead, left = ahead_and_left(i, x, y, measurement)
    return math.atan2(left, ahead), math.sqrt(ahead * ahead + left * left)


class SpatialBodyData(NamedTuple):
    """A character in all simulations, for compiled functions.

    Attributes:
      ctrl: controls of the physics, (n, ...).
      leaving: whether the character has left its ground window, which must then be moved, (n,).
    """

    engine: native.Engine
    ids: SpatialIds
    physics: SpatialState
    ground: SpatialWindows
    drive: Drive
    ctrl: np.ndarray
    measurement: SpatialMeasurement
    leaving: np.ndarray


@compiled
def look(i: int, body: SpatialBodyData) -> None:
    """Measures a character, relative to the current ground."""
    spatial_ground.see_movers(i, body.physics.qpos, body.ground)
    measure(i, body.ids, body.physics, body.ground, body.measurement)


@compiled
def breaks_down(i: int, body: SpatialBodyData) -> bool:
    """Returns whether a simulation diverged or a character left its ground."""
    return (
        native.diverged(i, body.engine)
        or native.too_fast(i, body.ids.joint_dof, MAX_JOINT_SPEED, body.physics.qvel)
        or is_lost(i, body.ids, body.physics, body.ground)
    )


@compiled
def control_all(env_ids: np.ndarray, action: np.ndarray, body: SpatialBodyData) -> int:
    """Writes controls and drives moving boxes; returns how many ground windows must be moved.

    To move a window drives its boxes as well. Takes a pack.
    """
    leaving, root = 0, body.ids.links[0]
    for i in env_ids:
        drive(i, action, body.drive, body.ctrl)
        x, y = body.physics.xpos[i, root, 0], body.physics.xpos[i, root, 1]
        body.leaving[i] = spatial_ground.has_left(i, x, y, body.ground)
        if body.leaving[i]:
            leaving += 1
        elif spatial_ground.keep_moving(i, x, y, body.physics.qpos, body.physics.qvel, body.ground):
            native.forward(i, body.engine)
    return leaving


class Measured(NamedTuple):
    """Data for loops over characters."""

    body: SpatialIds
    state: SpatialState
    ground: SpatialWindows
    measurement: SpatialMeasurement


@compiled
def measure_all(env_ids: np.ndarray, measured: Measured) -> None:
    """Measures the characters of some simulations; takes a pack."""
    for i in env_ids:
        measure(i, measured.body, measured.state, measured.ground, measured.measurement)
