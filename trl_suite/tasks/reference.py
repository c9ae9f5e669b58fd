"""A motion clip on a character: poses to start from and features to compare with."""

from __future__ import annotations

import mujoco
import numpy as np

from trl_suite.motion import Clip

SAMPLES = 1024  # per cycle; in our clips links are placed within 0.5 mm of the exact pose
_SAMPLES = np.full(1, float(SAMPLES))


class Reference:
    """Kinematics of a looping planar clip, tabulated once over the phase.

    Features of one phase, all independent of the ground and of the distance walked; see `columns`:
      angles (1 + J,) of pitch and joints in link order, rad; rates (1 + J,) rad/s;
      effectors (2 * E,) end effectors: all x ahead of the centre of mass, or of the root, then all z
        above 0, m;
      com_velocity (2,) m/s; height of the root, m;
      positions (2 * links,) link centres relative to the root, x and z by turns, m;
      velocities (2 * links,) of the link centres, m/s;
      root_rate (2,) velocity of the root in x and z, m/s;
      extents (3 * G,) of the collision geoms: centres ahead of the root, half lengths, lowest
        points above the root, m;
      phase itself; quarter (bins,) one-hot of the part of the cycle that the phase lies in.
    """

    def __init__(
        self,
        clip: Clip,
        model: mujoco.MjModel,
        pose_qpos: np.ndarray,
        pose_dof: np.ndarray,
        links: np.ndarray,
        effectors: np.ndarray,
        geoms: np.ndarray,
        bins: int,
        about: str = 'com',
    ) -> None:
        """Tabulates a clip.

        Args:
          clip: a looping clip with a planar root, its joints in link order.
          model: the compiled model of the character.
          pose_qpos: addresses in qpos of x, z, pitch and the joints in link order.
          pose_dof: the same in qvel.
          links: body ids in link order, the root body first.
          effectors: body ids of the end effectors.
          geoms: ids of the collision geoms.
          bins: parts of the cycle, a divisor of SAMPLES.
          about: from where end effectors are measured, the centre of mass ('com') or the 'root'.
        """
        self.clip = clip
        self.period = clip.duration
        data = mujoco.MjData(model)
        times = np.arange(SAMPLES + 1) / SAMPLES * self.period
        poses, rates = clip.pose(times), clip.velocity(times)
        mass = model.body_mass[links]
        share = mass / mass.sum()
        rows = []
        for pose, rate in zip(poses, rates, strict=True):
            data.qpos[pose_qpos] = pose
            data.qvel[pose_dof] = rate
            mujoco.mj_fwdPosition(model, data)
            mujoco.mj_fwdVelocity(model, data)
            centres = data.xipos[links][:, ::2]
            com = share @ centres
            velocity = link_velocities(centres, data.cvel[links], data.subtree_com[links[0], ::2])
            ahead = com[0] if about == 'com' else pose[0]
            effector = data.xpos[effectors][:, ::2] - (ahead, 0)
            rows.append(
                np.concatenate([
                    pose[2:], rate[2:], effector.T.ravel(), share @ velocity,
                    pose[1:2], (centres - pose[:2]).ravel(), velocity.ravel(), rate[:2],
                    link_extents(model, data, geoms, pose[:2]).ravel(),
                ])
            )  # fmt: skip
        table = np.array(rows)
        quarter = np.repeat(np.eye(bins), SAMPLES // bins, axis=0)
        phase = np.arange(SAMPLES)[:, None] / SAMPLES
        self._table = np.concatenate([table[:-1], phase, quarter], axis=1)
        self._steps = np.concatenate(
            [np.diff(table, axis=0), np.full_like(phase, 1 / SAMPLES), np.zeros_like(quarter)],
            axis=1,
        )
        joints, bodies = len(pose_qpos) - 3, 2 * len(links)
        sizes = {
            'angles': joints + 1, 'rates': joints + 1, 'effectors': 2 * len(effectors),
            'com_velocity': 2, 'height': 1, 'positions': bodies, 'velocities': bodies, 'root_rate': 2, 'extents': 3 * len(geoms), 'phase': 1,
            'quarter': bins,
        }  # fmt: skip
        stops = np.cumsum(list(sizes.values()))
        self.columns = {
            name: slice(int(stop) - size, int(stop))
            for (name, size), stop in zip(sizes.items(), stops, strict=True)
        }

    def state(self, phase: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns where a character is at phases (n,).

        Returns:
          Poses: x = 0, z above 0, pitch, joints, (n, 3 + J); their velocities, (n, 3 + J); and the
          extents of the collision geoms as `link_extents` gives them, (n, 3, G).
        """
        found, column = self.features(phase), self.columns
        parts = (np.zeros((len(phase), 1)), found[:, column['height']], found[:, column['angles']])
        rates = (found[:, column['root_rate']], found[:, column['rates']])
        extents = found[:, column['extents']].reshape(len(phase), 3, -1)
        return np.concatenate(parts, axis=1), np.concatenate(rates, axis=1), extents

    def features(self, phase: np.ndarray) -> np.ndarray:
        """Returns the features at phases in [0, 1), shape (n,) -> (n, columns)."""
        u = phase * _SAMPLES
        sample = np.floor(u)
        u = u - sample  # not in place: slower for a single number
        index = sample.astype(np.int64)
        found = self._steps.take(index, 0)
        found *= u[:, None]
        found += self._table.take(index, 0)
        return found


def link_velocities(centres: np.ndarray, cvel: np.ndarray, about: np.ndarray) -> np.ndarray:
    """Velocities of link centres in the x-z plane.

    Args:
      centres: link centres, x and z, m, shape (links, 2).
      cvel: spatial velocities (angular, linear) about `about`, shape (links, 6).
      about: centre of mass of the whole tree, where MuJoCo keeps cvel, x and z, m.

    Returns:
      Velocities in x and z, m/s, shape (links, 2).
    """
    offset = (centres - about)[:, ::-1] * (1, -1)
    return cvel[:, 3:6:2] + cvel[:, 1:2] * offset


def link_extents(
    model: mujoco.MjModel, data: mujoco.MjData, geoms: np.ndarray, root: np.ndarray
) -> np.ndarray:
    """Bounding boxes of geoms in the x-z plane, relative to the root at `root` (x, z), m.

    Returns:
      Centres in x, half lengths in x, and lowest points, shape (3, geoms).
    """
    frames, boxes = data.geom_xmat[geoms].reshape(-1, 3, 3), model.geom_aabb[geoms, None]
    centre = (data.geom_xpos[geoms] + (frames * boxes[..., :3]).sum(2))[:, ::2] - root
    half = (np.abs(frames) * boxes[..., 3:]).sum(2)
    return np.stack([centre[:, 0], half[:, 0], centre[:, 1] - half[:, 2]])
