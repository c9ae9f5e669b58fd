"""How tasks are described in text and tables: sections on action, rules and time."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np

from trl_suite import terrain
from trl_suite.bodies.reference import CONTROL_TIMESTEP
from trl_suite.describe import gait
from trl_suite.describe.common import REWARD_WEIGHT, actions, reward
from trl_suite.describe.options import table_of
from trl_suite.environments.environment import Environment
from trl_suite.registry.build import task_type
from trl_suite.registry.spec import EnvSpec
from trl_suite.tasks.common import goals
from trl_suite.tasks.navigation import direct, hierarchical_rules
from trl_suite.tasks.navigation.hierarchical import CHOICE
from trl_suite.tasks.rewards import fall_condition
from trl_suite.terrain import SpatialGround
from trl_suite.terrain.spatial import ground
from trl_suite.terrain.spatial.layout import Layout
from trl_suite.util.tables import Section, Table, section

_PLANS = 'Plans: drawn at every switch of stance'
_SWING = (
    'end_effector: in the second half of a step, the error of the swing foot is its displacement from the '
    'landing place'
)
LEGEND = ' Orange and blue: planned landing places of the swing foot and of the stance foot.'
_BEADS = ' Yellow spheres: past positions of the centre of mass; red: the goal.'
_MEANINGS = {
    'first_x': 'm; landing place of the swing foot, ahead of the root',
    'first_y': 'm; landing place of the swing foot, to the left of the root',
    'second_x': 'm; next landing place of the stance foot, ahead of the root',
    'second_y': 'm; next landing place of the stance foot, to the left of the root',
    'turn': 'rad; planned heading relative to the current one, positive to the left',
}


def reward_weights(task: Any) -> tuple[str, Iterable[object]]:
    """Returns the title of a column in the table of links, and the reward weight of each joint."""
    return REWARD_WEIGHT, [joint.weight for joint in task.character.spec.joints.values()]


def action(environment: Environment) -> Section:
    """Returns the table of what each action controls."""
    action_map = environment.action_map
    title, limits = _limits(environment)
    unit = '' if action_map.unit == '1' else f' in {action_map.unit}'
    return actions(action_map, ('controls', title), limits, unit=unit)


def _limits(environment: Environment) -> tuple[str, Any]:
    """Returns the title of a column of limits, and the limit of each action."""
    task: Any = environment.task
    actuators = environment.physics.bind(task.root_entity.mjcf_model.find_all('actuator'))
    if environment.action_map.quantity == 'excitation':
        return 'peak force (N)', np.asarray(actuators.gainprm)[:, 2]
    ball, limits = task.character.spherical, task.character.torque_limits
    names = environment.action_map.names
    if not ball.any():
        return 'torque limit (N m)', limits
    if task.actuation_model == 'velocity':
        limits = np.where(ball, limits / np.sqrt(3), limits)
    # All ball joints have the same number of actions.
    each = (len(names) - np.count_nonzero(~ball)) // np.count_nonzero(ball)
    norm = '' if task.actuation_model == 'velocity' else ', norm'
    return f'torque limit (N m{norm})', np.repeat(limits, np.where(ball, each, 1))


def time(spec: EnvSpec, task: Any) -> Section:
    """Returns control and physics rates, and the length of an episode."""
    control, physics = 1 / task.control_timestep, 1 / task.physics_timestep
    return section(
        'Time',
        f'control {control:.4g} Hz, physics {physics:.4g} Hz; an episode is truncated (discount 1) after '
        f'{spec.step_limit} steps, {spec.step_limit * task.control_timestep:.3g} s',
    )


def span(values: tuple[float, float], unit: str = 'm') -> str:
    """Returns a range in words."""
    low, high = values
    return f'{low:g} {unit}' if low == high else f'{low:g} to {high:g} {unit}'


def clip(task: Any) -> Section:
    """Returns the clip that is tracked."""
    clip = task.clip
    return section(
        f'Clip: {clip.name}',
        f'{clip.description}; period {clip.duration:.4g} s, {clip.speed:.3g} m/s',
    )


def fall(task: Any, missed: str = '') -> Section:
    """Returns the conditions of failure; `missed` is a further condition."""
    links = ', '.join(task.character.spec.fall_links)
    fell = f'a fall: one of {links} touches the ground at the end of a step; ' if links else ''
    either = 'or ' if fell or missed else ''
    return section('Termination (discount 0)', f'{fell}{missed}{either}the physics diverges')


def missed(task: Any) -> str:
    """Returns the condition on the landing error; empty if there is none."""
    limit = task.config.max_landing_error
    return '' if limit is None else f'a foot lands more than {limit:g} m from its landing place; '


def _imitation(spec: EnvSpec, task: Any) -> Iterator[Section]:
    """Yields the sections on clip, reward and termination."""
    yield clip(task)
    yield reward(task)
    yield fall(task)


def _planar_footsteps(spec: Any, task: Any) -> Iterator[Section]:
    """Yields the sections on clip, plans, reward and termination."""
    yield clip(task)
    yield section(
        _PLANS,
        f'steps {span(task.plans.length)} long, straight ahead; with probability {task.plans.change:g} '
        'the length is redrawn; right stance while the phase is below 0.5',
        *_plan_options(task),
    )
    yield reward(task, _SWING)
    yield fall(task, missed(task))


def _spatial_footsteps(spec: Any, task: Any) -> Iterator[Section]:
    """Yields the sections on steps, plans, reward and termination."""
    motion, factor = task.motion, task.config.pose_scale
    yield section(
        f'Steps: {motion.name}',
        f'{motion.description}, also mirrored; the reference is the step nearest to the plan. '
        f'Period (two steps) {task.period:.4g} s; right stance while the phase is below 0.5',
    )
    yield section(_PLANS, '; '.join(_plans(task)), *_plan_options(task))
    notes = [_SWING] if factor == 1 else [_SWING, f'pose: the error is multiplied by {factor:g}']
    yield reward(task, '; '.join(notes))
    yield fall(task, missed(task))


def _plan_options(task: Any) -> tuple[str, Table]:
    return 'Options of plans:', table_of(type(task.plans))


def _plans(task: Any) -> list[str]:
    """Returns phrases on how plans are drawn."""
    plans = task.plans
    lines = [f'steps {span(plans.length)} long, feet {span(plans.width)} apart']
    if task.goal_given:
        lines.append('the heading is that of a goal, which is redrawn when it is reached')
    else:
        lines.append(
            f'the heading changes by N(0, {plans.turn:g}) rad from step to step'
            if plans.turn
            else 'straight ahead'
        )
        if plans.sharp:
            lines.append(
                f'with probability {plans.sharp:g} it changes uniformly in [-pi, pi) instead'
            )
    if plans.from_root:
        lines.append(
            f'with probability {plans.from_root:g} the plan begins anew at the stance foot, with the heading of the root'
        )
    if plans.stop:
        low, high = plans.stay
        lines.append(
            f'at a landing, the walker is to stop with probability {plans.stop:g}, and to stay for {low:g} to '
            f'{high:g} footsteps'
        )
    if plans.react:
        lines.append(f'at a landing, the plan moves by {plans.react:g} of the landing error')
    push = task.config.pushes
    if push is not None:
        (low, high), unit = (push.speed, 'm/s') if push.force is None else (push.force, 'N')
        lines.append(
            f'the {push.body or "torso"} is pushed repeatedly with {low:g} to {high:g} {unit}'
        )
    return lines


def _plan_action(environment: Environment) -> Section:
    """Returns the table of what each action plans."""
    names = environment.action_map.names
    joint, choice = (
        'action of the footstep controller',
        'the largest selects the footstep controller',
    )
    meanings = [_MEANINGS.get(name, choice if name.startswith(CHOICE) else joint) for name in names]
    return actions(environment.action_map, ('sets', 'unit and meaning'), meanings)


def _planning(spec: EnvSpec, task: Any) -> Iterator[Section]:
    """Yields the sections on controller, start, goal, reward and termination."""
    yield section(
        'Footstep controller',
        f'{", ".join(each.name for each in task.controllers)}; plans are relative to position and heading of '
        'the root at the beginning of a footstep',
    )
    yield _start(spec)
    if task.ball:
        yield _goal_and_ball(task.config.goal_distance)
        full = _full_with_ball(task)
    else:
        yield _goal(spec, task, 'far')
        full = f'the term speed is at its maximum if the step begins within {task.goal_reached:g} m of the goal'
    yield reward(task, f'target speed: {task.config.target_speed:g} m/s', full)
    every = hierarchical_rules.SAMPLE_FRAMES * CONTROL_TIMESTEP
    yield section(
        f'Termination (discount 0), sampled every {every:g} s',
        f'one of {", ".join(task.character.spec.fall_links)} {fall_condition()}; or the physics diverges',
    )


def _plan_time(spec: EnvSpec, task: Any) -> Section:
    """Returns rates, and the duration of a step and an episode."""
    duration, physics = task.control_timestep, 1 / task.physics_timestep
    return section(
        'Time',
        f'a step is {duration:.3g} s (the first of an episode may be shorter); footstep controller 30 Hz, '
        f'physics\n{physics:.4g} Hz; an episode is truncated (discount 1) after {spec.step_limit} steps, '
        f'{spec.step_limit * duration:.3g} s',
    )


def _direct(spec: EnvSpec, task: Any) -> Iterator[Section]:
    """Yields the sections on clip, start, goal, reward and termination."""
    if not isinstance(task, direct.DirectNavigation):  # reward 'original', for a hidden plan
        yield from _spatial_footsteps(spec, task)
        return
    of_ball = 'ball' in task.blocks
    yield clip(task)
    yield _start(spec)
    if of_ball:
        yield _goal_and_ball()
    else:
        yield _goal(spec, task, 'near')
    where = 'ball' if of_ball else 'goal'
    notes = [
        f"com: the clip's velocity is rotated towards the {where}; within {direct.NEAR:g} m of it, com and "
        'heading are equal to their weights'
    ]
    if of_ball:
        notes += [f'target speed: {goals.SPEED:g} m/s', _full_with_ball(task)]
    yield reward(task, *notes)
    yield fall(task)


def _full_with_ball(task: Any) -> str:
    """Returns when all terms for a ball reach their maximum."""
    return (
        f'all terms for the ball are at their maximum while it is within {task.goal_reached:g} m of the goal '
        f'and within {goals.NEAR_BALL:g} m of the walker'
    )


def _start(spec: EnvSpec) -> Section:
    """Returns the initial position in an episode."""
    layout = _layout(spec)
    where = {
        'start': 'at the origin, heading along x',
        'clear': f'up to {layout.span:g} m from the origin along x and along y, with no obstacle or belt within '
        f'{ground.START_ROOM:g} m, with any heading',
        'trail': f'on the middle of the trail, heading along it, up to '
        f'{ground.TRAIL_SPAN - ground.TRAIL_PAD:g} m from the origin along x and along y',
    }
    return section('Start', where[layout.place])


def _goal(spec: EnvSpec, task: Any, rule: str) -> Section:
    """Returns where a goal is drawn, by a rule of `terrain.spatial.ground`, and when it changes."""
    layout = _layout(spec)
    segments = '1 to 10 segments'
    near = f'up to {ground.GOAL_SPREAD:g} m from the walker along x and along y'
    if rule == 'near':
        segments = 'one segment'
        near = f'1 to {ground.GOAL_SPREAD:g} m ahead of the walker along x, where y is 0'
    where = {
        'start': near,
        'clear': f'up to {layout.span:g} m from the origin along x and along y, with no obstacle or belt within '
        f'{layout.goal_room:g} m',
        'trail': f'{segments} of the trail (2 m each) beyond the nearest, up to {ground.TRAIL_OFFSET:g} of '
        'its width from its middle',
    }[layout.place]
    away = getattr(task.config, 'goal_distance', None)
    if away is not None:
        where = f'{span(away)} from the walker, in any direction'
    return section(
        'Goal',
        f'drawn {where}; redrawn when the walker is within {task.goal_reached:g} m of it, or after '
        f'{span(goals.GOAL_LASTS, "s")}',
    )


def _goal_and_ball(away: tuple[float, float] | None = None) -> Section:
    """Returns where ball and goal are placed, and when; `away`: distances of goal from ball, m."""
    return section(
        'Goal and ball',
        f'a ball of radius {goals.BALL_RADIUS:g} m and {goals.BALL_MASS:g} kg is placed {span(goals.BALL_AWAY)} from the walker, '
        f'the goal {span(away or goals.GOAL_AWAY)} from the ball, in any direction; the ball is placed again '
        f'after {span(goals.BALL_LASTS, "s")}, the goal is redrawn after {span(goals.GOAL_LASTS, "s")}',
    )


def _layout(spec: EnvSpec) -> Layout:
    """Returns the layout of the ground of an environment's terrain."""
    return SpatialGround(terrain.load(spec.part('terrain')), 0).layout


