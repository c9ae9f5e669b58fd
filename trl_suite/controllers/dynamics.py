"""The equations of motion of a planar character, in compiled functions of one simulation.

For stable PD, gravity compensation and virtual forces: joint-space inertia, Jacobians, world
angles, velocity of the centre of mass. Degrees of freedom are in link order: x, z, pitch, then the
joints; positive pitch is nose up.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trl_suite.characters import Character
from trl_suite.engine import GRAVITY, World
from trl_suite.util.compiled import compiled, compiled_inline


class Skeleton(NamedTuple):
    """A character's degrees of freedom D = 3 + J in a compiled model of B bodies.

    Attributes:
      qpos, dof: addresses in qpos and in qvel, (D,).
      joint: joint ids, (D,).
      entry: index of each entry of the inertia matrix among those that MuJoCo stores, -1 where it
        is always zero, (D, D).
      body: id of the body that it moves, (D,).
      subtree_mass: mass of this body and its descendants, (D,) kg.
      moves: whether it rotates a body, (B, D) bool.
      links: body ids in link order, the root first, (L,).
      mass: total mass, kg.
    """

    qpos: np.ndarray
    dof: np.ndarray
    joint: np.ndarray
    entry: np.ndarray
    body: np.ndarray
    subtree_mass: np.ndarray
    moves: np.ndarray
    links: np.ndarray
    mass: float


class Mechanics(NamedTuple):
    """Fields of the physics that only these functions need, each (n, ...); see `engine.World`."""

    M: np.ndarray
    qfrc_bias: np.ndarray
    xanchor: np.ndarray
    site_xpos: np.ndarray


# Further fields that a world must bind.
FIELDS = Mechanics._fields


def skeleton(character: Character, world: World) -> Skeleton:
    """Resolves the names of a character with root joints in a compiled world."""
    scope = f'{character.mjcf_model.model}/'
    names = [f'{scope}root_{axis}/' for axis in ('x', 'z', 'pitch')]
    names += [joint.full_identifier for joint in character.joints]
    qpos, dof = world.joint_addresses(names)
    links = world.body_ids([body.full_identifier for body in character.bodies])
    model = world.models[0]
    # MuJoCo stores the lower triangle by rows, in the order of its own degrees of freedom, so that
    # either of a pair may be the row.
    places = np.full((model.nv, model.nv), -1)
    for row in range(model.nv):
        start = model.M_rowadr[row]
        for k in range(start, start + model.M_rownnz[row]):
            places[row, model.M_colind[k]] = places[model.M_colind[k], row] = k
    joint, body = model.dof_jntid[dof].astype(int), model.dof_bodyid[dof].astype(int)
    hinge = np.arange(len(names)) >= 2  # all but root_x and root_z
    moves = np.zeros((model.nbody, len(names)), bool)
    for link in links:  # rotated by all hinges between it and the world
        above = link
        while above:
            moves[link] |= (body == above) & hinge
            above = model.body_parentid[above]
    return Skeleton(
        qpos=qpos,
        dof=dof,
        joint=joint,
        entry=places[np.ix_(dof, dof)],
        body=body,
        subtree_mass=model.body_subtreemass[body],
        moves=moves,
        links=links,
        mass=float(model.body_subtreemass[links[0]]),
    )


def frame(joints: np.ndarray, skeleton: Skeleton, world: World) -> tuple[np.ndarray, np.ndarray]:
    """Returns the linear map from degrees of freedom to world angles, less the joints' own angles.

    Args:
      joints: numbers of joints in link order, (k,).
      skeleton: skeleton of the character.
      world: the compiled world.

    Returns:
      Coefficients of all degrees of freedom, (k, D), and constants, (k,): coefficients times qpos
      plus constant is the world angle of the joint's link minus the joint's own angle.
    """
    model = world.models[0]
    # Rotation of each body relative to its parent at rest, rad; about -y, hence the sign.
    rest = -2 * np.arctan2(model.body_quat[:, 2], model.body_quat[:, 0])
    coefficients = np.zeros((len(joints), len(skeleton.dof)))
    constants = np.zeros(len(joints))
    for row, joint in enumerate(joints):
        body = skeleton.body[3 + joint]
        coefficients[row] = skeleton.moves[body]
        coefficients[row, 3 + joint] = 0.0
        while body:
            constants[row] += rest[body]
            body = model.body_parentid[body]
    return coefficients, constants


# Functions of simulation i.


@compiled
def write_inertia(i: int, skeleton: Skeleton, M: np.ndarray, out: np.ndarray) -> None:
    """Writes the joint-space inertia into out[i], (D, D)."""
    count = len(skeleton.dof)
    for row in range(count):
        for column in range(count):
            entry = skeleton.entry[row, column]
            out[i, row, column] = M[i, entry] if entry >= 0 else 0.0


@compiled
def com_speed(i: int, skeleton: Skeleton, M: np.ndarray, qvel: np.ndarray) -> float:
    """Returns the forward velocity of the centre of mass, m/s."""
    momentum = 0.0
    for k in range(len(skeleton.dof)):
        entry = skeleton.entry[0, k]
        if entry >= 0:
            momentum += M[i, entry] * qvel[i, skeleton.dof[k]]
    return momentum / M[i, skeleton.entry[0, 0]]  # the current total mass


@compiled_inline
def weight(
    i: int, k: int, skeleton: Skeleton, subtree_com: np.ndarray, xanchor: np.ndarray
) -> float:
    """Returns the generalised force of gravity on degree of freedom k, a hinge or of the root."""
    if k == 0:
        return 0.0
    if k == 1:
        return -GRAVITY * skeleton.mass
    arm = subtree_com[i, skeleton.body[k], 0] - xanchor[i, skeleton.joint[k], 0]
    return -GRAVITY * skeleton.subtree_mass[k] * arm


@compiled
def write_jacobian(
    i: int,
    body: int,
    x: float,
    z: float,
    row: int,
    skeleton: Skeleton,
    xanchor: np.ndarray,
    out: np.ndarray,
) -> None:
    """Writes d(x, z) / d(degrees of freedom) of a point of a body to two rows of out[i], (., D).

    The rows are `row` and the next one. The columns of slides other than those of the root are
    0.
    """
    for k in range(len(skeleton.dof)):
        joint, moves = skeleton.joint[k], skeleton.moves[body, k]
        out[i, row, k] = -(z - xanchor[i, joint, 2]) if moves else 0.0
        out[i, row + 1, k] = x - xanchor[i, joint, 0] if moves else 0.0
    out[i, row, 0] = out[i, row + 1, 1] = 1.0


@compiled
def solve(i: int, n: int, matrix: np.ndarray, vector: np.ndarray) -> None:
    """Solves matrix[i] x = vector[i] (n equations) by elimination; x overwrites vector[i].

    With partial pivoting; matrix[i] is overwritten too. The pivots and the order of operations are
    those of LAPACK's dgetf2 and dgetrs.
    """
    for k in range(n):
        pivot = k
        for row in range(k + 1, n):
            if abs(matrix[i, row, k]) > abs(matrix[i, pivot, k]):
                pivot = row
        if pivot != k:
            for column in range(k, n):
                kept = matrix[i, k, column]
                matrix[i, k, column] = matrix[i, pivot, column]
                matrix[i, pivot, column] = kept
            kept = vector[i, k]
            vector[i, k] = vector[i, pivot]
            vector[i, pivot] = kept
        inverse = 1.0 / matrix[i, k, k]
        for row in range(k + 1, n):
            factor = matrix[i, row, k] * inverse
            if factor == 0.0:
                continue
            for column in range(k + 1, n):
                matrix[i, row, column] -= factor * matrix[i, k, column]
            vector[i, row] -= factor * vector[i, k]
    for k in range(n - 1, -1, -1):
        x = vector[i, k]
        for column in range(k + 1, n):
            x -= matrix[i, k, column] * vector[i, column]
        vector[i, k] = x / matrix[i, k, k]
