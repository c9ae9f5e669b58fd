"""How gait tasks are described in text and tables."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from trl_suite.bodies.reference import CONTROL_TIMESTEP
from trl_suite.describe.common import actions, reward
from trl_suite.environments.environment import Environment
from trl_suite.registry.spec import EnvSpec
from trl_suite.tasks.gait import rules as gait_rules
from trl_suite.tasks.gait import task as gait
from trl_suite.tasks.rewards import fall_condition
from trl_suite.util.tables import Section, Table, section

# Units of gait parameters that are not angles, by name without state.
_UNITS = {
    'TransTime': 's', 'Cv': 'rad s/m', 'Cd': 'rad/m', 'MagicGain': '1',
    **dict.fromkeys(
        ('BackForceX', 'BackForceY', 'FrontForceX', 'FrontForceY', 'ForceX', 'ForceY'), 'N'
    ),
}  # fmt: skip
# Effects of parameters, by name without state; the others are targets of the joints that they name.
_EFFECTS = {
    'TransTime': 'duration of the states that end after TransTime',
    'BackForceX': 'forward virtual force of the hind foot on the body, in BackStance and Extend',
    'BackForceY': 'upward virtual force of the hind foot on the body, in BackStance and Extend',
    'FrontForceX': 'forward virtual force of the fore foot on the body, in FrontStance and Gather',
    'FrontForceY': 'upward virtual force of the fore foot on the body, in FrontStance and Gather',
    'SpineCurve': 'target of every joint of the spine',
    'Cd': 'gain from the distance of the centre of mass ahead of the stance foot to SwingHip, in Passing and Up',
    'RootPitch': 'target of the root pitch, controlled by the hip of a stance foot on the ground',
    'MagicGain': 'factor of the hip torque that keeps the root upright on the ground',
}
_FROM_SPEED = {  # Cv: gain from the forward speed of the centre of mass
    True: 'gain from the forward speed to SwingHip, in Contact and Down',
    False: 'gain from the forward speed to Hip and Shoulder of a leg in the air',
}


def before(task: Any) -> Iterator[Section]:
    """Yields the sections on states and parameters of the gait."""
    figures = task.gait.parameters
    yield section(
        f'Gait: {len(figures.states)} states; stable PD control of joint targets',
        Table(('state', 'ends'), list(zip(figures.states, task.gait.endings, strict=True))),
    )
    chosen = [
        f'parameter set {name}'
        for name, values in figures.sets.items()
        if np.array_equal(values, figures.action_offset)
    ]
    same = (figures.base_actions == figures.action_offset).all(1)
    chosen += [f'base action {i}' for i in np.flatnonzero(same)]
    blends = [
        (i, f'{a} {1 - share:g}, {b} {share:g}' if 0 < share < 1 else b if share else a)
        for i, (a, b, share) in enumerate(figures.blends)
    ]
    fixed = [
        f'{name} {value:g} {_unit(task, name)}' if value else f'{name} 0'
        for i, (name, value) in enumerate(zip(figures.names, figures.action_offset, strict=True))
        if i not in figures.actions
    ]
    yield section(
        f'Parameters: {len(figures.names)}, of which an action sets {len(figures.actions)}',
        Table(('base action', 'parameter set'), blends),
        f'action 0 is {", i.e. ".join(chosen)}',
        f'only the absolute values of these parameters are used: {", ".join(figures.names[i] for i in figures.absolute)}',
        *([f'fixed: {", ".join(fixed)}'] if fixed else []),
    )


def action(environment: Environment) -> Section:
    """Returns the table of what each action sets."""
    task: Any = environment.task
    action_map, count = task.action_map, len(task.action_map)
    if task.interface == 'base_action':
        return section(
            f'Action: {count} numbers in [-1, 1]; the largest one selects the base action',
            'the selected base action begins with the next cycle',
        )
    units = [_unit(task, name) for name in action_map.names]
    effects = [_effect(task, name) for name in action_map.names]
    return actions(action_map, ('sets', 'unit', 'meaning'), units, effects)


def _unit(task: Any, parameter: str) -> str:
    own = parameter.split('.')[-1]
    slides = own == 'Knee' and task.character.prismatic.any()
    return 'm' if slides else _UNITS.get(own, 'rad')


def _effect(task: Any, parameter: str) -> str:
    own = parameter.split('.')[-1]
    if own == 'Cv':
        return _FROM_SPEED['Cd' in task.gait.parameters.names]
    return _EFFECTS.get(own, 'joint target')


def rules(spec: EnvSpec, task: Any) -> Iterator[Section]:
    """Yields the sections on reward and termination."""
    figure, parameters = task.character.spec, task.gait.parameters
    notes = [f'target speed: {parameters.target_speed:g} m/s']
    if parameters.reward['stumble']:
        notes.append(f'links that may touch the ground: {", ".join(figure.stumble_exempt)}')
    if not parameters.backward_reward:
        notes.append('0 if the speed is negative')
    yield reward(task, *notes, title='Reward of a cycle')
    links = ', '.join(figure.fall_links)
    ends = [
        f'{"one of " if len(figure.fall_links) > 1 else ""}{links} {fall_condition()}',
        f'the pitch of the root is more than {np.degrees(gait_rules.TURNED):.0f} degrees',
        f'the root has moved less than {gait_rules.PROGRESS:g} m in {gait_rules.PATIENCE:g} s',
        'the physics diverges',
    ]
    if parameters.forward_only:
        ends.insert(2, 'the root moves backwards')
    yield section(
        f'Termination (discount 0), sampled every {gait_rules.SAMPLE:g} s',
        '\n'.join(f'- {end}' for end in ends),
    )


def time(spec: EnvSpec, task: Any) -> Section:
    """Returns rates, and the duration of a step and an episode."""
    control, physics = 1 / gait.GAIT_TIMESTEP, 1 / task.physics_timestep
    step = f'one cycle, at most {gait_rules.LONGEST_CYCLE * CONTROL_TIMESTEP:.3g} s'
    if task.interface == 'base_action':
        step = f'{CONTROL_TIMESTEP:.3g} s'
    return section(
        'Time',
        f'a step is {step}; control {control:.4g} Hz, physics {physics:.4g} Hz; an episode is truncated\n'
        f'(discount 1) after {spec.step_limit} steps',
    )


def joints(task: Any) -> tuple[str, list[object]]:
    """Returns what the target angle of each joint is relative to."""
    hips = task.gait.hips
    joints = task.character.spec.joints
    return 'target relative to', [
        'the world' if joint in hips else 'its parent' for joint in joints
    ]
