"""Tasks that go to places in three dimensions, by joint targets or by plans of footsteps."""

from typing import Any

from trl_suite import motion
from trl_suite.motion import Clip, Steps
from trl_suite.tasks.components import differences
from trl_suite.tasks.components.ball import Ball
from trl_suite.tasks.components.differences import Difference
from trl_suite.tasks.navigation import description
from trl_suite.tasks.navigation.direct import (
    DirectConfig,
    DirectNavigation,
    DirectNavigationConfig,
    hidden_plan,
)
from trl_suite.tasks.navigation.hierarchical import HierarchicalConfig, HierarchicalNavigation
from trl_suite.tasks.task import Task
from trl_suite.tasks.task_type import Parts, TaskType, tracking


def _direct(parts: Parts, config: Any) -> Task:
    if config.reward == 'original':
        steps = motion.load_steps(parts.character.spec.name)
        return hidden_plan(parts.character, parts.arena, steps, config, parts.actuation)
    return tracking(DirectNavigation)(parts, config)


_HIERARCHICAL = (
    differences.AXES, differences.CONES,
    Difference(
        'a step is a whole footstep, from one switch of stance to the next; that of the original is 1/30 s '
        'and leaves the cadence to the caller; task option interface'
    ),
    Difference(
        'the footstep controller is inside, and trained by us; the original leaves it to the caller; task '
        'option controller'
    ),
    Difference(
        'actions are in [-1, 1], clipped, and scaled as by the native learner of the original; its Python '
        'interface takes m and rad'
    ),
    Difference(
        'the reward is over the whole step; that of the original is since the last plan, down to a few ms'
    ),
    Difference(
        'episodes are cut after 200 s (discount 1); the limit that the original configures ends none'
    ),
)  # fmt: skip
_DIRECT = (
    differences.FROM_1200, differences.AXES, differences.ACTIONS, *differences.ROTATIONS,
    differences.CONES,
    Difference("the clip is our own, 1.3 m/s; the original's walks at 1.535 m/s"),
    differences.START_PHASE, differences.CUT,
)  # fmt: skip

TYPES = (
    TaskType(
        name='goal_navigation',
        title='goal_navigation',
        spatial=True,
        config=HierarchicalConfig,
        make=lambda parts, config: HierarchicalNavigation(parts.character, parts.arena, parts.motion, config),
        description=description.HIERARCHICAL,
        motion=Steps,
        actuations=('position',),
        samples='plans',
        differences=(
            *_HIERARCHICAL,
            Difference('whether a goal is reached or its time over is looked at once a step'),
        ),
    ),
    TaskType(
        name='soccer',
        title='soccer',
        spatial=True,
        config=HierarchicalConfig,
        make=lambda parts, config: HierarchicalNavigation(
            parts.character, parts.arena, parts.motion, config, Ball(parts.arena)
        ),
        description=description.HIERARCHICAL,
        motion=Steps,
        actuations=('position',),
        samples='plans',
        differences=(
            *_HIERARCHICAL,
            Difference('the times of ball and goal are looked at once a step'),
        ),
    ),
    TaskType(
        name='direct_navigation',
        title='direct_navigation',
        spatial=True,
        config=DirectNavigationConfig,
        make=_direct,
        description=description.DIRECT,
        motion=Clip,
        differences=(
            *_DIRECT,
            Difference(
                'the reward leads to the goal, and a goal that is reached is drawn anew; that of the '
                'original is for footsteps that are not observed, and its goal stays; task option reward'
            ),
        ),
    ),
    TaskType(
        name='direct_soccer',
        title='direct_soccer',
        spatial=True,
        config=DirectConfig,
        make=lambda parts, config: DirectNavigation(
            parts.character, parts.arena, parts.motion, config, Ball(parts.arena),
            actuation_model=parts.actuation,
        ),
        description=description.DIRECT,
        motion=Clip,
        differences=(
            *_DIRECT,
            Difference(
                'there is a ball, and half of the reward is for it; the configuration of the original has '
                'none'
            ),
        ),
    ),
)  # fmt: skip
