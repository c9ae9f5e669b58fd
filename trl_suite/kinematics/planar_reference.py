"""A motion clip on a planar character: initial poses, and features for the reward."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import mujoco
import numpy as np

from trl_suite.motion import Clip
from trl_suite.util.compiled import compiled, nearest_index

SAMPLES = 1024  # per cycle; for the suite's clips, link positions are then exact to 0.5 mm
_SAMPLES = np.full(1, float(SAMPLES))


class ClipTable(NamedTuple):
    """Features of a looping clip for compiled functions; see `Reference` for their columns.

    Attributes:
      table: features at SAMPLES phases, (SAMPLES, columns).
      steps: differences to the features at the next phase, (SAMPLES, columns).
      period: duration of the cycle, s.
    """

    table: np.ndarray
    steps: np.ndarray
    period: float


@compiled
def feature(phase: float, column: int, clip: ClipTable) -> float:
    """Returns a feature of the clip at a phase in [0, 1)."""
    u = phase * SAMPLES
    k = nearest_index(u, SAMPLES)
    return clip.steps[k, column] * (u - k) + clip.table[k, column]


class Reference:
    """Kinematics of a looping planar clip, tabulated over the phase.

    Features of one phase, all independent of the ground and of the distance travelled; see
      `columns`: angles (1 + J,) of pitch and joints in link order, rad; rates (1 + J,) rad/s;
      effectors (2 * E,) end effectors: all x relative to the centre of mass, or to the root, then
        all z above 0, m;
      com_velocity (2,) m/s; height of the root, m;
      positions (2 * links,) link centres relative to the root, x and z alternating, m;
      velocities (2 * links,) of the link centres, m/s;
      root_rate (2,) velocity of the root in x and z, m/s;
      extents (3 * G,) of the collision geoms: x of centres relative to the root, half lengths in x,
        z of lowest points relative to the root, m;
      phase; quarter (bins,) one-hot of the part of the cycle.
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
          pose_dof: their addresses in qvel.
          links: body ids in link order, the root body first.
          effectors: body ids of the end effectors.
          geoms: ids of the collision geoms.
          bins: number of parts of the cycle, a divisor of SAMPLES.
          about: origin of end effector positions, the centre of mass ('com') or the 'root'.
        """
        self.clip = clip
        self.period = clip.duration
        times = np.arange(SAMPLES + 1) / SAMPLES * self.period
        poses, rates = clip.state(times)
        parts = {
            'xipos': links, 'cvel': links, 'subtree_com': links[:1], 'xpos': effectors,
            'geom_xpos': geoms, 'geom_xmat': geoms,
        }  # fmt: skip
        found = tabulated(model, pose_qpos, pose_dof, poses, rates, parts)
        mass = model.body_mass[links]
        share = mass / mass.sum()
        centres, places = found['xipos'][..., ::2], poses[:, None, :2]
        com = share @ centres
        velocity = link_velocities(centres, found['cvel'], found['subtree_com'][..., ::2])
        effector = found['xpos'][..., ::2]
        effector[..., 0] -= com[:, :1] if about == 'com' else poses[:, :1]
        extents = _extents(found['geom_xpos'], found['geom_xmat'], model.geom_aabb[geoms], places)
        features = (
            poses[:, 2:], rates[:, 2:], effector.swapaxes(1, 2), share @ velocity, poses[:, 1:2],
            centres - places, velocity, rates[:, :2], extents,
        )  # fmt: skip
        table = np.concatenate([part.reshape(SAMPLES + 1, -1) for part in features], axis=1)
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

    @property
    def clip_table(self) -> ClipTable:
        """The features for compiled functions."""
        return ClipTable(self._table, self._steps, self.period)

    def state(self, phase: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns the state of the reference at phases (n,).

        Returns:
          Poses: x = 0, z above 0, pitch, joints, (n, 3 + J); velocities, (n, 3 + J); and the
          extents of the collision geoms as `link_extents` gives them, (n, 3, G).
        """
        found, column = self.features(phase), self.columns
        parts = (np.zeros((len(phase), 1)), found[:, column['height']], found[:, column['angles']])
        rates = (found[:, column['root_rate']], found[:, column['rates']])
        extents = np.ascontiguousarray(found[:, column['extents']]).reshape(len(phase), 3, -1)
        return np.concatenate(parts, axis=1), np.concatenate(rates, axis=1), extents

    def features(self, phase: np.ndarray) -> np.ndarray:
        """Returns the features at phases in [0, 1), shape (n,) -> (n, columns)."""
        u = phase * _SAMPLES
        sample = np.floor(u)
        u = u - sample  # in place would be slower for a single number
        index = sample.astype(np.int64)
        found = self._steps.take(index, 0)
        found *= u[:, None]
        found += self._table.take(index, 0)
        return found