@dataclasses.dataclass(frozen=True)
class Description:
    """Functions that describe a task.

    Attributes:
      rules: spec, task -> sections on motion, reward and termination.
      before: task -> sections before the section on the observation.
      action: environment -> section on the meaning of actions.
      time: spec, task -> section on rates and limits.
      joints: task -> title of the last column in the table of links, and its entry for each joint.
      legend: meaning of the markers in rendered images.
    """

    rules: Callable[[EnvSpec, Any], Iterator[Section]] = lambda spec, task: iter(())
    before: Callable[[Any], Iterator[Section]] = lambda task: iter(())
    action: Callable[[Environment], Section] = action
    time: Callable[[EnvSpec, Any], Section] = time
    joints: Callable[[Any], tuple[str, Iterable[object]]] = reward_weights
    legend: str = ''


_PLANNED = Description(
    rules=_planning,
    action=_plan_action,
    time=_plan_time,
    joints=lambda task: ('', [''] * len(task.character.spec.joints)),
    legend=LEGEND + _BEADS,
)
DESCRIPTIONS = {  # by name of the task type
    'planar_imitation': Description(rules=_imitation),
    'spatial_imitation': Description(rules=_imitation),
    'planar_footsteps': Description(rules=_planar_footsteps, legend=LEGEND),
    'spatial_footsteps': Description(rules=_spatial_footsteps, legend=LEGEND),
    'goal_navigation': _PLANNED,
    'soccer': _PLANNED,
    'direct_navigation': Description(rules=_direct, legend=_BEADS),
    'direct_soccer': Description(rules=_direct, legend=_BEADS),
    'gait': Description(
        rules=gait.rules, before=gait.before, action=gait.action, time=gait.time, joints=gait.joints
    ),
}


def description_of(spec: EnvSpec) -> Description:
    """Returns the description of an environment's task."""
    type_ = task_type(spec)
    return DESCRIPTIONS.get('' if type_ is None else type_.name, Description())
