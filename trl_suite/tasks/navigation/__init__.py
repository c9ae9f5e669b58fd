"""Navigation to goals in three dimensions, by joint targets or by footstep plans."""

from typing import Any

from trl_suite import motion
from trl_suite.motion import Clip, FootstepLibrary
from trl_suite.tasks import task_type as differences
from trl_suite.tasks.common.goals import Ball
from trl_suite.tasks.navigation import description
from trl_suite.tasks.navigation.direct import (
    DirectConfig,
    DirectNavigation,
    DirectNavigationConfig,
    hidden_plan,
)
from trl_suite.tasks.navigation.hierarchical import HierarchicalConfig, HierarchicalNavigation
from trl_suite.tasks.task import Task
from trl_suite.tasks.task_type import Difference, Parts, TaskType, tracking


def _direct(parts: Parts, config: Any) -> Task:
    if config.reward == 'original':
        steps = motion.load_steps(parts.character.spec.name)
        return hidden_plan(parts.character, parts.arena, steps, config, parts.actuation)
    return tracking(DirectNavigation)(parts, config)


_HIERARCHICAL = (
    differences.AXES, differences.CONES,
    Difference(
        'a step is a whole footstep, from one switch of stance to the next; in the original it is 1/30 s, '
        'and the caller decides when to plan; see the option interface'
    ),
    Difference(
        'the footstep controller is part of the environment, and its policy was trained for this suite; in '
        'the original the caller runs it; see the option controller'
    ),
    Difference(
        'actions are in [-1, 1], clipped, and scaled as in the native learner of the original, whose Python '
        'interface takes m and rad'
    ),
    Difference(
        'the reward is for the whole step; in the original it is for the time since the last plan, which '
        'may be a few ms'
    ),
    Difference(
        'episodes are truncated after 200 s (discount 1); the configured limit of the original has no effect'
    ),
)  # fmt: skip
_DIRECT = (
    differences.FROM_1200, differences.AXES, differences.ACTIONS, *differences.ROTATIONS,
    differences.CONES,
    Difference("the clip was made for this suite, 1.3 m/s; the original's walks at 1.535 m/s"),
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
        motion=FootstepLibrary,
        actuations=('position',),
        samples='plans',
        differences=(
            *_HIERARCHICAL,
            Difference('whether a goal is reached or has expired is tested once per step'),
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
        motion=FootstepLibrary,
        actuations=('position',),
        samples='plans',
        differences=(
            *_HIERARCHICAL,
            Difference('whether ball and goal have expired is tested once per step'),
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
                'the reward depends on the goal, and a goal that is reached is redrawn; in the original, the '
                'reward is for footsteps that are not observed, and the goal is fixed; see the option reward'
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
                'there is a ball, which half of the reward depends on; the configuration of the original '
                'has none'
            ),
        ),
    ),
)  # fmt: skip
