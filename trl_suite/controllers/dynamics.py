"""The equations of motion of a planar character, in compiled functions of one simulation.

What stable PD, gravity compensation and virtual forces need: joint-space inertia, bias forces,
Jacobians, world angles, the centre of mass. Degrees of freedom are in link order: x, z, pitch, then
the joints; angles are positive nose up.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trl_suite.characters import Character
from trl_suite.engine import World
from trl_suite.util.compiled import compiled, compiled_inline

GRAVITY = 9.8  # m/s^2


class Skeleton(NamedTuple):
    """A character's degrees of freedom D = 3 + J in a compiled model of B bodies.

    Attributes:
      qpos, dof: addresses in qpos and in qvel, (D,).
      joint: numbers in the model, (D,).
      entry: where each entry of the inertia lies among those that MuJoCo stores, -1 where it is
        always zero, (D, D).
      body: which one it moves, (D,).
      subtree_mass: of that body and what hangs on it, (D,) kg.
      moves: whether it turns a body, (B, D) bool.
      links: body ids in link order, the root first, (L,).
      mass: of the whole character, kg.
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
    """Fields of the physics that only dynamics need, each (n, ...); see `engine.World`."""

    M: np.ndarray
    qfrc_bias: np.ndarray
    xanchor: np.ndarray
    site_xpos: np.ndarray


# What a world must bind beyond the fields that every task reads.
FIELDS = Mechanics._fields


def skeleton(character: Character, world: World) -> Skeleton:
    """Resolves the names of a character with root joints in a compiled world."""
    scope = f'{character.mjcf_model.model}/'
    names = [f'{scope}root_{axis}/' for axis in ('x', 'z', 'pitch')]
    names += [joint.full_identifier for joint in character.joints]
    qpos, dof = world.joint_addresses(names)
    links = world.body_ids([body.full_identifier for body in character.bodies])
    model = world.models[0]
    # MuJoCo stores a triangle by simulations; its order is by depth, so any of a pair may be the later.
    places = np.full((model.nv, model.nv), -1)
    for env_id in range(model.nv):
        start = model.M_rowadr[env_id]
        for k in range(start, start + model.M_rownnz[env_id]):
            places[env_id, model.M_colind[k]] = places[model.M_colind[k], env_id] = k
    joint, body = model.dof_jntid[dof].astype(int), model.dof_bodyid[dof].astype(int)
    hinge = np.arange(len(names)) >= 2  # all but root_x and root_z
    moves = np.zeros((model.nbody, len(names)), bool)
    for link in links:  # the joints on its way to the root turn it
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
    """Returns what the world angles of links are made of, but for the angles of their own joints.

    Args:
      joints: numbers of joints in link order, (k,).
      skeleton: of the character.
      world: where it was compiled.

    Returns:
      Coefficients of all degrees of freedom, (k, D), and constants, (k,): their sum is the world
      angle of the link that hangs on the joint minus the joint's own angle.
    """
    model = world.models[0]
    # Turn of each body against its parent at rest, rad; about -y, hence the sign.
    rest = -2 * np.arctan2(model.body_quat[:, 2], model.body_quat[:, 0])
    coefficients = np.zeros((len(joints), len(skeleton.dof)))
    constants = np.zeros(len(joints))
    for env_id, joint in enumerate(joints):
        body = skeleton.body[3 + joint]
        coefficients[env_id] = skeleton.moves[body]
        coefficients[env_id, 3 + joint] = 0.0
        while body:
            constants[env_id] += rest[body]
            body = model.body_parentid[body]
    return coefficients, constants


# Of simulation i.


@compiled
def write_inertia(i: int, skeleton: Skeleton, M: np.ndarray, out: np.ndarray) -> None:
    """Writes the joint-space inertia into out[i], (D, D)."""
    count = len(skeleton.dof)
    for env_id in range(count):
        for column in range(count):
            entry = skeleton.entry[env_id, column]
            out[i, env_id, column] = M[i, entry] if entry >= 0 else 0.0


@compiled
def com_speed(i: int, skeleton: Skeleton, M: np.ndarray, qvel: np.ndarray) -> float:
    """Returns the forward velocity of the centre of mass, m/s."""
    momentum = 0.0
    for k in range(len(skeleton.dof)):
        entry = skeleton.entry[0, k]
        if entry >= 0:
            momentum += M[i, entry] * qvel[i, skeleton.dof[k]]
    return momentum / skeleton.mass


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
    i: int, body: int, x: float, z: float, env_id: int, skeleton: Skeleton, xanchor: np.ndarray,
    out: np.ndarray,
) -> None:  # fmt: skip
    """Writes d(x, z) / d(degrees of freedom) of a point of a body into two simulations of out[i], (., D).

    Of slides other than those of the root it is 0.
    """
    for k in range(len(skeleton.dof)):
        joint, moves = skeleton.joint[k], skeleton.moves[body, k]
        out[i, env_id, k] = -(z - xanchor[i, joint, 2]) if moves else 0.0
        out[i, env_id + 1, k] = x - xanchor[i, joint, 0] if moves else 0.0
    out[i, env_id, 0] = out[i, env_id + 1, 1] = 1.0


@compiled
def solve(i: int, n: int, matrix: np.ndarray, vector: np.ndarray) -> None:
    """Solves n equations matrix[i] x = vector[i] by elimination; both are overwritten.

    Pivoting is partial. The pivots and the order of operations are those of LAPACK's dgetf2 and dgetrs.
    """
    for k in range(n):
        pivot = k
        for env_id in range(k + 1, n):
            if abs(matrix[i, env_id, k]) > abs(matrix[i, pivot, k]):
                pivot = env_id
        if pivot != k:
            for column in range(k, n):
                kept = matrix[i, k, column]
                matrix[i, k, column] = matrix[i, pivot, column]
                matrix[i, pivot, column] = kept
            kept = vector[i, k]
            vector[i, k] = vector[i, pivot]
            vector[i, pivot] = kept
        inverse = 1.0 / matrix[i, k, k]
        for env_id in range(k + 1, n):
            factor = matrix[i, env_id, k] * inverse
            if factor == 0.0:
                continue
            for column in range(k + 1, n):
                matrix[i, env_id, column] -= factor * matrix[i, k, column]
            vector[i, env_id] -= factor * vector[i, k]
    for k in range(n - 1, -1, -1):
        x = vector[i, k]
        for column in range(k + 1, n):
            x -= matrix[i, k, column] * vector[i, column]
        vector[i, k] = x / matrix[i, k, k]
