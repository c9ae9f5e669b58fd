"""The reference motion of a spatial character: features of a looping clip, or of single steps."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import mujoco
import numpy as np

from trl_suite.engine.world import WRITABLE
from trl_suite.kinematics.planar_reference import tabulated
from trl_suite.kinematics.spatial import (
    LINK_POSE,
    LINK_VELOCITY,
    Measured,
    SpatialIds,
    SpatialState,
    empty_measurement,
    feature_columns,
    measure_all,
)
from trl_suite.motion import Clip, FootstepLibrary, quaternion
from trl_suite.terrain.spatial import windows as spatial_ground
from trl_suite.util.compiled import compiled_inline, nearest_index, packed

CYCLE_SAMPLES = 256  # of a looping clip
STEP_SAMPLES = 64  # of a single step
_LEVEL = spatial_ground.Capacity(
    level=True, grid=False, boxes=0, belts=0, movers=0, strips=False
)  # fmt: skip


class TrackTable(NamedTuple):
    """Features of tracks for compiled functions; see `SpatialReference` for their columns.

    Attributes:
      table: features of all tracks, one track after the other, (tracks * (samples + 1), columns).
      steps: differences to the next sample, (tracks * (samples + 1), columns).
      samples: number of intervals of a track.
    """

    table: np.ndarray
    steps: np.ndarray
    samples: int


@compiled_inline
def moment(share: float, track: int, tracks: TrackTable) -> tuple[int, float]:
    """Returns the row of the table for a share in [0, 1] of a track, and the fraction to the next."""
    u = share * tracks.samples
    sample = nearest_index(u, tracks.samples)
    return sample + track * (tracks.samples + 1), u - sample


@compiled_inline
def feature(row: int, fraction: float, column: int, tracks: TrackTable) -> float:
    """Returns a feature, interpolated at a row and fraction from `moment`."""
    return tracks.steps[row, column] * fraction + tracks.table[row, column]


class SpatialReference:
    """Features of tracks, each tabulated over [0, 1]: one looping clip, or many single steps.

    Except `heading` and `root`, they are independent of the position and heading of the reference.
    The ground is at height 0.

    Attributes:
      columns: those of `feature_columns` first, then `heading` (rad) and `root` x, y (m) on the
        track's own path, then `positions` (3 * links) of link centres from the root and
        `velocities` (3 * links) of them, both in the heading frame, m and m/s.
      tracks: the table, for compiled functions.
    """

    def __init__(
        self, body: SpatialIds, model: mujoco.MjModel, poses: np.ndarray, rates: np.ndarray
    ) -> None:
        """Tabulates tracks.

        Args:
          body: ids of the character.
          model: its compiled model.
          poses: poses of each track at evenly spaced times, including its end, (tracks, samples +
            1, columns of a pose).
          rates: velocities, (tracks, samples + 1, columns of a velocity).
        """
        count, samples = poses.shape[0], poses.shape[1] - 1
        n, links = count * (samples + 1), len(body.links)
        state = _stacked(model, body, poses.reshape(n, -1), rates.reshape(n, -1))
        ground = spatial_ground.empty(n, _LEVEL)
        ground.level[:] = 0.0
        measurement = empty_measurement(n, body)
        measure_all(np.arange(n), packed(Measured(body, state, ground, measurement)))
        own = feature_columns(body)
        heading = np.unwrap(measurement.heading.reshape(count, -1), axis=1).reshape(-1, 1)
        features = measurement.features.reshape(count, samples + 1, -1)
        parts = {
            'features': _continuous(features, own['rotations']),
            'heading': heading,
            'root': measurement.root[:, :2],
            'positions': measurement.pose[:, 1:]
            .reshape(n, links, LINK_POSE)[..., :3]
            .reshape(n, -1),
            'velocities': measurement.velocity.reshape(n, links, LINK_VELOCITY)[..., :3].reshape(
                n, -1
            ),
        }
        table = np.concatenate(list(parts.values()), axis=1)
        self.tracks = TrackTable(table, np.diff(table, axis=0, append=table[-1:]), samples)
        stops = itertools.accumulate(part.shape[1] for part in parts.values())
        self.columns = own | {
            name: slice(stop - part.shape[1], stop)
            for (name, part), stop in zip(parts.items(), stops, strict=True)
            if name != 'features'
        }

    @classmethod
    def of_clip(cls, clip: Clip, body: SpatialIds, model: mujoco.MjModel) -> SpatialReference:
        """Returns a reference with the cycle of a looping clip as track 0."""
        times = np.linspace(0, clip.duration, CYCLE_SAMPLES + 1)
        return cls(body, model, clip.pose(times)[None], clip.velocity(times)[None])

    @classmethod
    def of_steps(
        cls, steps: FootstepLibrary, body: SpatialIds, model: mujoco.MjModel
    ) -> SpatialReference:
        """Returns a reference with a library's k steps in right stance, then their mirror images."""
        times = np.linspace(0, steps.duration, STEP_SAMPLES + 1)
        index = np.tile(np.arange(len(steps)), 2)[:, None]
        mirrored = (np.arange(2 * len(steps)) >= len(steps))[:, None]
        poses = steps.pose(index, times, mirrored)
        return cls(body, model, poses, steps.velocity(index, times, mirrored))

    def features(self, share: np.ndarray, track: np.ndarray) -> np.ndarray:
        """Returns the features of tracks (n,) at fractions (n,) in [0, 1], (n, columns)."""
        tracks = self.tracks
        u = share * tracks.samples
        sample = np.minimum(np.floor(u), tracks.samples - 1)
        row = sample.astype(np.int64) + track * (tracks.samples + 1)
        return tracks.steps[row] * (u - sample)[:, None] + tracks.table[row]


def _stacked(
    model: mujoco.MjModel, body: SpatialIds, poses: np.ndarray, rates: np.ndarray
) -> SpatialState:
    """Returns fields of the physics for poses (n, ...) and rates (n, ...), without simulating."""
    names = [name for name in SpatialState._fields if name != 'sensordata']
    everything = dict.fromkeys(names, slice(None))
    found = tabulated(model, body.qpos, body.dof, poses, rates, everything)
    found['sensordata'] = np.zeros((len(poses), model.nsensordata))
    for name, array in found.items():
        array.flags.writeable = name in WRITABLE  # for the same Numba types as those of a world
    return SpatialState(**found)


def _continuous(features: np.ndarray, rotations: slice) -> np.ndarray:
    """Returns features (tracks, samples + 1, F) as rows, without sign flips of quaternions."""
    part = features[..., rotations]
    q = part.reshape(*part.shape[:2], -1, 4)
    flips = np.cumprod(np.where((q[:, 1:] * q[:, :-1]).sum(3) < 0, -1, 1), axis=1)
    q[:, 1:] *= flips[..., None]
    part[...] = q.reshape(part.shape)
    return features.reshape(-1, features.shape[2])


def mean_targets(clip_poses: np.ndarray, clip: Clip | FootstepLibrary) -> np.ndarray:
    """Returns the mean target of every degree of freedom over poses and their mirror images.

    Args:
      clip_poses: (k, columns of a pose).
      clip: motion with the layout of these poses.

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
