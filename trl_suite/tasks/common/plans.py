"""Options for drawing footstep plans, and for pushes that disturb the walker."""

from __future__ import annotations

import dataclasses

from trl_suite.util.options import Config, Range, option

# Meanings of options of all tasks that follow footstep plans.
MAX_LANDING_ERROR = (
    'distance between a foot and its landing place above which landing ends the episode; by default there '
    'is no limit'
)
FOOTSTEP_SCALE = 'factor of the squared landing error in the reward; larger values reward accuracy'
ROOT_TURN_LIMIT = 1.2  # rad; largest turn of a plan relative to the root


@dataclasses.dataclass(frozen=True, kw_only=True)
class StraightPlans(Config):
    """Options for drawing plans in the plane."""

    length: Range = option(Range(0.4, 0.4), 'length of a step', unit='m', at_least=0)
    change: float = option(
        0.1, 'probability that the length of a step is redrawn', at_least=0, at_most=1
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Plans(Config):
    """Options for drawing plans; a plan has the next landing places of both feet and a heading.

    At every switch of stance, the second landing place of the old plan becomes the first of the new
    one. The new second place is displaced from it by the length of a step along the planned
    heading, and by its width to the side of the foot.
    """

    length: Range = option(Range(0.5, 0.5), 'length of a step', unit='m', at_least=0)
    width: Range = option(
        Range(0.15, 0.15), 'distance between the feet to the side', unit='m', at_least=0
    )
    change: float = option(
        0.1, 'probability that length and width of a step are redrawn', at_least=0, at_most=1
    )
    turn: float = option(
        0.25,
        'standard deviation of the change of heading from one step to the next',
        unit='rad',
        at_least=0,
    )
    sharp: float = option(
        0.1, 'probability of a sharp turn instead, drawn from [-pi, pi)', at_least=0, at_most=1
    )
    from_root: float = option(
        0.0,
        'probability that a plan is relative to position and heading of the root, as the plans of a '
        'high-level controller are',
        at_least=0,
        at_most=1,
    )
    root_length: Range = option(Range(0.2, 0.7), 'length of its steps', unit='m', at_least=0)
    root_width: Range = option(Range(0.08, 0.28), 'width of its steps', unit='m', at_least=0)
    root_turn: float = option(
        0.3,
        f'standard deviation of its turn from the current heading; clipped to +-{ROOT_TURN_LIMIT}',
        unit='rad',
        at_least=0,
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Pushes(Config):
    """Repeated horizontal forces on the torso's centre of mass, in random directions.

    Times are rounded to control steps.
    """

    force: Range = option(Range(50.0, 150.0), 'force', unit='N', at_least=0)
    duration: Range = option(Range(0.2, 0.4), 'duration of a push', unit='s', at_least=0)
    interval: Range = option(
        Range(1.0, 2.0),
        'time from the end of a push, or the start of the episode, to the next push',
        unit='s',
        at_least=0,
    )
