"""Reference motions of a body: their clock, and features of a looping clip or of single steps."""

from __future__ import annotations

from typing import Any, NamedTuple

import mujoco
import numpy as np

from trl_suite.bodies.blocks import CLOCK, Block, Reflection, slices
from trl_suite.bodies.body import Body, Measurement
from trl_suite.bodies.state import REAL, WHOLE, allocated
from trl_suite.engine.world import WRITABLE
from trl_suite.motion import Clip, FootstepLibrary, quaternion
from trl_suite.util.compiled import compiled, compiled_inline, nearest_index, packed

CONTROL_TIMESTEP = 1 / 30  # s
DIGITS = 1e9  # the clock is rounded to 1 / DIGITS of a cycle
PHASE_BINS = 4  # parts of a cycle in the observation
# Intervals of a cycle, of a planar or a spatial clip, and of a single step. For the suite's planar clips,
# link positions are then exact to 0.5 mm.
PLANAR_SAMPLES, SPATIAL_SAMPLES, STEP_SAMPLES = 1024, 256, 64


class Clock(NamedTuple):
    """Phase of each simulation in the cycle of its reference motion, (n,).

    Attributes:
      start: phase at the start of the episode.
      steps: control steps since the start.
      cycles: time in periods of the motion: the phase, not wrapped.
      phase: phase in [0, 1).
    """

    start: np.ndarray = REAL
    steps: np.ndarray = WHOLE
    cycles: np.ndarray = REAL
    phase: np.ndarray = REAL


@compiled
def tick(i: int, period: float, clock: Clock) -> None:
    """Advances a clock of this period, s, by a control step."""
    clock.steps[i] += 1
    cycles = clock.start[i] + clock.steps[i] * (CONTROL_TIMESTEP / period)
    # Rounded, so that rounding errors of the sum do not delay the switch of stance at half a cycle.
    clock.cycles[i] = np.rint(cycles * DIGITS) / DIGITS
    clock.phase[i] = clock.cycles[i] - np.floor(clock.cycles[i])


@compiled
def observe_phase(i: int, columns: Any, clock: Clock, observation: np.ndarray) -> None:
    """Writes the block `PHASE`."""
    if columns.phase >= 0:
        phase = clock.phase[i]
        observation[i, columns.phase] = phase
        for k in range(PHASE_BINS):
            observation[i, columns.phase + 1 + k] = np.floor(phase * PHASE_BINS) == k


