"""A library of single steps, and the choice of the clip nearest to a plan, for many at once.

Every clip is one step that begins in right stance, the moment both feet are down, and ends when
the left foot lands. Left stance plays the same clips mirrored. The stance foot (its ankle, where
the foot stands flat) is over the origin and the walker heads along x at the start; the pelvis turns
about that heading a little as it walks.

Clips are chosen as the original does (anim/MocapStepController.cpp) by seven features, `FEATURES`,
of the moment and the plan, all seen along the root's present heading. Its weights scale with the
spread of each feature over the library; ours are fixed, and drop the places of the feet at the
start, which are alike in all clips of a library that varies one step after another.
"""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from trl_suite.motion import quaternion
from trl_suite.motion.clip import STEPS_SUFFIX, VELOCITY_STEP, Clip, shipped
from trl_suite.motion.layout import Layout
from trl_suite.util import archive, resources

FEATURES = (
    *('right foot ahead of the root', 'right foot left of the root'),
    *('left foot ahead of the root', 'left foot left of the root'),
    *('landing place ahead of the stance foot', 'landing place left of the stance foot'),
    'heading after the step',
)  # m, m, m, m, m, m, rad; of a walker in right stance
WEIGHTS = (0.0, 0.0, 0.0, 0.0, 0.54, 0.54, 0.48)  # of the features, 1/m and 1/rad
_REFLECTED = np.array([1, -1, 1, -1, 1, -1, -1])  # features in left stance
_FIELDS: dict[str, tuple[str, int] | None] = {
    'times': None,
    'poses': None,
    'joints': ('U', 1),
    'sizes': ('iu', 1),
    'labels': None,
    'previous': None,
    'features': None,
    'description': ('U', 0),
}