def tabulated(
    model: mujoco.MjModel,
    pose_qpos: np.ndarray,
    pose_dof: np.ndarray,
    poses: np.ndarray,
    rates: np.ndarray,
    parts: Mapping[str, np.ndarray | slice],
) -> dict[str, np.ndarray]:
    """Computes positions and velocities for many states of a model, without simulating.

    Args:
      model: the compiled model.
      pose_qpos: addresses in qpos of the columns of a pose.
      pose_dof: addresses in qvel of the columns of a velocity.
      poses: (n, columns).
      rates: (n, columns).
      parts: names of fields of MjData -> their rows to return.

    Returns:
      Field name -> array (n, rows, ...).
    """
    data = mujoco.MjData(model)
    views = [getattr(data, name) for name in parts]  # updated in place
    found = {
        name: np.empty((len(poses), *view[part].shape))
        for view, (name, part) in zip(views, parts.items(), strict=True)
    }
    copies = list(zip(found.values(), views, parts.values(), strict=True))
    for i, (pose, rate) in enumerate(zip(poses, rates, strict=True)):
        data.qpos[pose_qpos] = pose
        data.qvel[pose_dof] = rate
        # Not mj_forward: contacts, inertia and forces would take most of the time.
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        for rows, view, part in copies:
            rows[i] = view[part]
    return found


def link_velocities(centres: np.ndarray, cvel: np.ndarray, about: np.ndarray) -> np.ndarray:
    """Velocities of link centres in the x-z plane.

    Args:
      centres: link centres, x and z, m, shape (..., links, 2).
      cvel: spatial velocities (angular, linear) at the point `about`, shape (..., links, 6).
      about: centre of mass of the whole tree, the origin of MuJoCo's cvel, x and z, m, (..., 1, 2).

    Returns:
      Velocities in x and z, m/s, shape (..., links, 2).
    """
    offset = (centres - about)[..., ::-1] * (1, -1)
    return cvel[..., 3:6:2] + cvel[..., 1:2] * offset


def link_extents(
    model: mujoco.MjModel, data: mujoco.MjData, geoms: np.ndarray, root: np.ndarray
) -> np.ndarray:
    """Bounding boxes of geoms in the x-z plane, relative to the root at `root` (x, z), m.

    Returns:
      Centres in x, half lengths in x, and lowest points, shape (3, geoms).
    """
    return _extents(data.geom_xpos[geoms], data.geom_xmat[geoms], model.geom_aabb[geoms], root)


def _extents(
    places: np.ndarray, matrices: np.ndarray, boxes: np.ndarray, root: np.ndarray
) -> np.ndarray:
    frames, boxes = matrices.reshape(*matrices.shape[:-1], 3, 3), boxes[:, None]
    centre = (places + (frames * boxes[..., :3]).sum(-1))[..., ::2] - root
    half = (np.abs(frames) * boxes[..., 3:]).sum(-1)
    return np.stack([centre[..., 0], half[..., 0], centre[..., 1] - half[..., 2]], axis=-2)
