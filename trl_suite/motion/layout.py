"""The columns of poses and velocities, their interpolation and mirroring."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Sequence

import numpy as np

from trl_suite.motion import quaternion
from trl_suite.util import errors

ROOT_SIZES = {'planar': 3, 'free': 7}  # columns of a pose: x, z, pitch; x, y, z, quaternion
LARGEST = 1e6  # m, rad or s; larger values in a motion are errors, and their squares may overflow
SHORTEST = 1e-6  # s; least time between two frames, by which differences are divided
JOINT_SIZES = (1, 4)  # hinge angle; ball-joint quaternion
# Signs of a reflected vector, of a quaternion, and of a pseudovector such as an angular velocity.
VECTOR, QUATERNION, SPIN = (1.0, -1.0, 1.0), (1.0, -1.0, 1.0, -1.0), (-1.0, 1.0, -1.0)


class Layout:
    """The columns of a pose and of a velocity.

    A pose holds the root ('planar': x, z in m, pitch in rad; 'free': x, y, z in m, unit quaternion
    wxyz), then the joints: an angle per hinge, a unit quaternion wxyz per ball joint. A velocity
    has the same order with 3 numbers per rotation.

    Attributes:
      columns: length of a pose.
      rates: length of a velocity.
      rotations: first column in the pose and in the velocity of every quaternion.
    """

    def __init__(self, root: str, joints: Sequence[str], sizes: Sequence[int]) -> None:
        """Assigns the columns; `sizes` are those of joints in a pose, 1 (hinge) or 4 (ball)."""
        if root not in ROOT_SIZES:
            raise ValueError(f'root: {errors.unknown("root", root, ROOT_SIZES)}')
        if len(set(joints)) != len(joints):
            raise ValueError('joints: a name occurs twice')
        if len(sizes) != len(joints):
            raise ValueError(f'sizes: {len(sizes)} for {len(joints)} joints')
        if not set(sizes) <= set(JOINT_SIZES):
            raise ValueError('sizes: a joint has 1 (hinge) or 4 (ball) columns')
        self.root, self.joints, self.sizes = root, tuple(joints), tuple(sizes)
        self._pose_starts = np.cumsum([ROOT_SIZES[root], *self.sizes])
        rates = [3 if root == 'planar' else 6, *(min(size, 3) for size in self.sizes)]
        self._rate_starts = np.cumsum(rates)
        self.columns, self.rates = int(self._pose_starts[-1]), int(self._rate_starts[-1])
        self.rotations = tuple(
            [(3, 3)] * (root == 'free')
            + [
                (int(q), int(v))
                for q, v, size in zip(
                    self._pose_starts[:-1], self._rate_starts[:-1], self.sizes, strict=True
                )
                if size == 4
            ]
        )
        first = np.array(self.rotations, dtype=int).reshape(-1, 2)
        self._quaternions = first[:, :1] + np.arange(4)
        self._turns = first[:, 1:] + np.arange(3)
        self._straight = np.setdiff1d(np.arange(self.columns), self._quaternions)
        self._straight_rates = np.setdiff1d(np.arange(self.rates), self._turns)

    def blend(self, before: np.ndarray, after: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Interpolates poses (..., columns) from `before`, u = 0, to `after`, u = 1; u is (...)."""
        poses = before + u[..., None] * (after - before)
        if self.rotations:
            here = self._quaternions
            poses[..., here] = quaternion.slerp(before[..., here], after[..., here], u[..., None])
        return poses

    def change(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Returns the difference of poses `a` and `b` in the columns of a velocity, (..., rates).

        Rotations become rotation vectors from `a` to `b` in body axes.
        """
        change = np.empty((*a.shape[:-1], self.rates))
        change[..., self._straight_rates] = (b - a)[..., self._straight]
        if self.rotations:
            here = self._quaternions
            turn = quaternion.multiply(quaternion.conjugate(a[..., here]), b[..., here])
            change[..., self._turns] = quaternion.rotation_vector(turn)
        return change

    def changed(self, poses: np.ndarray, change: np.ndarray) -> np.ndarray:
        """Returns poses (..., columns) after a `change` (..., rates)."""
        result = poses.copy()
        result[..., self._straight] += change[..., self._straight_rates]
        if self.rotations:
            here, turn = self._quaternions, quaternion.from_vector(change[..., self._turns])
            result[..., here] = quaternion.multiply(poses[..., here], turn)
        return result

    @functools.cached_property
    def mirror(self) -> Mirror:
        """The exchange of left and right by joint names: right_x for left_x."""
        return Mirror(
            self,
            [
                (joint, partner)
                for joint in self.joints
                if joint.startswith('right_')
                and (partner := 'left' + joint.removeprefix('right')) in self.joints
            ],
        )

    def starts(self, joint: str) -> tuple[int, int]:
        """Returns the first column of a joint in a pose and in a velocity."""
        errors.check_known('joint', self.joints, joint)
        i = self.joints.index(joint)
        return int(self._pose_starts[i]), int(self._rate_starts[i])


class Mirror:
    """The exchange of left and right, a reflection in the x-z plane.

    Hinge angles keep their sign, which is correct for hinges about the lateral axis, the only ones
    of the shipped characters. Rotations and the path of a free root are reflected.
    """

    def __init__(self, layout: Layout, pairs: Iterable[tuple[str, str]]) -> None:
        """Prepares the exchange of pairs of joints, in either order; others keep their columns."""
        self._pose_source, self._rate_source = np.arange(layout.columns), np.arange(layout.rates)
        self._pose_sign, self._rate_sign = np.ones(layout.columns), np.ones(layout.rates)
        if layout.root == 'free':
            self._pose_sign[:3] = self._rate_sign[:3] = VECTOR
        for q, v in layout.rotations:
            self._pose_sign[q : q + 4] = QUATERNION
            self._rate_sign[v : v + 3] = SPIN
        pairs = [*pairs]
        named = [joint for pair in pairs for joint in pair]
        if len({*named}) < len(named):
            raise ValueError(f'pairs are {pairs}; expected each joint once')
        for pair in pairs:
            (q0, v0), (q1, v1) = map(layout.starts, pair)
            size, other = (layout.sizes[layout.joints.index(joint)] for joint in pair)
            if size != other:
                raise ValueError(f'joints {pair[0]!r} and {pair[1]!r} differ in kind')
            for source, first, second, length in (
                (self._pose_source, q0, q1, size),
                (self._rate_source, v0, v1, min(size, 3)),
            ):
                source[first : first + length] = np.arange(second, second + length)
                source[second : second + length] = np.arange(first, first + length)

    def pose(self, poses: np.ndarray) -> np.ndarray:
        """Returns mirrored poses, shape (..., columns)."""
        return poses[..., self._pose_source] * self._pose_sign

    def velocity(self, velocities: np.ndarray) -> np.ndarray:
        """Returns mirrored velocities, shape (..., rates)."""
        return velocities[..., self._rate_source] * self._rate_sign
