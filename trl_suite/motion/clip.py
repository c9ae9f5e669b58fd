"""A clip: one reference motion as key frames, sampled at any time.

Sampling follows the original simulator (anim/Motion.cpp): positions and angles interpolate
linearly, rotations along the shorter arc, and a looping clip goes on where it ended: its root
displacement accumulates, height included, its heading does not. The velocity differs on purpose:
a central instead of a forward difference, over the same 1/60 s.
"""

from __future__ import annotations

import dataclasses
import functools
import io
import os
import pathlib
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from trl_suite import errors, resources
from trl_suite.motion import quaternion

VELOCITY_STEP = 1 / 60  # s between the two poses of a velocity
ROOT_SIZES = {'planar': 3, 'free': 7}  # columns of a pose: x, z, pitch; x, y, z, quaternion
JOINT_SIZES = (1, 4)  # hinge angle; ball-joint quaternion
_UNIT_TOLERANCE = 1e-6
_FIELDS = ('times', 'poses', 'root', 'joints', 'sizes', 'loop', 'description')


@dataclasses.dataclass(frozen=True, eq=False)
class Clip:
    """A reference motion; x forward, y left, z up, hinge angles about (0, -1, 0).

    Attributes:
      name: name, for messages and files.
      times: key times in s, shape (n,), n >= 2, starting at 0, strictly increasing.
      poses: one pose per key time, shape (n, d), read-only. Columns: the root ('planar': x, z in m,
        pitch in rad; 'free': x, y, z in m, unit quaternion wxyz), then the joints.
      root: 'planar' or 'free'.
      joints: joint names in the character's link order (not MuJoCo's depth-first order).
      sizes: columns per joint, 1 for a hinge (rad), 4 for a ball joint (unit quaternion wxyz).
      loop: whether the motion repeats.
      description: one line.

    Raises:
      ValueError: if a field is malformed; the message names clip and field.
    """

    name: str
    times: np.ndarray
    poses: np.ndarray
    root: str
    joints: tuple[str, ...]
    sizes: tuple[int, ...]
    loop: bool = False
    description: str = ''

    def __post_init__(self) -> None:
        for field in ('times', 'poses'):
            try:
                array = np.array(getattr(self, field), dtype=float)  # a copy, to be locked
            except (TypeError, ValueError) as error:
                raise self._error(field, f'an array of numbers is needed ({error})') from None
            array.setflags(write=False)
            object.__setattr__(self, field, array)
        object.__setattr__(self, 'joints', tuple(map(str, self.joints)))
        object.__setattr__(self, 'sizes', tuple(map(int, self.sizes)))
        object.__setattr__(self, 'loop', bool(self.loop))
        self._check()

    def _error(self, field: str, what: str) -> ValueError:
        return ValueError(f'clip {self.name!r}, {field}: {what}')

    def _check(self) -> None:
        if self.root not in ROOT_SIZES:
            raise self._error('root', errors.unknown('root', self.root, ROOT_SIZES))
        if len(set(self.joints)) != len(self.joints):
            raise self._error('joints', 'a name occurs twice')
        if len(self.sizes) != len(self.joints):
            raise self._error('sizes', f'{len(self.sizes)} for {len(self.joints)} joints')
        if not set(self.sizes) <= set(JOINT_SIZES):
            raise self._error('sizes', 'a joint has 1 (hinge) or 4 (ball) columns')
        if self.times.ndim != 1 or self.times.size < 2:
            raise self._error('times', f'at least 2 are needed, shape is {self.times.shape}')
        columns = ROOT_SIZES[self.root] + sum(self.sizes)
        if self.poses.shape != (self.times.size, columns):
            raise self._error(
                'poses', f'shape is {self.poses.shape}, needed ({self.times.size}, {columns})'
            )
        for field in ('times', 'poses'):
            bad = np.argwhere(~np.isfinite(getattr(self, field)))
            if bad.size:
                raise self._error(field, f'not finite at {bad[0].tolist()}')
        if self.times[0] != 0 or np.any(np.diff(self.times) <= 0):
            raise self._error('times', 'must start at 0 and increase strictly')
        for q, _ in self._rotations:
            norms = np.linalg.norm(self.poses[:, q : q + 4], axis=1)
            bad = np.argwhere(np.abs(norms - 1) > _UNIT_TOLERANCE)
            if bad.size:
                frame = int(bad[0, 0])
                raise self._error(
                    'poses',
                    f'quaternion at column {q} of frame {frame} has length {norms[frame]:.6g}',
                )

    @functools.cached_property
    def _rotations(self) -> tuple[tuple[int, int], ...]:
        """First column in the pose and in the velocity of every quaternion."""
        found = [(3, 3)] if self.root == 'free' else []
        q, v = (7, 6) if self.root == 'free' else (3, 3)
        for size in self.sizes:
            if size == 4:
                found.append((q, v))
            q, v = q + size, v + min(size, 3)
        return tuple(found)

    @functools.cached_property
    def _straight(self) -> np.ndarray:
        """Columns of the pose that are no part of a quaternion."""
        turned = [q + i for q, _ in self._rotations for i in range(4)]
        return np.setdiff1d(np.arange(self.poses.shape[1]), turned)

    @functools.cached_property
    def _straight_velocities(self) -> np.ndarray:
        """Columns of the velocity that belong to `_straight`."""
        turned = [v + i for _, v in self._rotations for i in range(3)]
        return np.setdiff1d(np.arange(len(self._straight) + len(turned)), turned)

    @functools.cached_property
    def _cycle(self) -> np.ndarray:
        """What a cycle adds to the pose, shape (d,): the displacement and whole turns of pitch."""
        change = np.zeros(self.poses.shape[1])
        change[: self.displacement.size] = self.displacement
        if self.root == 'planar':  # a somersault must not unwind at the seam
            turns = np.round((self.poses[-1, 2] - self.poses[0, 2]) / (2 * np.pi))
            change[2] = 2 * np.pi * turns
        return change

    @property
    def duration(self) -> float:
        """Length of one cycle, s."""
        return float(self.times[-1])

    @property
    def displacement(self) -> np.ndarray:
        """Root displacement per cycle in m, height included: (x, z) planar, (x, y, z) free."""
        position = 2 if self.root == 'planar' else 3
        return self.poses[-1, :position] - self.poses[0, :position]

    @property
    def speed(self) -> float:
        """Mean horizontal speed, m/s."""
        return float(np.linalg.norm(self.displacement[:-1])) / self.duration

    def pose(self, t: ArrayLike) -> np.ndarray:
        """Returns the poses at times `t` in s.

        Args:
          t: times, any shape (...), negative ones too. A looping clip repeats with its displacement
            accumulated, before time 0 as well; any other clip holds its first and last frame.

        Returns:
          Poses, shape (..., d).
        """
        t = np.asarray(t, dtype=float)
        cycle = np.floor(t / self.duration) if self.loop else np.zeros_like(t)
        t = np.clip(t - cycle * self.duration, 0, self.duration)
        i = np.clip(np.searchsorted(self.times, t, side='right') - 1, 0, self.times.size - 2)
        u = (t - self.times[i]) / (self.times[i + 1] - self.times[i])
        before, after = self.poses[i], self.poses[i + 1]
        poses = before + u[..., None] * (after - before)
        for q, _ in self._rotations:
            here = slice(q, q + 4)
            poses[..., here] = quaternion.slerp(before[..., here], after[..., here], u)
        return poses + cycle[..., None] * self._cycle

    def velocity(self, t: ArrayLike) -> np.ndarray:
        """Returns the velocities at times `t` in s: a central difference over 1/60 s.

        The difference reaches across the seam of a looping clip. A clip that does not loop has a
        one-sided difference at its ends and does not move outside them.

        Args:
          t: times, any shape (...).

        Returns:
          Velocities, shape (..., v), ordered like the pose but with 3 numbers per rotation, so
          v = 3 + joints for planar hinges. Positions in m/s (world axes), angles in rad/s,
          rotations as angular velocity in rad/s in the rotating body's own axes, which is
          MuJoCo's convention for the velocities of free and ball joints.
        """
        t = np.asarray(t, dtype=float)
        start, end = t - VELOCITY_STEP / 2, t + VELOCITY_STEP / 2
        if not self.loop:
            start, end = np.clip([start, end], 0, self.duration)
        a, b = self.pose(start), self.pose(end)
        velocity = np.empty((*t.shape, self._straight_velocities.size + 3 * len(self._rotations)))
        velocity[..., self._straight_velocities] = (b - a)[..., self._straight]
        for q, v in self._rotations:
            turn = quaternion.multiply(quaternion.conjugate(a[..., q : q + 4]), b[..., q : q + 4])
            velocity[..., v : v + 3] = quaternion.rotation_vector(turn)
        if self.loop:
            return velocity / VELOCITY_STEP
        inside = (t >= 0) & (t <= self.duration)
        return velocity * np.where(inside, 1 / np.where(inside, end - start, 1), 0)[..., None]

    def phase(self, t: ArrayLike) -> np.ndarray:
        """Returns the phase at times `t`, same shape: [0, 1) looping, else clamped to [0, 1]."""
        cycles = np.asarray(t, dtype=float) / self.duration
        return cycles - np.floor(cycles) if self.loop else np.clip(cycles, 0, 1)

    def mirrored(self, pairs: Iterable[tuple[str, str]]) -> Clip:
        """Returns the clip with left and right exchanged.

        Hinge angles keep their sign, which is right for hinges about the lateral axis, the only
        ones our characters have. Rotations and the path of a free root are reflected in the
        x-z plane.

        Args:
          pairs: names of joints to swap, (right, left) in either order. Others keep their place.

        Raises:
          ValueError: if a name is unknown or a pair's joints differ in kind.
        """
        first = np.cumsum([ROOT_SIZES[self.root], *self.sizes])
        source = np.arange(self.poses.shape[1])
        for pair in pairs:
            for joint in pair:
                if joint not in self.joints:
                    raise ValueError(errors.unknown('joint', joint, self.joints))
            i, j = map(self.joints.index, pair)
            if self.sizes[i] != self.sizes[j]:
                raise ValueError(f'joints {pair[0]!r} and {pair[1]!r} differ in kind')
            left = np.arange(first[i], first[i + 1])
            right = np.arange(first[j], first[j + 1])
            source[left], source[right] = right, left
        poses = self.poses[:, source]
        if self.root == 'free':
            poses[:, 1] *= -1
        for q, _ in self._rotations:
            poses[:, q : q + 4] = quaternion.reflect(poses[:, q : q + 4])
        return dataclasses.replace(self, poses=poses)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the clip as .npz without pickled objects; an old file stays until it is whole."""
        path = pathlib.Path(path)
        part = path.with_name(f'.{path.name}.{os.getpid()}.part')
        try:
            with part.open('wb') as file:
                np.savez_compressed(
                    file, allow_pickle=False, **{f: np.asarray(getattr(self, f)) for f in _FIELDS}
                )
            os.replace(part, path)
        finally:
            part.unlink(missing_ok=True)


def load(path_or_name: str | os.PathLike[str]) -> Clip:
    """Returns a shipped clip by name, or any clip that `Clip.save` wrote by its path.

    Args:
      path_or_name: a name of `names()`, or a path: a string that ends in .npz, or a PathLike.

    Raises:
      ValueError: for an unknown name (names the closest), or a broken or malformed file
        (names file and field).
      FileNotFoundError: if there is no file at the path.
    """
    if isinstance(path_or_name, str) and not path_or_name.endswith('.npz'):
        if path_or_name not in names():
            raise ValueError(errors.unknown('clip', path_or_name, names()))
        path = resources.directory('mocap') / f'{path_or_name}.npz'
    else:
        path = pathlib.Path(path_or_name)
    content = io.BytesIO(path.read_bytes())
    fields: dict[str, Any] = {}
    field = ''
    try:
        archive = np.load(content, allow_pickle=False)
        if not isinstance(archive, np.lib.npyio.NpzFile):
            raise ValueError('a single array')
        for field in _FIELDS:
            if field not in archive:
                raise ValueError('is missing')
            fields[field] = archive[field]
    except Exception as error:  # a damaged archive fails in a dozen ways
        where = f'field {field!r}' if field else 'no readable clip'
        raise ValueError(f'{path}: {where}: {error}') from None
    for field, kind, dims in (
        ('root', 'U', 0),
        ('joints', 'U', 1),
        ('sizes', 'iu', 1),
        ('loop', 'b', 0),
        ('description', 'U', 0),
    ):
        value = fields[field]
        if value.dtype.kind not in kind or value.ndim != dims:
            raise ValueError(f'{path}: field {field!r} has type {value.dtype}, {value.ndim} axes')
        fields[field] = value.tolist()
    try:
        return Clip(name=path.stem, **fields)
    except ValueError as error:
        raise ValueError(f'{path}: {error}') from None


def names() -> list[str]:
    """Returns the names of the shipped clips, sorted."""
    return sorted(path.stem for path in resources.directory('mocap').glob('*.npz'))