# Its phase is that of the cycle; a mirrored observation has that of the step.
PHASE = Block(
    'phase',
    1 + PHASE_BINS,
    '1',
    'phase of the cycle in [0, 1); then the one-hot of its quarter',
    CLOCK,
    Reflection(
        np.append(0, 1 + np.roll(np.arange(PHASE_BINS), PHASE_BINS // 2)), np.ones(1 + PHASE_BINS)
    ),
    kept=tuple(range(1 + PHASE_BINS // 2)),
    kept_meaning='phase of the step in [0, 1); then the one-hot of its half',
)


class TrackTable(NamedTuple):
    """Features of tracks for compiled functions; see `Reference` for their columns.

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


class Reference:
    """Features of tracks, each tabulated over [0, 1]: one looping clip, or many single steps.

    Except `heading` and `root`, they are independent of the position and heading of the reference.
    The ground is at height 0.

    Attributes:
      columns: those of `feature_columns` first, then `heading` (rad) and `root` x, y (m) on the
        track's own path, then `positions` of link centres from the root and `velocities` of them, both
        in the heading frame, m and m/s; in the plane also `root_rate` (2,), the velocity of the root
        in x and z, m/s, and `extents` (3 * G,) of the collision geoms, see `link_extents`.
      tracks: the table, for compiled functions.
    """

    def __init__(self, body: Body, model: mujoco.MjModel, poses: np.ndarray, rates: np.ndarray):
        """Tabulates tracks.

        Args:
          body: the body, bound to a world.
          model: its compiled model.
          poses: poses of each track at evenly spaced times, including its end, (tracks, samples +
            1, columns of a pose).
          rates: velocities, (tracks, samples + 1, columns of a velocity).
        """
        count, samples = poses.shape[0], poses.shape[1] - 1
        n, planar = count * (samples + 1), not body.character.spec.spatial
        poses, rates = poses.reshape(n, -1), rates.reshape(n, -1)
        names = {'geom_xpos', 'geom_xmat'} if planar else set()
        names |= set(body.data.physics._fields) - {'sensordata'}
        found = tabulated(model, body.pose_qpos, body.pose_dof, poses, rates, sorted(names))
        measured = _measured(body, found, np.zeros((n, model.nsensordata)))
        features = measured.features.reshape(count, samples + 1, -1)
        links = len(body.links)
        parts = {
            'features': _continuous(features, body.columns['rotations']),
            'heading': np.unwrap(measured.heading.reshape(count, -1), axis=1).reshape(-1, 1),
            'root': measured.root[:, :2],
            'positions': _places(measured.pose[:, 1:], links),
            'velocities': _places(measured.velocity, links),
        }
        if planar:
            geoms = body.geoms
            places, frames = found['geom_xpos'][:, geoms], found['geom_xmat'][:, geoms]
            boxes, root = model.geom_aabb[geoms], poses[:, None, :2]
            parts['root_rate'] = rates[:, :2]
            parts['extents'] = _extents(places, frames, boxes, root).reshape(n, -1)
        table = np.concatenate(list(parts.values()), axis=1)
        self.tracks = TrackTable(table, np.diff(table, axis=0, append=table[-1:]), samples)
        self.columns = slices({name: part.shape[1] for name, part in parts.items()})
        self.columns = body.columns | self.columns

    @classmethod
    def of_clip(cls, clip: Clip, body: Body, model: mujoco.MjModel, tracks: int = 1) -> Reference:
        """Returns a reference with the cycle of a looping clip, which is split into tracks."""
        samples = SPATIAL_SAMPLES if body.character.spec.spatial else PLANAR_SAMPLES
        each = samples // tracks
        poses, rates = clip.state(np.linspace(0, clip.duration, samples + 1))
        rows = each * np.arange(tracks)[:, None] + np.arange(each + 1)
        return cls(body, model, poses[rows], rates[rows])

    @classmethod
    def of_steps(cls, steps: FootstepLibrary, body: Body, model: mujoco.MjModel) -> Reference:
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

    def planar_state(
        self, share: np.ndarray, track: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns poses, rates and extents of a planar reference; see `PlanarBody.place`."""
        found, column = self.features(share, track), self.columns
        parts = np.zeros((len(share), 1)), found[:, column['height']], found[:, column['angles']]
        rates = found[:, column['root_rate']], found[:, column['rates']]
        extents = np.ascontiguousarray(found[:, column['extents']]).reshape(len(share), 3, -1)
        return np.concatenate(parts, axis=1), np.concatenate(rates, axis=1), extents


def _measured(body: Body, found: dict[str, np.ndarray], sensors: np.ndarray) -> Measurement:
    """Returns the measurement of bodies on level ground from fields of the physics."""
    n, data = len(sensors), body.data
    for name, array in (found | {'sensordata': sensors}).items():
        array.flags.writeable = name in WRITABLE  # for the same Numba types as those of a world
    fields = {name: found.get(name, sensors) for name in data.physics._fields}
    like = data.measurement._asdict()
    measured = allocated(Measurement, n, **{name: array[0] for name, array in like.items()})
    nowhere = data.columns._replace(**dict.fromkeys(data.columns._fields, -1))
    stacked = data._replace(
        physics=type(data.physics)(**fields),
        ground=body.level_ground(n),
        measurement=measured,
        columns=nowhere,
    )
    body.measure_all(np.arange(n), False, packed(stacked))
    return measured


def _places(block: np.ndarray, links: int) -> np.ndarray:
    """Returns the positions, or their rates, in a block of n links: without rotations."""
    each = block.reshape(len(block), links, -1)
    return each[..., : min(each.shape[2], 3)].reshape(len(block), -1)


def _continuous(features: np.ndarray, rotations: slice) -> np.ndarray:
    """Returns features (tracks, samples + 1, F) as rows, without sign flips of quaternions."""
    part = features[..., rotations]
    q = part.reshape(*part.shape[:2], -1, 4)
    flips = np.cumprod(np.where((q[:, 1:] * q[:, :-1]).sum(3) < 0, -1, 1), axis=1)
    q[:, 1:] *= flips[..., None]
    part[...] = q.reshape(part.shape)
    return features.reshape(-1, features.shape[2])


def tabulated(
    model: mujoco.MjModel,
    pose_qpos: np.ndarray,
    pose_dof: np.ndarray,
    poses: np.ndarray,
    rates: np.ndarray,
    names: list[str],
) -> dict[str, np.ndarray]:
    """Computes positions and velocities for many states of a model, without simulating.

    Args:
      model: the compiled model.
      pose_qpos: addresses in qpos of the columns of a pose.
      pose_dof: addresses in qvel of the columns of a velocity.
      poses: (n, columns).
      rates: (n, columns).
      names: names of fields of MjData.

    Returns:
      Field name -> array (n, ...).
    """
    data = mujoco.MjData(model)
    views = {name: getattr(data, name) for name in names}  # updated in place
    found = {name: np.empty((len(poses), *view.shape)) for name, view in views.items()}
    for i, (pose, rate) in enumerate(zip(poses, rates, strict=True)):
        data.qpos[pose_qpos] = pose
        data.qvel[pose_dof] = rate
        # Not mj_forward: contacts, inertia and forces would take most of the time.
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        for name, view in views.items():
            found[name][i] = view
    return found


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


def mean_targets(poses: np.ndarray, motion: Clip | FootstepLibrary, symmetric: bool) -> np.ndarray:
    """Returns the mean target of every degree of freedom over poses.

    Args:
      poses: poses of a motion, (k, columns of a pose).
      motion: motion with the layout of these poses.
      symmetric: whether mirror images of the poses count too; for spatial characters with pairs of joints.

    Returns:
      Rotation vectors of ball joints in rad, angles of hinges, in link order.
    """
    if symmetric:
        poses = np.concatenate([poses, motion.layout.mirror.pose(poses)])
    return joint_targets(motion, poses).mean(0)


def joint_targets(motion: Clip | FootstepLibrary, poses: np.ndarray) -> np.ndarray:
    """Returns targets of position control for poses (..., columns): rotation vectors and angles."""
    layout = motion.layout
    parts, column = [], 3 if layout.root == 'planar' else 7
    for size in layout.sizes:
        value = poses[..., column : column + size]
        parts.append(quaternion.rotation_vector(value) if size == 4 else value)
        column += size
    return np.concatenate(parts, axis=-1)
