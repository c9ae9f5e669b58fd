"""What several task types do otherwise than the original; docs/differences.md has the reasons."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable

    from trl_suite.registry.spec import EnvSpec


class Difference(NamedTuple):
    """A sentence on what differs from the original, and the environments that it is about."""

    text: str
    applies: Callable[[EnvSpec], bool] = lambda spec: True


def _from(hertz: int) -> str:
    return f'MuJoCo at 300 Hz instead of Bullet at {hertz} Hz; task option substeps'


FROM_1200, FROM_3000 = Difference(_from(1200)), Difference(_from(3000))
ACTIONS = Difference('actions are in [-1, 1] and clipped; the original takes physical units')
AXES = Difference('axes are x forward, y left, z up; the original has y up and z to the right')
CONES = Difference('a ball joint is limited by one cone, as wide as the widest of its three ranges')
ROTATIONS = (
    Difference(
        "targets of ball joints are rotation vectors about the mean pose; option action_offset='original' "
        "for the original's angle and axis"
    ),
    Difference(
        'rotation errors are those of the shorter way, angular velocities of both sides in one frame'
    ),
)
OWN_CLIP = Difference("the clip is our own, close to the original's in gait and speed")
START_PHASE = Difference('the start phase is drawn uniformly instead of swept')
LANDING = Difference(
    'a step that misses its place ends the episode only if asked for; option max_landing_error'
)
FACES = Difference(
    'faces of the terrain are exactly vertical, and every start has flat ground from -1 to 1 m',
    lambda spec: spec.terrain != 'flat',
)
CUT = Difference('episodes are cut after 256 steps (discount 1)')
