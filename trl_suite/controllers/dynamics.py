"""The equations of motion of a planar character as arrays over simulations.

What stable PD, gravity compensation and virtual forces need: joint-space inertia, bias forces,
Jacobians, world angles, the centre of mass. Degrees of freedom are in link order: x, z, pitch, then
the joints; angles are positive nose up.

A row's figures do not depend on which other rows are asked for, to the last bit: what is summed up
later is taken (`take` packs each row, where an index may lay rows side by side).
"""

from __future__ import annotations

import mujoco
import numpy as np

from trl_suite.characters import Character
from trl_suite.engine import World

# What a world must bind beyond the fields that every task reads.
FIELDS = ('M', 'qfrc_bias', 'xanchor', 'subtree_com', 'xipos', 'site_xpos')
Rows = np.ndarray | slice


class PlanarDynamics:
    """Arrays of m rows at a time, for whichever rows are asked for.

    Attributes:
      mass: of the whole character, kg.
      size: number of degrees of freedom D = 3 + J.
    """

    def __init__(self, character: Character, world: World) -> None:
        self.world = world
        scope = f'{character.mjcf_model.model}/'
        names = [f'{scope}root_{axis}/' for axis in ('x', 'z', 'pitch')]
        names += [joint.full_identifier for joint in character.joints]
        self.qpos, self.dofs = world.joint_addresses(names)
        self.bodies = world.body_ids([body.full_identifier for body in character.bodies])
        self.size = len(names)
        model = world.models[0]
        self._joints = model.dof_jntid[self.dofs]
        # Where each entry of the dense inertia lies among those that the engine stores by rows; the
        # engine's order is by depth, so any of a pair may be the later.
        places = np.full((model.nv, model.nv), -1)
        for dof in range(model.nv):
            start = model.M_rowadr[dof]
            for k in range(start, start + model.M_rownnz[dof]):
                places[dof, model.M_colind[k]] = places[model.M_colind[k], dof] = k
        dense = places[np.ix_(self.dofs, self.dofs)]
        self._entries, self._stored = np.maximum(dense, 0), (dense >= 0).astype(float)
        self._body_of_dof = model.dof_bodyid[self.dofs]
        self._subtree_mass = model.body_subtreemass[self._body_of_dof]
        self.mass = float(model.body_subtreemass[self.bodies[0]])
        # Which joints turn or move a body: those on its way to the root.
        self._moves = np.zeros((model.nbody, self.size), bool)
        for body in self.bodies:
            above = body
            while above:
                self._moves[body] |= self._body_of_dof == above
                above = model.body_parentid[above]
        self.hinges = model.jnt_type[self._joints] == mujoco.mjtJoint.mjJNT_HINGE
        self._hinge = self.hinges.astype(float)
        # Turn of each body against its parent at rest, rad; about -y, hence the sign.
        quaternion = model.body_quat
        self._rest = -2 * np.arctan2(quaternion[:, 2], quaternion[:, 0])
        self._parents = model.body_parentid

    def positions(self, rows: Rows) -> np.ndarray:
        """x, z, pitch and joints, (m, D), m and rad."""
        return self.world.qpos[rows].take(self.qpos, 1)

    def velocities(self, rows: Rows) -> np.ndarray:
        """Their rates, (m, D)."""
        return self.world.qvel[rows].take(self.dofs, 1)

    def inertia(self, rows: Rows) -> np.ndarray:
        """Joint-space inertia, (m, D, D)."""
        return self.world.M[rows].take(self._entries, 1) * self._stored

    def bias(self, rows: Rows) -> np.ndarray:
        """Coriolis, centrifugal and gravity forces, (m, D); what rest costs."""
        return self.world.qfrc_bias[rows].take(self.dofs, 1)

    def gravity(self, rows: Rows, acceleration: float = 9.8) -> np.ndarray:
        """Generalised forces of gravity on hinges and root, (m, D)."""
        com = self.world.subtree_com[rows].take(self._body_of_dof, 1)
        anchor = self.world.xanchor[rows].take(self._joints, 1)
        result = -acceleration * self._subtree_mass * (com[..., 0] - anchor[..., 0])
        result[:, 0], result[:, 1] = 0.0, -acceleration * self.mass
        return result

    def jacobian(self, rows: Rows, body: int, point: np.ndarray) -> np.ndarray:
        """d(x, z)/d(degrees of freedom) of points (m, 3) of a body, (m, 2, D); hinges and root."""
        arm = point[:, None] - self.world.xanchor[rows].take(self._joints, 1)
        result = np.empty((len(point), 2, self.size))
        on_the_way = self._moves[body] * self._hinge
        np.multiply(-arm[..., 2], on_the_way, out=result[:, 0])
        np.multiply(arm[..., 0], on_the_way, out=result[:, 1])
        result[:, 0, :2], result[:, 1, :2] = (1.0, 0.0), (0.0, 1.0)
        return result

    def frame(self, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What the world angles of links are made of, but for the angles of their own joints.

        Args:
          joints: numbers of joints, (k,).

        Returns:
          Coefficients of all degrees of freedom (D, k), and constants (k,): their sum is the world
          angle of the link that hangs on the joint minus the joint's own angle.
        """
        coefficients = np.zeros((self.size, len(joints)))
        constants = np.zeros(len(joints))
        for column, joint in enumerate(joints):
            dof = 3 + joint
            body = self._body_of_dof[dof]
            coefficients[:, column] = self._moves[body] * self._hinge
            coefficients[dof, column] = 0.0
            while body:
                constants[column] += self._rest[body]
                body = self._parents[body]
        return coefficients, constants

    def com(self, rows: Rows) -> np.ndarray:
        """Centre of mass, (m, 3), m."""
        return self.world.subtree_com[rows][:, self.bodies[0]]

    def com_speed(self, rows: Rows, v: np.ndarray) -> np.ndarray:
        """Forward velocity of the centre of mass at velocities v (m, D), (m,), m/s."""
        momentum = self.world.M[rows].take(self._entries[0], 1) * self._stored[0]
        return (momentum[:, None] @ v[..., None])[:, 0, 0] / self.mass
