"""A clip: one reference motion as key frames, sampled at any time.

Sampling follows the original simulator (anim/Motion.cpp): positions and angles interpolate
linearly, rotations along the shorter arc. In a looping clip the root displacement accumulates over
cycles, height included, and the heading if `turning` is set. The velocity differs intentionally: a
central instead of a forward difference, over the same 1/60 s.
"""

from __future__ import annotations

import dataclasses
import functools
import os
import pathlib
from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike

from trl_suite.motion import quaternion
from trl_suite.motion.layout import LARGEST, SHORTEST, Layout, Mirror
from trl_suite.util import archive, errors, resources

VELOCITY_STEP = 1 / 60  # s between the two poses of a finite difference
STEPS_SUFFIX = '_steps'  # suffix of files that contain a step library instead of a clip
_UNIT_TOLERANCE = 1e-6
_STRAIGHT = 1e-9  # rad; a cycle with a smaller heading change is straight
_FIELDS = archive.forms(
    'root U 0, times fiu 1, poses fiu 2, joints U 1, sizes iu 1, loop b 0, description U 0, turning b 0'
)


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
      turning: whether the heading change of a cycle accumulates too, as on a circle; otherwise
        every cycle of a loop has the heading of the first. Needs a free root.

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
    turning: bool = False

    def __post_init__(self) -> None:
        put, what = functools.partial(object.__setattr__, self), f'clip {self.name!r}'
        put('root', str(self.root))
        put('description', str(self.description))
        put('joints', tuple(map(str, self.joints)))
        put('sizes', tuple(map(int, self.sizes)))
        put('loop', bool(self.loop))
        put('turning', bool(self.turning))
        try:
            columns = self.layout.columns
        except ValueError as error:
            raise ValueError(f'{what}, {error}') from None
        if self.turning and self.root == 'planar':
            raise ValueError(f'{what}, turning: a planar root has no heading')
        put('times', errors.floats(f'{what}, times', self.times, most=LARGEST))
        n = self.times.size
        if self.times.ndim != 1 or n < 2:
            raise ValueError(f'{what}, times: has shape {self.times.shape}; expected 2 or more')
        put('poses', errors.floats(f'{what}, poses', self.poses, (n, columns), LARGEST))
        if self.times[0] != 0 or np.any(np.diff(self.times) < SHORTEST):
            raise ValueError(
                f'{what}, times: must start at 0 and increase by at least {SHORTEST:g} s'
            )
        for q, _ in self.layout.rotations:
            norms = np.linalg.norm(self.poses[:, q : q + 4], axis=1)
            for frame in np.flatnonzero(np.abs(norms - 1) > _UNIT_TOLERANCE):
                raise ValueError(
                    f'{what}, poses: quaternion at column {q} of frame {frame} has length '
                    f'{norms[frame]:.6g}'
                )

    @functools.cached_property
    def layout(self) -> Layout:
        """The columns of poses and velocities."""
        return Layout(self.root, self.joints, self.sizes)

    @functools.cached_property
    def _cycle(self) -> np.ndarray:
        """Change of the pose per cycle, shape (d,): displacement and full rotations of pitch."""
        change = np.zeros(self.poses.shape[1])
        change[: self.displacement.size] = self.displacement
        if self.root == 'planar':  # pitch must not jump back after a somersault
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
    def heading_change(self) -> float:
        """Change of a free root's heading per cycle, rad in (-pi, pi]; planar: 0."""
        if self.root == 'planar':
            return 0.0
        start, end = quaternion.heading(self.poses[[0, -1], 3:7])
        return float(np.pi - (np.pi - (end - start)) % (2 * np.pi))

    @property
    def speed(self) -> float:
        """Mean horizontal speed, m/s."""
        return float(np.linalg.norm(self.displacement[:-1])) / self.duration

    def pose(self, t: ArrayLike) -> np.ndarray:
        """Returns the poses at times `t` in s.

        Args:
          t: times, any shape (...), may be negative. A looping clip repeats with its displacement
            accumulated, also before time 0; any other clip holds its first and last frame.

        Returns:
          Poses, shape (..., d).
        """
        t = np.asarray(t, dtype=float)
        cycle = np.floor(t / self.duration) if self.loop else np.zeros_like(t)
        t = np.clip(t - cycle * self.duration, 0, self.duration)
        i = np.clip(np.searchsorted(self.times, t, side='right') - 1, 0, self.times.size - 2)
        u = (t - self.times[i]) / (self.times[i + 1] - self.times[i])
        poses = self.layout.blend(self.poses[i], self.poses[i + 1], u)
        if self.turning:
            return self._turned(poses, cycle)
        return poses + cycle[..., None] * self._cycle

    def _turned(self, poses: np.ndarray, cycle: np.ndarray) -> np.ndarray:
        """Moves poses of the first cycle to later cycles (...)."""
        turn = self.heading_change
        angle = cycle * turn
        # The displacements of cycles are the sides of a polygon; that of k cycles is its chord.
        small = abs(turn) < _STRAIGHT
        chord = cycle if small else np.sin(angle / 2) / np.sin(turn / 2)
        start, way = self.poses[0, :3], self.displacement
        shift = quaternion.rotate_xy(way[:2], (angle - turn) / 2) * chord[..., None]
        poses[..., :2] = quaternion.rotate_xy(poses[..., :2] - start[:2], angle) + start[:2] + shift
        poses[..., 2] += cycle * way[2]
        poses[..., 3:7] = quaternion.multiply(quaternion.about_z(angle), poses[..., 3:7])
        return poses

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
        return self.state(t)[1]

    def state(self, t: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Returns the results of `pose` and `velocity` in one call."""
        t = np.asarray(t, dtype=float)
        start, end = t - VELOCITY_STEP / 2, t + VELOCITY_STEP / 2
        if not self.loop:
            start, end = np.clip([start, end], 0, self.duration)
        poses, before, after = self.pose(np.stack([t, start, end]))
        velocity = self.layout.change(before, after)
        if self.loop:
            return poses, velocity / VELOCITY_STEP
        inside = (t >= 0) & (t <= self.duration)
        share = np.where(inside, 1 / np.where(inside, end - start, 1), 0)
        return poses, velocity * share[..., None]

    def mirrored(self, pairs: Iterable[tuple[str, str]] | None = None) -> Clip:
        """Returns the clip with left and right exchanged; see `Mirror`.

        For characters whose hinges are about the lateral axis, as those of the suite; other hinges,
        such as roll and yaw joints of robots, would have to change their sign, and do not.

        Args:
          pairs: names of joints to swap, (right, left) in either order. Other joints keep their
            columns. By default the joints named `right_...` and `left_...`.

        Raises:
          ValueError: if a name is unknown or the joints of a pair differ in type.
        """
        mirror = self.layout.mirror if pairs is None else Mirror(self.layout, pairs)
        return dataclasses.replace(self, poses=mirror.pose(self.poses))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the clip as .npz without pickled objects; an existing file is replaced at the end.

        Raises:
          ValueError: another suffix.
          OSError: the file cannot be written.
        """
        archive.write(path, {field: getattr(self, field) for field in _FIELDS})


def load(path_or_name: str | os.PathLike[str]) -> Clip:
    """Returns a shipped clip by its name, or a clip that `Clip.save` wrote by its path.

    Args:
      path_or_name: a name of `names()`, or a path: a string that ends in .npz, or a PathLike.

    Raises:
      ValueError: for an unknown name (the message has the closest), or a broken or malformed file
        (the message names file and field).
      FileNotFoundError: if there is no file at the path.
    """
    path = shipped(path_or_name, 'clip', names())
    arrays = archive.arrays(path, 'clip')
    arrays.setdefault('turning', np.array(False))
    with errors.naming(path):
        return Clip(path.stem, **archive.fields(arrays, _FIELDS))


def names() -> list[str]:
    """Returns the names of the shipped clips, sorted."""
    stems = sorted(path.stem for path in resources.directory('mocap').glob('*.npz'))
    return [stem for stem in stems if not stem.endswith(STEPS_SUFFIX)]


def shipped(
    path_or_name: str | os.PathLike[str], kind: str, known: list[str], suffix: str = ''
) -> pathlib.Path:
    """Returns the path of a shipped file, or the argument if it is a PathLike or ends in .npz."""
    if not isinstance(path_or_name, str) or path_or_name.lower().endswith('.npz'):
        return pathlib.Path(path_or_name)
    errors.check_known(kind, known, path_or_name)
    return resources.directory('mocap') / f'{path_or_name}{suffix}.npz'
