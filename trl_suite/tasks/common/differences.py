"""Differences from the original that task types share; docs/differences.md has the reasons."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable

    from trl_suite.registry.spec import EnvSpec


class Difference(NamedTuple):
    """A difference from the original, and a function that returns whether it applies to a spec."""

    text: str
    applies: Callable[[EnvSpec], bool] = lambda spec: True


def _from(hertz: int) -> str:
    return f'MuJoCo at 300 Hz instead of Bullet at {hertz} Hz; see the option substeps'


FROM_1200, FROM_3000 = Difference(_from(1200)), Difference(_from(3000))
ACTIONS = Difference('actions are in [-1, 1] and clipped; the original takes physical units')
AXES = Difference('axes are x forward, y left, z up; the original has y up and z to the right')
CONES = Difference('a ball joint is limited by one cone, as wide as the widest of its three ranges')
ROTATIONS = (
    Difference(
        'targets of ball joints are rotation vectors about the mean pose; the option '
        "action_offset='original' selects the original's angle and axis"
    ),
    Difference(
        'rotation errors are the shortest rotation; angular velocities of character and reference are '
        'compared in the same frame'
    ),
)
OWN_CLIP = Difference(
    "the clip was made for this suite, with gait and speed close to the original's"
)
START_PHASE = Difference('the start phase is drawn uniformly, not in a fixed sequence')
LANDING = Difference('a landing error ends the episode only with the option max_landing_error')
FACES = Difference(
    'faces of gaps, walls and steps are exactly vertical, and every start has flat ground from -1 to 1 m',
    lambda spec: spec.terrain != 'flat',
)
CUT = Difference('episodes are truncated after 256 steps (discount 1)')
