"""Options of tasks that control joints 30 times per second, and what reference motions they take."""

from __future__ import annotations

import dataclasses
import numbers
from collections.abc import Callable, Collection, Sequence
from typing import Any

import numpy as np

from trl_suite.actuation import character_muscles
from trl_suite.actuation.models import original_ranges
from trl_suite.actuation.muscles import PLAIN, Muscle
from trl_suite.bodies.reference import mean_targets
from trl_suite.bodies.spatial import MAPS
from trl_suite.characters import Character
from trl_suite.motion import Clip, FootstepLibrary
from trl_suite.terrain.planar.features import MOST_LENGTH
from trl_suite.util import errors
from trl_suite.util.options import Config, option, within

MOST_SUBSTEPS = 1000  # physics steps per control step
MOST_SAMPLES = 10_000  # heights observed on a line
SUBSTEPS = 10  # physics at 300 Hz; trained policies score the same from 240 to 1200 Hz
ACTION_OFFSETS = ('clip', 'posture', 'original')  # of position control
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


def terrain_maps(default: str | tuple[str, ...] = ()) -> Any:
    """Returns the option of maps of the terrain in three dimensions."""
    meaning = (
        "observed maps of the terrain: 'height' (block terrain), 'velocity' (block surface), both, or () "
        'for none'
    )
    return option(default, meaning, choices=MAPS)


def physics_steps(least: int) -> Any:
    """Returns the option of physics steps per control step."""
    meaning = 'physics steps per control step of 1/30 s'
    return option(SUBSTEPS, meaning, at_least=least, at_most=MOST_SUBSTEPS)


def joint_angle(by_default: str) -> Any:
    """Returns the option of the scale of actions of position control."""
    meaning = f'joint angle per unit action{by_default}'
    return option(None, meaning, unit='rad', above=0, actuation='position')


def flat_ground() -> Any:
    """Returns the option of where the ground is flat at the start, in the plane."""
    return option(
        'intended',
        "position of the flat ground at the start: 'intended', up to 1 m to both sides of the root, or "
        "'upstream', as in the original",
        choices=('intended', 'upstream'),
    )


def faces() -> Any:
    """Returns the option of how steep faces are, in the plane."""
    return option(
        None,
        'length of the ramps in place of vertical faces of steps, walls and gaps; by default the '
        "terrain's FaceLength, which is 0 in all presets",
        **within(0, MOST_LENGTH, 'm'),
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class GroundConfig(Config):
    """Options of tasks on random ground; `terrain_observation` is an option of the subclass."""

    terrain_level: float = option(
        0.0,
        "index of the terrain's parameter set; fractions interpolate: 0.5 is half-way between sets 0 and 1",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        observed = getattr(self, 'terrain_observation', ())
        if observed == 1:
            raise ValueError('terrain_observation is 1; expected 0, or at least 2 heights')
        if isinstance(observed, (str, Collection)):
            names = (observed,) if isinstance(observed, str) else tuple(observed)
            self._set('terrain_observation', names)


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrackingConfig(GroundConfig):
    """Options of tasks that track a motion."""

    start_phase: float | Sequence[Sequence[float]] | None = option(
        None,
        'phase at the start of an episode, in [0, 1), or pairs of bounds between which it is drawn; by '
        'default drawn from [0, 1)',
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        start_phases(self.start_phase)
        if (
            getattr(self, 'action_offset', None) == 'original'
            and getattr(self, 'action_scale', None) is not None
        ):
            raise ValueError("action_offset 'original' has fixed ranges: it takes no action_scale")


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlanarConfig(TrackingConfig):
    """Options of tasks that track a clip in the plane."""

    terrain_observation: int = planar_heights()
    substeps: int = physics_steps(4)
    action_offset: str = option(
        'clip',
        "pose at action 0: the mean pose of the clip ('clip'), or the working posture ('posture'); "
        "'original': the original's map, where [-1, 1] spans four times the joint range about its middle",
        choices=ACTION_OFFSETS,
        actuation='position',
    )
    action_scale: float | None = joint_angle('; by default 1.5')
    spawn: str = flat_ground()
    face_length: float | None = faces()


@dataclasses.dataclass(frozen=True, kw_only=True)
class SpatialConfig(TrackingConfig):
    """Options of tasks that track a motion in three dimensions."""

    terrain_observation: str | Collection[str] = terrain_maps()
    substeps: int = physics_steps(6)
    action_offset: str = option(
        'clip',
        "pose at action 0: the mean pose of the reference motion, made symmetric ('clip'), or the working "
        "posture ('posture'); 'original': the original's map, with an angle and an axis for every ball joint",
        choices=ACTION_OFFSETS,
        actuation='position',
    )
    action_scale: float | None = joint_angle(
        "; by default 1 with action_offset 'clip', 1.5 with 'posture'"
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class MirroredConfig(SpatialConfig):
    """Options of tasks that can mirror observations and actions in left stance."""

    mirrored: bool = option(
        False,
        'mirror observations and actions in left stance, so that every step is in right stance',
    )


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


def cycle_poses(clip: Clip) -> np.ndarray:
    """Returns poses of a cycle, whose mean is action 0 of position control, (k, columns).

    Raises:
      ValueError: the clip does not loop.
    """
    if not clip.loop:
        raise ValueError(
            f'clip {clip.name!r} is not looping: the task tracks no clip that does not loop'
        )
    return clip.pose(np.linspace(0, clip.duration, TYPICAL_POSES, endpoint=False))


def joint_options(
    character: Character,
    config: Any,
    model: str,
    motion: Clip | FootstepLibrary | None,
    typical: Any,
) -> tuple[dict[str, Any], tuple[Muscle, ...]]:
    """Returns the options of `actuation.add` for an actuation model, and the muscles.

    Args:
      character: the character.
      config: the options of the task, of which some are for one actuation model only.
      model: the actuation model.
      motion: the motion, if there is one.
      typical: its poses whose mean is action 0 of position control, (k, columns of a pose).

    Raises:
      ValueError: an option that is for another actuation model.
    """
    offset, scale = getattr(config, 'action_offset', 'clip'), getattr(config, 'action_scale', None)
    muscle_set = getattr(config, 'muscle_set', PLAIN)
    if model != 'position' and (offset != 'clip' or scale is not None):
        raise ValueError(
            f'action_offset and action_scale are options of position control, not {model} control'
        )
    if model == 'muscle':
        return {'muscle_set': muscle_set}, character_muscles(character, muscle_set)
    if muscle_set != PLAIN:
        raise ValueError(f'muscle_set is an option of muscle control, not {model} control')
    options: dict[str, Any] = {}
    if model == 'position' and offset == 'original':
        options = {'rotations': 'angle_axis'} if character.spec.spatial else _original(character)
    elif model == 'position':
        options = {} if scale is None else {'action_scale': scale}
        if offset == 'clip' and motion is not None:
            spatial = character.spec.spatial
            options = {'action_scale': ACTION_SCALE, **options} if spatial else options
            symmetric = spatial and bool(character.spec.mirror)
            options['action_offset'] = mean_targets(typical, motion, symmetric)
    return options, ()


def _original(character: Character) -> dict[str, Any]:
    """Returns action_offset and action_scale of the original in the plane, rad."""
    ranges = original_ranges(character)
    return {'action_offset': ranges.mean(1), 'action_scale': 2 * np.ptp(ranges, axis=1)}


def start_phases(option: float | Sequence[Sequence[float]] | None) -> Callable[[float], float]:
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
