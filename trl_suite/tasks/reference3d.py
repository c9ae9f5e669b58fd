"""Motion in three dimensions as a table: what a character is compared with at any moment."""

from __future__ import annotations

import mujoco
import numpy as np

from trl_suite.motion import Clip, Steps, quaternion
from trl_suite.tasks.figure3d import Kinematics, stacked
from trl_suite.tasks.task import consecutive

CYCLE_SAMPLES = 256  # of a looping clip
STEP_SAMPLES = 64  # of a single step


class SpatialReference:
    """Features of tracks, each tabulated over [0, 1]: one looping clip, or many single steps.

    All are independent of where the reference is and of the ground, which lies at 0. See `columns`:
    those of `Kinematics` first, then `heading` rad and `root` x, y (m) of the track's own path, then
    `positions` (3 * links) of link centres from the root and `velocities` (3 * links) of them, both
    in the heading frame, m and m/s.
    """

    def __init__(
        self, kinematics: Kinematics, model: mujoco.MjModel, poses: np.ndarray, rates: np.ndarray
    ) -> None:
        """Tabulates tracks.

        Args:
          kinematics: of the character.
          model: its compiled model.
          poses: of each track at evenly spaced moments, the last one the end, (tracks, samples + 1,
            columns of a pose).
          rates: the velocities, (tracks, samples + 1, columns of a velocity).
        """
        tracks, samples = poses.shape[0], poses.shape[1] - 1
        flat = stacked(
            model, kinematics, poses.reshape(-1, poses.shape[2]), rates.reshape(-1, rates.shape[2])
        )
        found = kinematics.measure(flat, lambda x, y: np.zeros_like(x))
        heading = np.unwrap(found.heading.reshape(tracks, -1), axis=1).reshape(-1, 1)
        links = 3 * len(kinematics.links)
        parts = [
            _continuous(found.features.reshape(tracks, samples + 1, -1), kinematics), heading,
            found.root[:, :2], found.positions.reshape(-1, links),
            found.velocities.reshape(-1, links),
        ]  # fmt: skip
        table = np.concatenate(parts, axis=1)
        self._samples, self._table = samples, table
        self._steps = np.diff(table, axis=0, append=table[-1:])
        own = kinematics.columns['height'].stop
        self.columns = {
            **kinematics.columns,
            **{
                name: slice(own + part.start, own + part.stop)
                for name, part in consecutive({
                    'heading': 1, 'root': 2, 'positions': links, 'velocities': links,
                }).items()
            },
        }  # fmt: skip

    @classmethod
    def of_clip(cls, clip: Clip, kinematics: Kinematics, model: mujoco.MjModel) -> SpatialReference:
        """The cycle of a looping clip as track 0."""
        times = np.linspace(0, clip.duration, CYCLE_SAMPLES + 1)
        return cls(kinematics, model, clip.pose(times)[None], clip.velocity(times)[None])

    @classmethod
    def of_steps(
        cls, steps: Steps, kinematics: Kinematics, model: mujoco.MjModel
    ) -> SpatialReference:
        """A library: its k steps in right stance as tracks 0 to k - 1, then those in left stance."""
        times = np.linspace(0, steps.duration, STEP_SAMPLES + 1)
        index = np.tile(np.arange(len(steps)), 2)[:, None]
        mirrored = (np.arange(2 * len(steps)) >= len(steps))[:, None]
        poses = steps.pose(index, times, mirrored)
        return cls(kinematics, model, poses, steps.velocity(index, times, mirrored))

    def features(self, share: np.ndarray, track: np.ndarray | None = None) -> np.ndarray:
        """Returns the features of tracks (n,), 0 by default, at shares (n,) in [0, 1] of them."""
        u = share * self._samples
        sample = np.minimum(np.floor(u), self._samples - 1)
        index = sample.astype(np.int64)
        if track is not None:
            index += track * (self._samples + 1)
        found = self._steps.take(index, 0)
        found *= (u - sample)[:, None]
        found += self._table.take(index, 0)
        return found


def _continuous(features: np.ndarray, kinematics: Kinematics) -> np.ndarray:
    """Returns features (tracks, samples + 1, F) as rows, no quaternion jumping to its negative."""
    rotations = features[..., kinematics.columns['rotations']]
    q = rotations.reshape(*rotations.shape[:2], -1, 4)  # a view
    flips = np.cumprod(np.where((q[:, 1:] * q[:, :-1]).sum(3) < 0, -1, 1), axis=1)
    q[:, 1:] *= flips[..., None]
    return features.reshape(-1, features.shape[2])


def mean_targets(clip_poses: np.ndarray, clip: Clip | Steps) -> np.ndarray:
    """Returns the mean target of every degree of freedom over poses, left and right made alike.

    Args:
      clip_poses: (k, columns of a pose).
      clip: whose layout the poses have.

    Returns:
      Rotation vectors of ball joints in rad, angles of hinges, in link order.
    """
    layout = clip.layout
    both = np.concatenate([clip_poses, layout.mirror.pose(clip_poses)])
    parts, column = [], 7
    for size in layout.sizes:
        value = both[:, column : column + size]
        parts.append(quaternion.rotation_vector(value) if size == 4 else value)
        column += size
    return np.concatenate(parts, axis=1).mean(0)
