"""An environment in words and tables, made from its row and from what it was built into."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from trl_suite import catalogue

if TYPE_CHECKING:
    from trl_suite.environment import Environment

# Unit and meaning of the observation blocks.
_BLOCKS = {
    'terrain': ('m', 'ground heights from 0.5 m behind to 3 m ahead, above the ground at the root'),
    'pose': ('m', 'root height above ground; then x, z of each link centre from the root'),
    'velocity': ('m/s', 'x, z velocity of each link centre'),
    'strain': ('1', 'strain of each muscle fibre'),
    'phase': ('1', 'phase of the clip in [0, 1); then the one-hot of its quarter'),
    'target': (
        'm, m/s',
        "the clip's root height; its link centres from its root; their velocities",
    ),
}

# What differs from the original, as (applies to a row?, sentence); docs/differences.md has reasons.
_DIFFERENCES: tuple[tuple[Callable[[catalogue.Row], bool], str], ...] = (
    (
        lambda row: 'completion' in row.tags,
        'not in the registry of the original: a combination that its papers name or imply',
    ),
    (lambda row: True, 'MuJoCo at 300 Hz (some rows 600 Hz) instead of Bullet at 3000 Hz; task option substeps'),
    (lambda row: True, 'actions are in [-1, 1] and clipped; the original takes physical units'),
    (
        lambda row: row.actuation == 'position',
        'damping is split between servo and joint, joints have an armature of 0.01 kg m^2',
    ),
    (
        lambda row: row.actuation == 'position' and row.character in ('dog', 'goat', 'raptor'),
        'targets of hips and shoulder are angles to the parent link, not to the world',
    ),
    (
        lambda row: row.actuation == 'torque',
        'joints have passive damping and an armature of 0.01 kg m^2; action 1 is 0.75 of the limit',
    ),
    (
        lambda row: row.actuation == 'velocity',
        'joints have an armature of 0.01 kg m^2; the damping gain is the servo',
    ),
    (
        lambda row: row.actuation == 'muscle',
        "MuJoCo's muscle curves fitted to the original's, rigid tendons, constant moment arms",
    ),
    (
        lambda row: row.actuation == 'muscle' and row.character in ('goat', 'biped2d_full'),
        'the original has no muscles for this character; they are borrowed',
    ),
    (lambda row: row.clip is not None, "the clip is our own, close to the original's in gait and speed"),
    (lambda row: row.clip is not None, 'the start phase is drawn uniformly instead of swept'),
    (
        lambda row: row.terrain == 'mixed_humanoid',
        'the terrain is inferred: slopes_mixed_humanoid without slopes',
    ),
    (
        lambda row: isinstance(row.terrain, str) and row.terrain != 'flat',
        'faces of the terrain are exactly vertical, and every start has flat ground from -1 to 1 m',
    ),
    (lambda row: True, f'episodes are cut after {catalogue.STEP_LIMIT} steps (discount 1)'),
)  # fmt: skip


def sections(row: catalogue.Row, environment: Environment) -> Iterator[tuple[str, str]]:
    """Yields titles and texts: character, observation, action, rules, time, differences."""
    from trl_suite.tasks.imitation import Imitation

    task: Any = environment.task
    if isinstance(task, Imitation):
        yield from _character(environment)
    action_map = environment.action_map
    size = max(part.stop for part in environment.blocks.values())
    yield (
        f'Observation: {size} numbers, in this order',
        table(
            ('block', 'from', 'to', 'size', 'unit', 'meaning'),
            (
                (name, part.start, part.stop, part.stop - part.start, *_BLOCKS.get(name, ('', '')))
                for name, part in environment.blocks.items()
            ),
        ),
    )
    limits = _limits(environment)
    unit = '' if action_map.unit == '1' else f' in {action_map.unit}'
    yield (
        f'Action: {len(action_map)} numbers in [-1, 1]; {action_map.quantity}{unit} = centre + '
        'half range * action',
        table(
            ('drives', 'centre', 'half range', limits[0]),
            zip(action_map.names, *(_floats(v) for v in (
                action_map.centre, action_map.half_range, limits[1]
            )), strict=True),
        ),
    )  # fmt: skip
    if isinstance(task, Imitation):
        yield from _rules(environment)
    control, physics = 1 / task.control_timestep, 1 / task.physics_timestep
    yield (
        'Time',
        f'  control {control:.4g} Hz, physics {physics:.4g} Hz; an episode is cut (discount 1) after '
        f'{row.step_limit} steps, {row.step_limit * task.control_timestep:.3g} s',
    )
    yield (
        'Differs from the original (reasons in docs/differences.md)',
        '\n'.join(f'  - {text}' for applies, text in _DIFFERENCES if applies(row)),
    )


def _floats(values: Any) -> list[float]:
    return [float(value) for value in values]


def _character(environment: Environment) -> Iterator[tuple[str, str]]:
    from trl_suite import characters

    task: Any = environment.task
    character = task.character
    row = character.row
    figures = characters.body_figures(characters.make(row))
    yield (
        f'Character: {row.name}',
        f'  {row.description}\n  {figures["mass"]:.4g} kg, stands {figures["standing_height"]:.3g} m '
        f'high at the root, {len(row.links)} links, {len(row.joints)} joints',
    )
    masses = _floats(environment.physics.bind(character.bodies).mass)
    cells: list[tuple[object, ...]] = [('root', masses[0], '', '', '', '', '')]
    for (name, joint), mass, (low, high), limit in zip(
        row.joints.items(), masses[1:], character.joint_ranges, character.torque_limits, strict=True
    ):
        reach = 'free' if np.isinf(low) else f'{low:.3g} to {high:.3g}'
        cells.append(
            (name, mass, reach, f'{limit:g}', f'{joint.kp:g}', f'{joint.kd:g}', joint.weight)
        )
    header = ('link and joint', 'kg', 'range (rad)', 'limit (N m)', 'kp', 'kd', 'reward weight')
    yield 'Links', table(header, cells)


def _limits(environment: Environment) -> tuple[str, Any]:
    """Returns what limits each action's effect, and how much."""
    task: Any = environment.task
    actuators = environment.physics.bind(task.root_entity.mjcf_model.find_all('actuator'))
    if environment.action_map.quantity == 'excitation':
        return 'peak force (N)', np.asarray(actuators.gainprm)[:, 2]
    limits = dict(zip(task.character.row.joints, task.character.torque_limits, strict=True))
    return 'torque limit (N m)', [limits[name] for name in environment.action_map.names]


