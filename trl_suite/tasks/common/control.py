"""Options of tasks that control joints 30 times per second, and what reference motions they take."""

from __future__ import annotations

import dataclasses
import numbers
from collections.abc import Callable, Collection, Sequence
from typing import Any

import numpy as np

from trl_suite.bodies.reference import joint_targets, mean_targets
from trl_suite.characters import Character
from trl_suite.motion import Clip, FootstepLibrary
from trl_suite.tasks.task import (
    ACTION_OFFSETS,
    MOST_SAMPLES,
    MOST_SUBSTEPS,
    SPAWNS,
    START_PHASE,
    SUBSTEPS,
    TERRAIN_LEVEL,
)
from trl_suite.util import errors
from trl_suite.util.options import Config, option

HEIGHT_MAP = "observed map of the terrain: 'height', or () for none"
ACTION_SCALE = 1.0  # rad per unit action about the mean pose of a spatial motion
TYPICAL_POSES = 256  # poses of a cycle; their mean is action 0 of position control


def planar_heights() -> Any:
    """Returns the option of ground heights in the plane."""
    return option(
        0,
        'number of observed ground heights, from 0.5 m behind to 3 m ahead of the root; 0: none',
        at_least=0,
        at_most=MOST_SAMPLES,
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlanarConfig(Config):
    """Options of tasks that track a clip in the plane."""

    terrain_observation: int = planar_heights()
    substeps: int = option(
        SUBSTEPS, 'physics steps per control step of 1/30 s', at_least=4, at_most=MOST_SUBSTEPS
    )
    action_offset: str = option(
        'clip',
        "pose at action 0: the mean pose of the clip ('clip'), or the working posture ('posture'); "
        "'original': the original's map, where [-1, 1] spans four times the joint range about its middle",
        choices=ACTION_OFFSETS,
        actuation='position',
    )
    action_scale: float | None = option(
        None,
        'joint angle per unit action; by default 1.5',
        unit='rad',
        above=0,
        actuation='position',
    )
    start_phase: float | Sequence[Sequence[float]] | None = option(None, START_PHASE)
    spawn: str = option(
        'intended',
        "position of the flat ground at the start: 'intended', up to 1 m to both sides of the root, or "
        "'upstream', as in the original",
        choices=SPAWNS,
    )
    terrain_level: float = option(0.0, TERRAIN_LEVEL)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.terrain_observation == 1:
            raise ValueError('terrain_observation is 1; expected 0, or at least 2 heights')
        start_phases(self.start_phase)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SpatialConfig(Config):
    """Options of tasks that track a motion in three dimensions."""

    terrain_observation: str | Collection[str] = option((), HEIGHT_MAP, choices=('height',))
    substeps: int = option(
        SUBSTEPS, 'physics steps per control step of 1/30 s', at_least=6, at_most=MOST_SUBSTEPS
    )
    action_offset: str = option(
        'clip',
        "pose at action 0: the mean pose of the reference motion, made symmetric ('clip'), or the working "
        "posture ('posture'); 'original': the original's map, with an angle and an axis for every ball joint",
        choices=ACTION_OFFSETS,
        actuation='position',
    )
    action_scale: float | None = option(
        None,
        "joint angle per unit action; by default 1 with action_offset 'clip', 1.5 with 'posture'",
        unit='rad',
        above=0,
        actuation='position',
    )
    start_phase: float | Sequence[Sequence[float]] | None = option(None, START_PHASE)
    terrain_level: float = option(0.0, TERRAIN_LEVEL)

    def __post_init__(self) -> None:
        super().__post_init__()
        self._set('terrain_observation', maps(self.terrain_observation))
        start_phases(self.start_phase)
        if self.action_offset == 'original' and self.action_scale is not None:
            raise ValueError("action_offset 'original' has fixed ranges: it takes no action_scale")


@dataclasses.dataclass(frozen=True, kw_only=True)
class MirroredConfig(SpatialConfig):
    """Options of tasks that can mirror observations and actions in left stance."""

    mirrored: bool = option(
        False,
        'mirror observations and actions in left stance, so that every step is in right stance',
    )


def maps(names: str | Collection[str]) -> tuple[str, ...]:
    """Returns one or several names of maps as a tuple."""
    return (names,) if isinstance(names, str) else tuple(names)


def check_motion(character: Character, motion: Clip | FootstepLibrary) -> None:
    """Checks that a motion is for this character.

    Raises:
      ValueError: it is not; the message has the joints of both.
    """
    spec, root = character.spec, motion.layout.root
    if spec.spatial == (root == 'planar') or tuple(motion.joints) != tuple(spec.joints):
        raise ValueError(
            f'motion {motion.name!r} ({root} root, joints {", ".join(motion.joints)}) does not fit '
            f'character {spec.name!r}: expected one with a {"free" if spec.spatial else "planar"} root '
            f'and joints {", ".join(spec.joints)}'
        )
    sizes = tuple(np.where(character.spherical, 4, 1).tolist())
    if motion.sizes != sizes:
        raise ValueError(
            f'motion {motion.name!r} has {motion.sizes} columns for its joints; character '
            f'{spec.name!r} has {sizes}'
        )


def check_cycle(clip: Clip) -> None:
    """Checks that a clip loops.

    Raises:
      ValueError: it does not.
    """
    if not clip.loop:
        raise ValueError(
            f'clip {clip.name!r} is not looping: the task tracks no clip that does not loop'
        )


def cycle_poses(clip: Clip) -> np.ndarray:
    """Returns poses of a cycle, whose mean is action 0 of position control, (k, columns)."""
    return clip.pose(np.linspace(0, clip.duration, TYPICAL_POSES, endpoint=False))


def position_range(
    character: Character,
    motion: Clip | FootstepLibrary,
    typical_poses: np.ndarray,
    action_offset: str,
    action_scale: float | None,
) -> dict[str, Any]:
    """Returns the arguments of position control for an action_offset and an action_scale."""
    spatial = character.spec.spatial
    if action_offset == 'original':
        return {'rotations': 'angle_axis'} if spatial else original_range(character, action_scale)
    options: dict[str, Any] = {} if action_scale is None else {'action_scale': action_scale}
    if action_offset == 'clip' and spatial:
        options.setdefault('action_scale', ACTION_SCALE)
        options['action_offset'] = mean_targets(typical_poses, motion)
    elif action_offset == 'clip':
        options['action_offset'] = joint_targets(motion, typical_poses).mean(0)
    return options


def original_range(character: Character, action_scale: float | None) -> dict[str, Any]:
    """Returns action_offset and action_scale of the original in the plane, rad."""
    ranges = np.array(
        [
            joint.original_range or limits
            for joint, limits in zip(
                character.spec.joints.values(), character.joint_ranges.tolist(), strict=True
            )
        ]
    )
    free = ~np.isfinite(ranges).all(1)
    ranges = np.where(free[:, None], (-np.pi, np.pi), ranges)
    scale = 2 * (ranges[:, 1] - ranges[:, 0]) if action_scale is None else action_scale
    return {'action_offset': ranges.mean(1), 'action_scale': scale}


def start_phases(
    option: float | Sequence[Sequence[float]] | None,
) -> Callable[[float], float]:
    """Returns a function from a uniform draw in [0, 1) to the phase at the start of an episode.

    Args:
      option: None: the phase is the draw. A number in [0, 1): the phase is this number. Pairs of
        numbers, ascending in [0, 1]: the phase is uniform in the union of these intervals.

    Raises:
      ValueError: anything else.
    """
    if option is None:
        return lambda drawn: drawn
    if isinstance(option, numbers.Real):
        phase = float(option) if errors.is_number(option) else np.nan
        if not 0 <= phase < 1:
            raise ValueError(f'start_phase is {option}; expected a number in [0, 1), or pairs')
        return lambda drawn: phase
    try:
        pairs = np.asarray(option, float)
    except (TypeError, ValueError, OverflowError):
        pairs = np.empty(0)
    if pairs.ndim != 2 or pairs.shape[1] != 2 or not len(pairs) or not (
        (np.diff(pairs, axis=1) > 0).all() and (np.diff(pairs.ravel()) >= 0).all()
        and pairs[0, 0] >= 0 and pairs[-1, 1] <= 1
    ):  # fmt: skip
        raise ValueError(
            f'start_phase is {option}; expected a number in [0, 1), or ascending pairs '
            'of numbers in [0, 1]'
        )
    ends = np.cumsum(np.diff(pairs, axis=1))

    def phase_of(drawn: float) -> float:
        covered = drawn * ends[-1]  # of the union of the intervals
        i = min(int(np.searchsorted(ends, covered, side='right')), len(ends) - 1)
        return float(pairs[i, 1] - (ends[i] - covered))

    return phase_of


def check_position_options(model: str, action_offset: str, action_scale: float | None) -> None:
    """Checks that options of position control are only given with this actuation model.

    Raises:
      ValueError: they are given with another one.
    """
    if model != 'position' and (action_offset != 'clip' or action_scale is not None):
        raise ValueError(
            f'action_offset and action_scale are options of position control, not {model} control'
        )