@dataclasses.dataclass(frozen=True, eq=False)
class Steps:
    """A library of k steps of one character; frames, angles and columns as in `Clip`, root free.

    Attributes:
      name: name, for messages.
      times: key times of every clip in s, shape (n,).
      poses: shape (k, n, d), read-only.
      joints: joint names in the character's link order.
      sizes: columns per joint.
      labels: length m (forward), width m (outwards, to the swing side) and turn rad (change of
        heading, positive to the swing side) of each step, shape (k, 3): where the swing foot lands,
        from the stance foot. They hold for mirrored steps as well.
      previous: labels of the step before each, shape (k, 3): where the swing foot comes from.
      features: of each clip at its start, with its own landing as the plan, shape (k, 7).
      description: one line.

    Raises:
      ValueError: if a field is malformed; the message names library and field.
    """

    name: str
    times: np.ndarray
    poses: np.ndarray
    joints: tuple[str, ...]
    sizes: tuple[int, ...]
    labels: np.ndarray
    previous: np.ndarray
    features: np.ndarray
    description: str = ''

    def __post_init__(self) -> None:
        for field in ('times', 'poses', 'labels', 'previous', 'features'):
            try:
                array = np.array(getattr(self, field), dtype=float)  # a copy, to be locked
            except (TypeError, ValueError) as error:
                raise self._error(field, f'an array of numbers is needed ({error})') from None
            array.setflags(write=False)
            object.__setattr__(self, field, array)
        object.__setattr__(self, 'joints', tuple(map(str, self.joints)))
        object.__setattr__(self, 'sizes', tuple(map(int, self.sizes)))
        if self.poses.ndim != 3 or not len(self.poses):
            raise self._error('poses', f'one or more clips are needed, shape {self.poses.shape}')
        for field, columns in (('labels', 3), ('previous', 3), ('features', len(FEATURES))):
            array, shape = getattr(self, field), (len(self), columns)
            if array.shape != shape:
                raise self._error(field, f'shape is {array.shape}, needed {shape}')
            if not np.isfinite(array).all():
                raise self._error(field, 'not finite')
        for i in range(len(self)):
            self.clip(i)  # checks the rest

    def _error(self, field: str, what: str) -> ValueError:
        return ValueError(f'steps {self.name!r}, {field}: {what}')

    def __len__(self) -> int:
        return len(self.poses)

    @property
    def duration(self) -> float:
        """Length of every step, s."""
        return float(self.times[-1])

    @functools.cached_property
    def layout(self) -> Layout:
        """The columns of poses and velocities."""
        return Layout('free', self.joints, self.sizes)

    def clip(self, index: int, mirrored: bool = False) -> Clip:
        """Returns one step as a clip that does not loop."""
        length, width, turn = self.labels[index]
        clip = Clip(
            f'{self.name}[{index}]',
            self.times,
            self.poses[index],
            'free',
            self.joints,
            self.sizes,
            description=f'step of {length:g} m, {width:g} m wide, turning {turn:g} rad outwards',
        )
        return clip.mirrored() if mirrored else clip

    def pose(self, index: ArrayLike, t: ArrayLike, mirrored: ArrayLike = False) -> np.ndarray:
        """Returns poses of steps, each at its own time.

        Args:
          index: clips, any shape (...) that broadcasts with `t`.
          t: times in s, clamped to the step.
          mirrored: where the step is one in left stance, broadcasts too.

        Returns:
          Poses, shape (..., d).
        """
        which, time = np.broadcast_arrays(np.asarray(index), np.asarray(t, dtype=float))
        time = np.clip(time, 0, self.duration)
        i = np.clip(np.searchsorted(self.times, time, side='right') - 1, 0, self.times.size - 2)
        u = (time - self.times[i]) / (self.times[i + 1] - self.times[i])
        poses = self.layout.blend(self.poses[which, i], self.poses[which, i + 1], u)
        return _mirrored(mirrored, poses, self.layout.mirror.pose)

    def velocity(self, index: ArrayLike, t: ArrayLike, mirrored: ArrayLike = False) -> np.ndarray:
        """Returns velocities of steps as `Clip.velocity` does; the ends have a one-sided one."""
        which, time = np.broadcast_arrays(np.asarray(index), np.asarray(t, dtype=float))
        time = np.clip(time, 0, self.duration)
        start = np.maximum(time - VELOCITY_STEP / 2, 0)
        end = np.minimum(time + VELOCITY_STEP / 2, self.duration)
        change = self.layout.change(*self.pose(which, np.stack([start, end])))
        velocity = change / (end - start)[..., None]
        return _mirrored(mirrored, velocity, self.layout.mirror.velocity)

    def landing(self, index: ArrayLike, mirrored: ArrayLike = False) -> np.ndarray:
        """Returns labels with a fixed sense: forward m, to the left m, turn to the left rad."""
        sign = np.where(mirrored, -1, 1)[..., None]
        return self.labels[np.asarray(index)] * np.where([False, True, True], sign, 1)

    def select(self, query: np.ndarray, weights: ArrayLike = WEIGHTS) -> np.ndarray:
        """Returns the clip nearest to each query.

        Args:
          query: features of the moment and the plan, shape (n, 7); see `features`.
          weights: of the features, shape (7,). Distance is the norm of the weighted difference.

        Returns:
          Indices, shape (n,).
        """
        gap = (query[:, None] - self.features) * np.asarray(weights)
        return np.argmin((gap * gap).sum(axis=2), axis=1)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the library as .npz without pickled objects, whole or not at all."""
        archive.write(path, {field: getattr(self, field) for field in _FIELDS})


def features(
    root: np.ndarray,
    heading: np.ndarray,
    right: np.ndarray,
    left: np.ndarray,
    target: np.ndarray,
    target_heading: np.ndarray,
    right_stance: np.ndarray,
) -> np.ndarray:
    """Returns what clips are chosen by, for n walkers; see `FEATURES`.

    Args:
      root: position, world x and y in m, shape (n, 2).
      heading: direction of the root's x axis in the ground plane, rad, shape (n,).
      right: right ankle, x and y in m, shape (n, 2).
      left: left ankle, x and y in m, shape (n, 2).
      target: where the swing ankle shall land, x and y in m, shape (n, 2).
      target_heading: the planned heading in the world, rad, shape (n,).
      right_stance: whether the right foot is the stance foot, shape (n,).

    Returns:
      Shape (n, 7); those of a walker in left stance are mirrored.
    """
    side = np.asarray(right_stance)[..., None]
    stance, swing = np.where(side, right, left), np.where(side, left, right)
    turn = np.asarray(target_heading) - heading
    turn = np.arctan2(np.sin(turn), np.cos(turn))
    ways = (stance - root, swing - root, target - stance)
    seen = np.concatenate(
        [*(quaternion.turned(way, -np.asarray(heading)) for way in ways), turn[..., None]], axis=-1
    )
    return seen * np.where(side, 1, _REFLECTED)


def load(path_or_name: str | os.PathLike[str]) -> Steps:
    """Returns a shipped library by its character's name, or any by the path it was saved to.

    Args:
      path_or_name: a name of `names()`, or a path: a string that ends in .npz, or a PathLike.

    Raises:
      ValueError: for an unknown name (names the closest), or a broken or malformed file
        (names file and field).
      FileNotFoundError: if there is no file at the path.
    """
    path = shipped(path_or_name, 'step library', names(), STEPS_SUFFIX)
    fields = archive.read(path, 'step library', _FIELDS)
    try:
        return Steps(name=path.stem.removesuffix(STEPS_SUFFIX), **fields)
    except ValueError as error:
        raise ValueError(f'{path}: {error}') from None


def names() -> list[str]:
    """Returns the names of the shipped libraries, those of their characters, sorted."""
    found = resources.directory('mocap').glob(f'*{STEPS_SUFFIX}.npz')
    return sorted(path.stem.removesuffix(STEPS_SUFFIX) for path in found)


def _mirrored(
    where: ArrayLike, values: np.ndarray, mirror: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """Returns values (..., c), mirrored in the rows `where` (...) says so."""
    where = np.asarray(where)
    if not where.any():
        return values
    return np.where(where[..., None], mirror(values), values)