def _rules(environment: Environment) -> Iterator[tuple[str, str]]:
    from trl_suite.tasks import rewards

    task: Any = environment.task
    ground, clip, row = task.arena.terrain, task.clip, task.character.row
    parameters = ', '.join(f'{name} {value:g}' for name, value in ground.parameters().items())
    sets = len(ground.parameter_sets)
    more = f' (set 0 of {sets}; see the option blend)' if sets > 1 else ''
    yield (
        f'Terrain: {ground.name} ({ground.type})',
        _fold(f'{parameters or "no parameters"}{more}'),
    )
    yield (
        f'Clip: {clip.name}',
        f'  {clip.description}; period {clip.duration:.4g} s, {clip.speed:.3g} m/s',
    )
    yield (
        'Reward: sum of weight * exp(-scale * squared error), at most 1; 0 after a fall',
        table(
            ('term', 'weight', 'scale'),
            ((name, *values) for name, values in rewards.IMITATION_TERMS.items()),
        ),
    )
    yield (
        'Termination (discount 0)',
        _fold(
            f'a fall: one of {", ".join(row.fall_links)} touches the ground at the end of a step; '
            'or the physics diverges'
        ),
    )


def table(header: Sequence[str], cells: Iterable[Sequence[object]], indent: str = '  ') -> str:
    """Aligns cells in columns, numbers to the right."""
    rows = [[f'{c:.4g}' if isinstance(c, float) else str(c) for c in row] for row in cells]
    columns = list(zip(header, *rows, strict=True))
    widths = [max(map(len, column)) for column in columns]
    number = re.compile(r'([-+]?\d[-+.\de]*)?')
    right = [all(number.fullmatch(cell) for cell in column[1:]) for column in columns]
    return '\n'.join(
        indent
        + '  '.join(
            cell.rjust(width) if to_right else cell.ljust(width)
            for cell, width, to_right in zip(row, widths, right, strict=True)
        ).rstrip()
        for row in (list(header), *rows)
    )


def _fold(text: str) -> str:
    return textwrap.fill(text, 100, initial_indent='  ', subsequent_indent='  ')
