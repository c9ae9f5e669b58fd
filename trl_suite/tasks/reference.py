"""A motion clip on a character: poses to start from and features to compare with."""

from __future__ import annotations

import mujoco
import numpy as np

from trl_suite.motion import Clip

SAMPLES = 1024  # per cycle; linear interpolation between them errs by less than 0.02 mm


class Reference:
    """Kinematics of a looping planar clip, tabulated once over the phase.

    Features of one phase, all independent of the ground and of the distance walked; see `columns`:
      angles (J,) rad, rates (J,) rad/s; pitch rad, pitch_rate rad/s; height of the root m;
      positions (2 * links,) link centres relative to the root, x and z by turns, m;
      velocities (2 * links,) of the link centres, m/s;
      effector_x (E,) end effectors ahead of the centre of mass, m; effector_z (E,) above 0, m;
      com_velocity (2,) m/s.
    """

    def __init__(
        self,
        clip: Clip,
        model: mujoco.MjModel,
        root_qpos: np.ndarray,
        root_dof: np.ndarray,
        joint_qpos: np.ndarray,
        joint_dof: np.ndarray,
        links: np.ndarray,
        effectors: np.ndarray,
    ) -> None:
        """Tabulates a clip.

        Args:
          clip: a looping clip with a planar root, its joints in link order.
          model: the compiled model of the character.
          root_qpos: addresses in qpos of x, z and pitch; `root_dof` the same in qvel.
          root_dof: see root_qpos.
          joint_qpos: addresses of the joints in qpos, in link order; `joint_dof` in qvel.
          joint_dof: see joint_qpos.
          links: body ids in link order, the root body first.
          effectors: body ids of the end effectors.
        """
        self.clip = clip
        self.period = clip.duration
        data = mujoco.MjData(model)
        qpos_address = np.concatenate([root_qpos, joint_qpos])
        dof_address = np.concatenate([root_dof, joint_dof])
        times = np.arange(SAMPLES + 1) / SAMPLES * self.period
        poses, rates = clip.pose(times), clip.velocity(times)
        mass = model.body_mass[links]
        share = mass / mass.sum()
        rows = []
        for pose, rate in zip(poses, rates, strict=True):
            data.qpos[qpos_address] = pose
            data.qvel[dof_address] = rate
            mujoco.mj_fwdPosition(model, data)
            mujoco.mj_fwdVelocity(model, data)
            centre = share @ data.xipos[links]
            velocity = link_velocities(
                data.xipos[None, links], data.cvel[None, links], data.subtree_com[None, links[0]]
            )[0]
            effector = data.xpos[effectors]
            rows.append(
                np.concatenate([
                    pose[3:], rate[3:], pose[2:3], rate[2:3], pose[1:2],
                    (data.xipos[links][:, [0, 2]] - pose[:2]).ravel(), velocity.ravel(),
                    effector[:, 0] - centre[0], effector[:, 2], share @ velocity,
                ])
            )  # fmt: skip
        self._table = np.array(rows)
        joints, bodies, ends = len(joint_qpos), 2 * len(links), len(effectors)
        sizes = dict(
            angles=joints, rates=joints, pitch=1, pitch_rate=1, height=1, positions=bodies,
            velocities=bodies, effector_x=ends, effector_z=ends, com_velocity=2,
        )  # fmt: skip
        stops = np.cumsum(list(sizes.values()))
        self.columns = {
            name: slice(int(stop) - size, int(stop))
            for (name, size), stop in zip(sizes.items(), stops, strict=True)
        }

    def features(self, phase: np.ndarray) -> np.ndarray:
        """Returns the features at phases in [0, 1), shape (n,) -> (n, columns)."""
        u = phase * SAMPLES
        i = u.astype(np.int64)
        low = self._table[i]
        return low + (u - i)[:, None] * (self._table[i + 1] - low)


def link_velocities(xipos: np.ndarray, cvel: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Velocities of link centres in the x-z plane.

    Args:
      xipos: link centres, m, shape (n, links, 3).
      cvel: spatial velocities (angular, linear) about `centre`, shape (n, links, 6).
      centre: centre of mass of the whole tree, where MuJoCo keeps cvel, m, shape (n, 3).

    Returns:
      Velocities in x and z, m/s, shape (n, links, 2).
    """
    velocity = cvel[:, :, 3:6:2].copy()
    spin = cvel[:, :, 1]
    velocity[:, :, 0] += spin * (xipos[:, :, 2] - centre[:, None, 2])
    velocity[:, :, 1] -= spin * (xipos[:, :, 0] - centre[:, None, 0])
    return velocity
