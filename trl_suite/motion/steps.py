"""A library of single steps, and the batched selection of the clip nearest to a plan.

Every clip is one step that begins in right stance, when both feet are on the ground, and ends when
the left foot lands. For left stance the same clips are mirrored, or others of the same steps, for a
walk that is not symmetric. The stance foot (its ankle, where the foot is flat on the ground) is over
the origin, and the walker's heading is along x at the start; the heading of the pelvis oscillates
slightly about it.

As in the original (anim/MocapStepController.cpp), clips are selected by seven features, `FEATURES`,
of the current state and the plan, relative to the current heading of the root. The original's
weights scale with the spread of each feature over the library; here they are fixed. The initial foot
positions tell steps after a stand from steps after a step; in most shipped libraries they are equal.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import os
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from trl_suite.motion import quaternion
from trl_suite.motion.clip import STEPS_SUFFIX, VELOCITY_STEP, Clip, shipped
from trl_suite.motion.layout import LARGEST, Layout
from trl_suite.util import archive, errors, resources

FEATURES = (
    *('right foot ahead of the root', 'right foot left of the root'),
    *('left foot ahead of the root', 'left foot left of the root'),
    *('landing place ahead of the stance foot', 'landing place left of the stance foot'),
    'heading after the step',
)  # m, m, m, m, m, m, rad; for a walker in right stance
WEIGHTS = (*[0.54] * 6, 0.48)  # of the features, 1/m and 1/rad
_REFLECTED = np.array([1, -1, 1, -1, 1, -1, -1])  # signs of features in left stance
MOST_STEPS = 10_000
_FIELDS = archive.forms(
    'labels fiu 2, times fiu 1, poses fiu 3, joints U 1, sizes iu 1, previous fiu 2, features fiu 2, '
    'description U 0'
)
_LEFT = archive.forms('left_poses fiu 3')  # of walks that are not symmetric


@dataclasses.dataclass(frozen=True, eq=False)
class FootstepLibrary:
    """A library of k steps of one character; frames, angles and columns as in `Clip`, root free.

    Attributes:
      name: name, for messages.
      times: key times of every clip in s, shape (n,).
      poses: shape (k, n, d), read-only.
      joints: joint names in the character's link order.
      sizes: columns per joint.
      labels: length m (forward), width m (outwards, to the swing side) and turn rad (change of
        heading, positive to the swing side) of each step, shape (k, 3): the landing place of the
        swing foot relative to the stance foot. The same for mirrored steps.
      previous: labels of the step before each, shape (k, 3): start place of the swing foot.
      features: features of each clip at its start, with its own landing place as the plan,
        shape (k, 7).
      description: one line.
      left_poses: poses of the same steps in left stance, mirrored, shape (k, n, d); None: `poses`.

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
    left_poses: np.ndarray | None = None

    def __post_init__(self) -> None:
        put, what = functools.partial(object.__setattr__, self), f'steps {self.name!r}'
        put('description', str(self.description))
        put('joints', tuple(map(str, self.joints)))
        put('sizes', tuple(map(int, self.sizes)))
        put('times', errors.floats(f'{what}, times', self.times))
        put('poses', errors.floats(f'{what}, poses', self.poses))
        if self.poses.ndim != 3 or not 0 < len(self.poses) <= MOST_STEPS:
            raise ValueError(
                f'{what}, poses: has shape {self.poses.shape}; expected (k, n, d), k at most {MOST_STEPS}'
            )
        two = self.left_poses is not None
        if two:
            own = errors.floats(f'{what}, left_poses', self.left_poses, self.poses.shape)
            put('left_poses', own)
        for field, columns in (('labels', 3), ('previous', 3), ('features', len(FEATURES))):
            array, shape = getattr(self, field), (len(self), columns)
            put(field, errors.floats(f'{what}, {field}', array, shape, LARGEST))
        for i, mirrored in itertools.product(range(len(self)), (False, True)[: 1 + two]):
            self.clip(i, mirrored)  # checks the other fields

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

    @functools.cached_property
    def _stances(self) -> np.ndarray:
        """Poses in right stance, and those in left stance before mirroring, (2, k, n, d)."""
        return np.stack([self.poses, self.poses if self.left_poses is None else self.left_poses])

    def clip(self, index: int, mirrored: bool = False) -> Clip:
        """Returns one step as a clip that does not loop."""
        length, width, turn = self.labels[index]
        clip = Clip(
            f'{self.name}[{index}]',
            self.times,
            self._stances[int(mirrored), index],
            'free',
            self.joints,
            self.sizes,
            description=f'step of {length:g} m, {width:g} m wide, turning {turn:g} rad outwards',
        )
        return clip.mirrored() if mirrored else clip

    def pose(self, index: ArrayLike, t: ArrayLike, mirrored: ArrayLike = False) -> np.ndarray:
        """Returns poses of steps, each at its own time.

        Args:
          index: indices of clips, any shape (...) that broadcasts with `t`.
          t: times in s, clamped to the step.
          mirrored: True for a step in left stance, broadcasts too.

        Returns:
          Poses, shape (..., d).
        """
        return _mirrored(mirrored, self._blend(index, t, mirrored), self.layout.mirror.pose)

    def velocity(self, index: ArrayLike, t: ArrayLike, mirrored: ArrayLike = False) -> np.ndarray:
        """Returns velocities of steps as `Clip.velocity` does, with one-sided ends; beyond them, those of the ends."""
        which, time, mirrored = np.broadcast_arrays(index, np.asarray(t, dtype=float), mirrored)
        time = np.clip(time, 0, self.duration)
        start = np.maximum(time - VELOCITY_STEP / 2, 0)
        end = np.minimum(time + VELOCITY_STEP / 2, self.duration)
        change = self.layout.change(*self._blend(which, np.stack([start, end]), mirrored))
        velocity = change / (end - start)[..., None]
        return _mirrored(mirrored, velocity, self.layout.mirror.velocity)

    def _blend(self, index: ArrayLike, t: ArrayLike, mirrored: ArrayLike) -> np.ndarray:
        """Returns what `pose` does, before mirroring."""
        which, time = np.broadcast_arrays(np.asarray(index), np.asarray(t, dtype=float))
        time = np.clip(time, 0, self.duration)
        i = np.clip(np.searchsorted(self.times, time, side='right') - 1, 0, self.times.size - 2)
        u = (time - self.times[i]) / (self.times[i + 1] - self.times[i])
        left = np.asarray(mirrored, dtype=int)
        return self.layout.blend(
            self._stances[left, which, i], self._stances[left, which, i + 1], u
        )

    def select(self, query: np.ndarray, weights: ArrayLike = WEIGHTS) -> np.ndarray:
        """Returns the clip nearest to each query.

        Distance is the norm of the weighted difference of features.

        Args:
          query: features of the current state and the plan, shape (n, 7); see `features`.
          weights: weights of the features, shape (7,).
        """
        gap = (query[:, None] - self.features) * np.asarray(weights)
        return np.argmin((gap * gap).sum(axis=2), axis=1)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the library as .npz without pickled objects; replaces an existing file at the end.

        Raises:
          ValueError: another suffix.
          OSError: the file cannot be written.
        """
        found = {field: getattr(self, field) for field in (*_FIELDS, *_LEFT)}
        archive.write(path, {field: value for field, value in found.items() if value is not None})


def features(
    root: np.ndarray,
    heading: np.ndarray,
    right: np.ndarray,
    left: np.ndarray,
    target: np.ndarray,
    target_heading: np.ndarray,
    right_stance: np.ndarray,
) -> np.ndarray:
    """Returns the features by which clips are selected, for n walkers; see `FEATURES`.

    Args:
      root: position, world x and y in m, shape (n, 2).
      heading: direction of the root's x axis in the ground plane, rad, shape (n,).
      right: right ankle, x and y in m, shape (n, 2).
      left: left ankle, x and y in m, shape (n, 2).
      target: planned landing place of the swing ankle, x and y in m, shape (n, 2).
      target_heading: the planned heading in the world, rad, shape (n,).
      right_stance: whether the right foot is the stance foot, shape (n,).

    Returns:
      Features, shape (n, 7); for walkers in left stance, mirrored.
    """
    side = np.asarray(right_stance)[..., None]
    stance, swing = np.where(side, right, left), np.where(side, left, right)
    turn = np.asarray(target_heading) - heading
    turn = np.arctan2(np.sin(turn), np.cos(turn))
    ways = (stance - root, swing - root, target - stance)
    seen = np.concatenate(
        [*(quaternion.rotate_xy(way, -np.asarray(heading)) for way in ways), turn[..., None]],
        axis=-1,
    )
    return seen * np.where(side, 1, _REFLECTED)


def load(path_or_name: str | os.PathLike[str]) -> FootstepLibrary:
    """Returns a shipped library by its name, or a saved one by its path.

    Args:
      path_or_name: a name of `names()`, or a path: a string that ends in .npz, or a PathLike.

    Raises:
      ValueError: for an unknown name (the message has the closest), or a broken or malformed file
        (the message names file and field).
      FileNotFoundError: if there is no file at the path.
    """
    path = shipped(path_or_name, 'step library', names(), STEPS_SUFFIX)
    arrays = archive.arrays(path, 'step library')
    with errors.naming(path):
        name = path.stem.removesuffix(STEPS_SUFFIX)
        forms = {**_FIELDS, **(_LEFT if arrays.keys() & _LEFT.keys() else {})}
        return FootstepLibrary(name, **archive.fields(arrays, forms))


def names() -> list[str]:
    """Returns the sorted names of the shipped libraries: of a character, or of one and a style."""
    found = resources.directory('mocap').glob(f'*{STEPS_SUFFIX}.npz')
    return sorted(path.stem.removesuffix(STEPS_SUFFIX) for path in found)


def _mirrored(
    where: ArrayLike, values: np.ndarray, mirror: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """Returns values (..., c), mirrored where `where` (...) is true."""
    where = np.asarray(where)
    if not where.any():
        return values
    return np.where(where[..., None], mirror(values), values)
