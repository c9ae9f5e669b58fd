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

# Unit and meaning of the observation blocks: imitation in the plane, gaits, three dimensions.
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
_GAIT_BLOCKS = {
    'terrain': (
        'm',
        'ground heights from 0.5 m behind to 10 m ahead, above the ground at the root',
    ),
    'pose': ('m', 'root height above ground; then x, z of each other link centre from the root'),
    'velocity': ('m/s', 'x, z velocity of each link centre'),
}
_SPATIAL_BLOCKS = {
    'terrain': (
        'm',
        'ground heights above the ground at the root, 32 lines from the left to the right (5.5 m to each '
        'side), each of 32 from 1 m behind to 10 m ahead',
    ),
    'pose': (
        'm, 1',
        'root height above ground; then of each link its centre from the root and its orientation (wxyz)',
    ),
    'velocity': (
        'm/s, rad/s',
        'of each link the velocity of its centre, against the ground under the root, and its angular '
        'velocity',
    ),
    'phase': ('1', 'phase of the cycle in [0, 1); then the one-hot of its quarter'),
    'target': (
        'm, m/s',
        "the clip's root height; its link centres from its root; their velocities",
    ),
    'goal': (
        'rad, m',
        'bearing (positive to the left) and distance of the point on the line of the start that is 3 m '
        'further on',
    ),
    'contact': ('1', 'whether the right and the left foot touch the ground'),
    'plan': ('m, rad', 'see below'),
}
_HIGH_BLOCKS = {
    **_SPATIAL_BLOCKS,
    'surface': (
        'm/s',
        'velocities of the ground against that under the root, at 32 lines from the left to the right (5.5 m '
        'to each side), each of 32 from 1 m behind to 10 m ahead: all ahead, then all to the right',
    ),
    'target': ('rad, m', 'bearing (positive to the left) and distance of the goal'),
    'ball': (
        'rad, m, m/s, rad/s',
        'bearing, distance and height of the ball; its velocity (3) and its angular velocity (3)',
    ),
    'low_level': ('', 'what the footstep controller observes'),
}
_TARGET_OF_BALL = ('rad, m', 'bearing and distance of the goal as seen from the ball')
_PLAN_MEANINGS = {
    'first_x': 'm; where the foot that swings lands, ahead of the root',
    'first_y': 'm; the same, to the left of the root',
    'second_x': 'm; where the other foot lands after it, ahead of the root',
    'second_y': 'm; the same, to the left of the root',
    'turn': 'rad; heading to have, to the left of the present one',
}
_MIRRORED_BLOCKS = {
    'phase': ('1', 'phase of the step in [0, 1); then the one-hot of its half'),
    'contact': ('1', 'whether the stance and the swing foot touch the ground'),
}
# Size, unit and meaning of the parts of a plan.
_PLAN = (
    (3, 'm', 'first landing place from the right foot; 0 while that one stands'),
    (3, 'm', 'first landing place from the left foot; 0 while that one stands'),
    (3, 'm', 'second landing place from the right foot; 0 unless that one stands'),
    (3, 'm', 'second landing place from the left foot; 0 unless that one stands'),
    (1, 'rad', 'planned heading, to the left of the present one'),
)
_MIRRORED_PLAN = (
    (1, 'rad', 'planned heading, to the swing side of the present one'),
    (3, 'm', 'first landing place from the swing foot'),
    (3, 'm', 'second landing place from the stance foot'),
)
_STANCE_FIRST = '; the stance leg first, then the swing leg'
_HOPPER_ENDS = {'pose': '; last, pitch of the root (rad)', 'velocity': '; last, its rate (rad/s)'}
# Units of gait parameters that are no angles, by name without state.
_GAIT_UNITS = {
    'TransTime': 's', 'Cv': 'rad s/m', 'Cd': 'rad/m', 'MagicGain': '1',
    **dict.fromkeys(
        ('BackForceX', 'BackForceY', 'FrontForceX', 'FrontForceY', 'ForceX', 'ForceY'), 'N'
    ),
}  # fmt: skip

# What differs from the original, as (applies to a row?, sentence); docs/differences.md has reasons.
_CLIP, _GAIT, _SPATIAL, _CLIP3D, _STEPS, _HIGH, _HARD = (
    lambda row: row.rules == 'imitation', lambda row: row.rules == 'gait',
    lambda row: row.rules in ('imitation3d', 'footsteps', 'journey', 'ball_journey'),
    lambda row: row.rules == 'imitation3d',
    lambda row: row.rules == 'footsteps', lambda row: row.rules in ('hike', 'soccer'),
    lambda row: row.rules in ('journey', 'ball_journey'),
)  # fmt: skip
_SPACE = lambda row: _SPATIAL(row) or _HIGH(row)  # noqa: E731
_DIFFERENCES: tuple[tuple[Callable[[catalogue.Row], bool], str], ...] = (
    (
        lambda row: 'completion' in row.tags,
        'not in the registry of the original: a combination that its papers name or imply',
    ),
    (_CLIP, 'MuJoCo at 300 Hz (some rows 600 Hz) instead of Bullet at 3000 Hz; task option substeps'),
    (_GAIT, 'MuJoCo at 1200 Hz, control at 600 Hz; the original controls most of these at 30 Hz, at which they fall here'),
    (_CLIP3D, 'MuJoCo at 300 Hz instead of Bullet at 3000 Hz; task option substeps'),
    (
        lambda row: _STEPS(row) or _HIGH(row) or _HARD(row),
        'MuJoCo at 300 Hz instead of Bullet at 1200 Hz; task option substeps',
    ),
    (
        _HIGH,
        'a step is a whole footstep, from one switch of stance to the next; that of the original is 1/30 s '
        'and leaves the cadence to the caller; task option interface',
    ),
    (
        _HIGH,
        'the footstep controller is inside, and trained by us; the original leaves it to the caller; task '
        'option controller',
    ),
    (
        _HIGH,
        'actions are in [-1, 1], clipped, and scaled as by the native learner of the original; its Python '
        'interface takes m and rad',
    ),
    (
        _HIGH,
        'the reward is over the whole step; that of the original is since the last plan, down to a few ms',
    ),
    (
        lambda row: row.terrain == 'pillars3d' and _HIGH(row),
        'sees the heights of its pillars; the original gives it a map of velocities that are all zero',
    ),
    (
        lambda row: row.rules == 'hike',
        'whether a goal is reached or its time over is looked at once a step',
    ),
    (lambda row: row.rules == 'soccer', 'the times of ball and goal are looked at once a step'),
    (
        lambda row: row.rules == 'journey',
        'the reward leads to the goal, and a goal that is reached is drawn anew; that of the original is for '
        'footsteps that nobody sees, and its goal stays; task option reward',
    ),
    (
        lambda row: row.rules == 'ball_journey',
        'there is a ball, and half of the reward is for it; the configuration of the original has none',
    ),
    (_SPACE, 'axes are x forward, y left, z up; the original has y up and z to the right'),
    (
        lambda row: row.rules == 'imitation' or _SPATIAL(row),
        'actions are in [-1, 1] and clipped; the original takes physical units',
    ),
    (
        _SPATIAL,
        "targets of ball joints are rotation vectors about the mean pose; option centre='original' for the "
        "original's angle and axis",
    ),
    (
        _SPACE,
        'a ball joint is limited by one cone, as wide as the widest of its three ranges',
    ),
    (
        _CLIP3D,
        'the goal is straight on, 3 m ahead on the line of the start; the original observes where the start '
        'was',
    ),
    (
        _SPATIAL,
        'rotation errors are those of the shorter way, angular velocities of both sides in one frame',
    ),
    (
        lambda row: row.rules == 'footsteps' and row.options.get('mirrored', False),
        'truly mirrored; the original runs the same environment as for the general plan',
    ),
    (
        lambda row: row.rules == 'footsteps' and row.character == 'biped3d_mocap_run',
        'the footstep is rewarded in the second half of every step; in the original that clock is slower than '
        'the steps',
    ),
    (_STEPS, 'a step that misses its place ends the episode only if asked for; option miss'),
    (
        lambda row: row.rules == 'footsteps' and row.options.get('goal', False),
        'a goal is drawn anew when the walker is within 1 m; the original draws one, at the start',
    ),
    (
        _GAIT,
        'actions are in [-1, 1], clipped, and mapped to the parameters that are learnt; the original takes '
        'them for the first of all parameters, so that most mean another',
    ),
    (_GAIT, 'a step ends with its cycle or a fall, not up to 1/30 s later; the first action of an episode counts'),
    (_GAIT, 'the reward is of the cycle that the action made, and never NaN'),
    (
        lambda row: row.rules == 'gait' and row.character == 'hopper',
        '9 parameters, taken at touch-down; the original announces 8 and takes them in mid-air',
    ),
    (
        lambda row: row.rules == 'gait' and row.character == 'raptor',
        "action 0 is the original's base action 1, which is steadier than its base action 0",
    ),
    (
        lambda row: row.rules == 'gait' and row.character == 'biped2d_simbicon',
        "action 0 is a gait tuned anew: the original's falls here; torque is not rewarded",
    ),
    (
        lambda row: row.rules == 'gait' and row.character == 'goat',
        "action 0 is a gait tuned anew: the original's fall here on flat ground; the original has the "
        'gait and no environment for it',
    ),
    (
        lambda row: row.actuation == 'position' and row.character != 'biped3d_mocap_run',
        'damping is split between servo and joint, joints have an armature of 0.01 kg m^2',
    ),
    (
        lambda row: row.actuation == 'position' and row.character == 'biped3d_mocap_run',
        'damping is split between servo and joint, joints have an armature of 0.01, ankles of 0.03 kg m^2',
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
    (_CLIP, "the clip is our own, close to the original's in gait and speed"),
    (
        lambda row: row.rules == 'imitation3d' and row.clip == 'biped3d_walk',
        "the clip is our own, 1.2 m/s; the original's walks at 1.535 m/s",
    ),
    (
        lambda row: (row.rules == 'imitation3d' and row.clip != 'biped3d_walk') or _HARD(row),
        "the clip is our own, close to the original's in gait and speed",
    ),
    (
        lambda row: row.rules == 'footsteps' and row.character != 'biped3d_mocap_run',
        'the steps are our own, 27 of them; the original chooses among 14 captured ones',
    ),
    (
        lambda row: row.rules == 'footsteps' and row.character == 'biped3d_mocap_run',
        "the step is our own, 3.83 m/s; the original's is captured, 4.4 m/s",
    ),
    (
        lambda row: row.clip is not None and not _HIGH(row),
        'the start phase is drawn uniformly instead of swept',
    ),
    (
        lambda row: row.terrain == 'stairs3d',
        'treads have vertical faces and run on to both sides; those of the original slope over 0.2 m and change '
        '1 m beside the start',
    ),
    (
        lambda row: row.terrain == 'mixed_humanoid',
        'the terrain is inferred: slopes_mixed_humanoid without slopes',
    ),
    (
        lambda row: row.rules in ('imitation', 'gait') and row.terrain != 'flat',
        'faces of the terrain are exactly vertical, and every start has flat ground from -1 to 1 m',
    ),
    (
        lambda row: not _HIGH(row),
        f'episodes are cut after {catalogue.STEP_LIMIT} steps (discount 1)',
    ),
    (
        _HIGH,
        f'episodes are cut after {catalogue.HIKE_LIMIT} steps, 200 s (discount 1); the registry of the original '
        'cuts them after 256 steps of 1/30 s',
    ),
)  # fmt: skip


def sections(row: catalogue.Row, environment: Environment) -> Iterator[tuple[str, str]]:
    """Yields titles and texts: character, observation, action, rules, time, differences."""
    from trl_suite.tasks.gait import GaitTask
    from trl_suite.tasks.high_level import HighLevel
    from trl_suite.tasks.imitation import Imitation
    from trl_suite.tasks.journey import HiddenSteps, Journey
    from trl_suite.tasks.tracking3d import Tracking

    task: Any = environment.task
    gait, spatial = isinstance(task, GaitTask), isinstance(task, Tracking)
    high, hard = isinstance(task, HighLevel), isinstance(task, Journey | HiddenSteps)
    known = gait or spatial or isinstance(task, Imitation)
    if known:
        yield from _character(environment)
    if gait:
        yield from _gait(task)
    meanings = _gait_blocks(task) if gait else _spatial_blocks(task) if spatial else _BLOCKS
    if high or hard:
        meanings = dict(_HIGH_BLOCKS)
        if 'ball' in task.blocks:
            meanings['target'] = _TARGET_OF_BALL
        if hard:
            meanings['goal'] = meanings['target']
    size = max(part.stop for part in environment.blocks.values())
    axes = "; axes: x along the root's heading, y to the left, z up" if spatial else ''
    yield (
        f'Observation: {size} numbers, in this order{axes}',
        table(
            ('block', 'from', 'to', 'size', 'unit', 'meaning'),
            (
                (name, part.start, part.stop, part.stop - part.start, *meanings.get(name, ('', '')))
                for name, part in environment.blocks.items()
            ),
        ),
    )
    if spatial:
        yield from _spatial_parts(task)
    if high:
        yield _high_action(task)
    else:
        yield _gait_action(task) if gait else _action(environment)
    if known:
        yield _terrain(task)
    if gait:
        yield from _gait_rules(task)
    elif high:
        yield from _high_rules(task)
    elif spatial:
        yield from _spatial_rules(task)
    elif known:
        yield from _rules(environment)
    yield 'Time', (_gait_time if gait else _high_time if high else _time)(row, task)
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
    # The last column: a weight in a reward that has none of a gait, or what a gait tracks.
    gait, above = getattr(task, 'gait', None), hasattr(task, 'controller')
    masses = _floats(environment.physics.bind(character.bodies).mass)
    cells: list[tuple[object, ...]] = [('root', masses[0], '', '', '', '', '')]
    for (name, joint), mass, (low, high), limit, slides, ball in zip(
        row.joints.items(), masses[1:], character.joint_ranges, character.torque_limits,
        character.prismatic, character.spherical, strict=True,
    ):  # fmt: skip
        reach = 'free' if np.isinf(low) else f'{low:.3g} to {high:.3g}'
        if ball:
            reach = f'ball, up to {high:.3g}'
        last: object = '' if above else joint.weight
        if gait is not None:
            last = 'the world' if name in gait.world_joints else 'its parent'
        units = ('m', 'N', 'N/m', 'N s/m') if slides else ('', '', '', '')
        figure = (reach, f'{limit:g}', f'{joint.kp:g}', f'{joint.kd:g}')
        cells.append((
            name, mass, *(f'{text} {unit}'.rstrip() for text, unit in zip(figure, units, strict=True)),
            last,
        ))  # fmt: skip
    header = (
        'link and joint', 'kg', 'range (rad)', 'limit (N m)', 'kp (N m/rad)', 'kd (N m s/rad)',
        'target to' if gait else '' if above else 'reward weight',
    )  # fmt: skip
    yield 'Links', table(header, cells)


def _action(environment: Environment) -> tuple[str, str]:
    action_map = environment.action_map
    limits = _limits(environment)
    unit = '' if action_map.unit == '1' else f' in {action_map.unit}'
    return (
        f'Action: {len(action_map)} numbers in [-1, 1]; {action_map.quantity}{unit} = centre + '
        'half range * action',
        table(
            ('drives', 'centre', 'half range', limits[0]),
            zip(action_map.names, *(_floats(v) for v in (
                np.round(action_map.centre, 9) + 0.0, action_map.half_range, limits[1]
            )), strict=True),
        ),
    )  # fmt: skip


def _limits(environment: Environment) -> tuple[str, Any]:
    """Returns what limits each action's effect, and how much."""
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
    # Every ball joint takes as many numbers.
    each = (len(names) - np.count_nonzero(~ball)) // np.count_nonzero(ball)
    norm = '' if task.actuation_model == 'velocity' else ', norm'
    return f'torque limit (N m{norm})', np.repeat(limits, np.where(ball, each, 1))


def _terrain(task: Any) -> tuple[str, str]:
    ground = task.arena.terrain
    parameters = ', '.join(f'{name} {value:g}' for name, value in ground.parameters().items())
    sets = len(ground.parameter_sets)
    more = f' (set 0 of {sets}; see the option blend)' if sets > 1 else ''
    return f'Terrain: {ground.name} ({ground.type})', _fold(
        f'{parameters or "no parameters"}{more}'
    )


def _time(row: catalogue.Row, task: Any) -> str:
    control, physics = 1 / task.control_timestep, 1 / task.physics_timestep
    return (
        f'  control {control:.4g} Hz, physics {physics:.4g} Hz; an episode is cut (discount 1) after '
        f'{row.step_limit} steps, {row.step_limit * task.control_timestep:.3g} s'
    )


# Imitation of a clip


def _rules(environment: Environment) -> Iterator[tuple[str, str]]:
    from trl_suite.tasks import rewards

    task: Any = environment.task
    clip, row = task.clip, task.character.row
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


# Three dimensions


def _spatial_blocks(task: Any) -> dict[str, tuple[str, str]]:
    return {**_SPATIAL_BLOCKS, **(_MIRRORED_BLOCKS if task.mirrored else {})}


def _spatial_parts(task: Any) -> Iterator[tuple[str, str]]:
    """Yields where links and parts of a plan are in the observation."""
    links = list(task.character.row.links)
    pose, velocity = task.blocks['pose'].start + 1, task.blocks['velocity'].start
    if task.mirrored:
        # In right stance; in left stance links change places.
        yield (
            'Mirrored: while the left foot stands, all is seen in a mirror, and actions are mirrored back',
            _fold('then what is called right below is the left side'),
        )
    yield (
        'Links in the observation (centre 3 and orientation 4; velocity 3 and angular velocity 3)',
        table(
            ('link', 'pose from', 'to', 'velocity from', 'to'),
            (
                (name, *(pose + 7 * i + k for k in (0, 7)), *(velocity + 6 * i + k for k in (0, 6)))
                for i, name in enumerate(links)
            ),
        ),
    )
    if 'plan' in task.blocks:
        parts = _MIRRORED_PLAN if task.mirrored else _PLAN
        starts = task.blocks['plan'].start + np.cumsum([0, *(size for size, _, _ in parts)])
        yield (
            'Plan in the observation (x, y, and z above the ground at the root)',
            table(
                ('from', 'to', 'size', 'unit', 'meaning'),
                (
                    (int(start), int(start) + size, size, unit, text)
                    for start, (size, unit, text) in zip(starts[:-1], parts, strict=True)
                ),
            ),
        )


def _spatial_rules(task: Any) -> Iterator[tuple[str, str]]:
    from trl_suite.tasks import ball, journey

    row, motion = task.character.row, task.motion
    steps = hasattr(task, 'plans')
    if steps:
        noun = 'step' if len(motion) == 1 else 'steps'
        yield (
            f'Steps: {motion.name}',
            _fold(
                f'{motion.description}: {len(motion)} {noun} and the mirrored; the nearest to the plan is '
                f'the reference of a step. Period of two steps {task.period:.4g} s; the right foot '
                'stands while the phase is below 0.5'
            ),
        )
        yield _plans(task)
    else:
        yield (
            f'Clip: {motion.name}',
            f'  {motion.description}; period {motion.duration:.4g} s, {motion.speed:.3g} m/s',
        )
    if isinstance(task, journey.Journey):
        yield _goal_and_ball() if 'ball' in task.blocks else _goal(task)
    of_ball = _ball_terms(ball.SPEED, task._goal_reached) if 'ball' in task.blocks else ([], '')
    lines = [
        table(
            ('term', 'weight', 'scale'),
            (
                (name, weight, scale if name != 'heading' else '')
                for name, (weight, scale) in task.TERMS.items()
                if name not in ball.SOCCER_TERMS or not of_ball[0]
            ),
        )
    ]
    if 'heading' in task.TERMS:
        aim = 'of the planned heading' if steps else 'of the heading from the way to go'
        lines.append(_fold(f'heading: weight * ((1 + cos error) / 2)^4, error {aim}'))
    if 'proximity' in task.TERMS:
        where = 'ball' if of_ball[0] else 'goal'
        lines.append(
            _fold(
                f'the way to go is that to the {where}: the clip is turned that way; within '
                f'{journey.NEAR:g} m neither velocity nor heading counts; proximity is of the distance over '
                f'{journey.NEAR:g} m'
            )
        )
    if of_ball[0]:
        weights = [weight for name, (weight, _) in task.TERMS.items() if name in ball.SOCCER_TERMS]
        lines += [
            table(
                ('term', 'weight', 'times'),
                zip(ball.SOCCER_TERMS, weights, of_ball[0], strict=True),
            ),
            _fold(of_ball[1]),
        ]
    if steps:
        lines += [
            _fold(
                'end_effector: in the second half of a step, that of the swing foot is the way to its '
                'landing place'
            ),
        ]
    yield (
        'Reward: sum of weight * exp(-scale * squared error), at most 1; 0 after a fall',
        '\n'.join(lines),
    )
    miss = ''
    if steps and task.miss is not None:
        miss = f'a foot lands more than {task.miss:g} m from its place; '
    yield (
        'Termination (discount 0)',
        _fold(
            f'a fall: one of {", ".join(row.fall_links)} touches the ground at the end of a step; '
            f'{miss}or the physics diverges'
        ),
    )


def _plans(task: Any) -> tuple[str, str]:
    """What is told of how plans are drawn."""
    plans = task.plans

    def span(values: tuple[float, float]) -> str:
        low, high = values
        return f'{low:g} m' if low == high else f'{low:g} to {high:g} m'

    lines = [f'steps {span(plans.length)} long, feet {span(plans.width)} apart']
    if task.goal_given:
        lines.append('heads for a goal, drawn anew when it is reached')
    else:
        lines.append(f'the heading changes by N(0, {plans.turn:g}) rad from step to step')
        if plans.sharp:
            lines.append(f'with probability {plans.sharp:g} by anything up to pi instead')
    if plans.from_root:
        lines.append(f'with probability {plans.from_root:g} planned anew from the root')
    if task.pushes:
        low, high = task.pushes.force
        lines.append(f'the torso is pushed now and then by {low:g} to {high:g} N')
    return 'Plans: at every switch of stance', _fold('; '.join(lines))


# Above a footstep controller


def _high_action(task: Any) -> tuple[str, str]:
    action_map = task.action_map
    return (
        f'Action: {len(action_map)} numbers in [-1, 1]; {action_map.quantity} = centre + half range * action',
        table(
            ('sets', 'centre', 'half range', 'unit and meaning'),
            (
                (name, centre, half_range, _PLAN_MEANINGS.get(name, 'of the footstep controller'))
                for name, centre, half_range in zip(
                    action_map.names, _floats(action_map.centre), _floats(action_map.half_range),
                    strict=True,
                )
            ),
        ),
    )  # fmt: skip


def _goal(task: Any) -> tuple[str, str]:
    from trl_suite.tasks import high_level

    times = _seconds(high_level.GOAL_LASTS)
    return 'Goal', _fold(f'drawn anew within {task._goal_reached:g} m of it, or after {times}')


def _goal_and_ball() -> tuple[str, str]:
    from trl_suite.tasks import ball, high_level

    low, high = ball.BALL_AWAY
    return 'Goal and ball', _fold(
        f'a ball of {ball.RADIUS:g} m and {ball.MASS:g} kg lies {low:g} to {high:g} m from the walker, the '
        f'goal up to {ball.GOAL_AWAY[1]:g} m from the ball; both are drawn anew, the ball after '
        f'{_seconds(ball.BALL_LASTS)}, the goal after {_seconds(high_level.GOAL_LASTS)}'
    )


def _ball_terms(speed: float, reached: float) -> tuple[list[str], str]:
    """Returns formulas of the terms that are about a ball, and when they are full."""
    from trl_suite.tasks import ball

    speeds = f'exp(-{ball.SPEED_SHARPNESS:g} min(0, v - {speed:g})^2)'
    formulas = [
        f'{speeds}, v: speed of the centre of mass towards the ball, m/s',
        f'exp(-{ball.BALL_SHARPNESS:g} d^2), d: from where it was to the ball, m',
        f'{speeds}, v: speed of the ball towards the goal; 0 unless positive',
        f'exp(-{ball.GOAL_SHARPNESS:g} d), d: from the ball to the goal, m',
    ]
    return formulas, (
        f'all are full while the ball is within {reached:g} m of the goal and within {ball.NEAR:g} m of '
        'the walker'
    )


def _high_rules(task: Any) -> Iterator[tuple[str, str]]:
    from trl_suite.tasks import high_level, soccer

    yield (
        'Footstep controller',
        _fold(
            f'{task.controller.name}; the plan is laid out from the root and its heading when a footstep begins'
        ),
    )
    if isinstance(task, soccer.Soccer):
        yield _goal_and_ball()
        formulas, full = _ball_terms(task._target_speed, task._goal_reached)
    else:
        yield _goal(task)
        formulas = [
            f'exp(-{high_level.SPEED_SHARPNESS:g} min(0, v - {task._target_speed:g})^2), v: speed of the '
            'centre of mass towards the goal, m/s',
            '1',
        ]
        full = f'speed is full where a step begins within {task._goal_reached:g} m of the goal'
    terms = zip(task.TERMS.items(), formulas, strict=True)
    yield (
        'Reward of a step: sum of weight * term, at most 1; 0 after a fall',
        table(
            ('name', 'weight', 'term'),
            ((name, weight, formula) for (name, (weight, _)), formula in terms),
        )
        + f'\n{_fold(full)}',
    )
    looks = _samples_until_fall(high_level)
    every = high_level.SAMPLE_FRAMES / 30
    yield (
        f'Termination (discount 0), looked at every {every:g} s',
        _fold(
            f'one of {", ".join(task.character.row.fall_links)} touches the ground in {looks} looks in a row, '
            'or often enough; or the physics diverges'
        ),
    )


def _seconds(span: tuple[float, float]) -> str:
    return f'{span[0]:g} to {span[1]:g} s'


def _high_time(row: catalogue.Row, task: Any) -> str:
    duration, physics = task.control_timestep, 1 / task.physics_timestep
    return (
        f'  a step is {duration:.3g} s, the first of an episode may be shorter; footstep controller 30 Hz, '
        f'physics\n  {physics:.4g} Hz; an episode is cut (discount 1) after {row.step_limit} steps, '
        f'{row.step_limit * duration:.3g} s'
    )


# Gaits


def _gait(task: Any) -> Iterator[tuple[str, str]]:
    figures = task.gait.parameters
    yield (
        f'Gait: {len(figures.states)} states; joints are driven to targets by stable PD',
        table(('state', 'ends'), zip(figures.states, task.gait.endings, strict=True)),
    )
    chosen = [
        name for name, values in figures.sets.items() if np.array_equal(values, figures.centre)
    ]
    chosen += [f'base action {i}' for i in _same(figures.base_actions, figures.centre)]
    lines = [
        table(
            ('base action', 'parameter set'),
            (
                (i, f'{a} {1 - share:g}, {b} {share:g}' if 0 < share < 1 else b if share else a)
                for i, (a, b, share) in enumerate(figures.blends)
            ),
        ),
        _fold(f'action 0 is {" = ".join(chosen)}'),
        _fold(f'sign does not count: {", ".join(figures.names[i] for i in figures.absolute)}'),
    ]
    values = {
        name: figures.centre[i] for i, name in enumerate(figures.names) if i not in figures.actions
    }
    if values:
        fixed = (
            f'{name} {value:g} {_gait_unit(task, name)}' if value else f'{name} 0'
            for name, value in values.items()
        )
        lines.append(_fold(f'fixed: {", ".join(fixed)}'))
    yield (
        f'Parameters: {len(figures.names)}, of which an action sets {len(figures.actions)}',
        '\n'.join(lines),
    )


def _same(rows: np.ndarray, vector: np.ndarray) -> list[int]:
    return np.flatnonzero((rows == vector).all(1)).tolist()


def _gait_blocks(task: Any) -> dict[str, tuple[str, str]]:
    row = task.character.row
    ends = _HOPPER_ENDS if row.name == 'hopper' else {}
    if row.mirror:
        ends = dict.fromkeys(('pose', 'velocity'), _STANCE_FIRST)
    return {
        name: (unit, f'{text}{ends.get(name, "")}') for name, (unit, text) in _GAIT_BLOCKS.items()
    }


def _gait_action(task: Any) -> tuple[str, str]:
    action_map, count = task.action_map, len(task.action_map)
    if task.interface == 'base_action':
        return (
            f'Action: {count} numbers in [-1, 1]; the largest chooses the base action',
            _fold('it begins with the next cycle'),
        )
    return (
        f'Action: {count} numbers in [-1, 1]; {action_map.quantity} = centre + half range * action',
        table(
            ('sets', 'centre', 'half range', 'unit'),
            zip(
                action_map.names, _floats(action_map.centre), _floats(action_map.half_range),
                (_gait_unit(task, name) for name in action_map.names), strict=True,
            ),
        ),
    )  # fmt: skip


def _gait_unit(task: Any, parameter: str) -> str:
    own = parameter.split('.')[-1]
    slides = own == 'Knee' and task.character.prismatic.any()
    return 'm' if slides else _GAIT_UNITS.get(own, 'rad')


def _gait_rules(task: Any) -> Iterator[tuple[str, str]]:
    from trl_suite.tasks import gait

    row, weights = task.character.row, task.reward_weights
    weight = '' if weights['speed'] == 1 else f'{weights["speed"]:g} '
    lines = [
        f'{weight}exp(-{gait.SPEED_SHARPNESS:g} (v - {task.gait.parameters.target_speed:g})^2)',
        'v: mean forward speed of the centre of mass, m/s',
    ]
    if weights['stumble']:
        lines[0] += f' + {weights["stumble"]:g} / (1 + {gait.STUMBLE_SHARPNESS:g} s)'
        lines.append(
            's: share of the time in which a link other than '
            f'{", ".join(row.stumble_exempt)} touches the ground'
        )
    if row.name in gait.NO_REWARD_BACKWARDS:
        lines.append('0 if v is negative')
    yield (
        'Reward of a cycle, at most 1; 0 after a fall',
        '\n'.join(_fold(line) for line in lines),
    )
    samples = _samples_until_fall(gait)
    links = ', '.join(row.fall_links)
    rules = [
        f'{"one of " if len(row.fall_links) > 1 else ""}{links} touches the ground in {samples} looks '
        'in a row, or often enough',
        f'the root is turned by more than {np.degrees(gait.TURNED):.0f} degrees',
        f'it has moved less than {gait.PROGRESS:g} m in {gait.PATIENCE:g} s',
        'the physics diverges',
    ]
    if row.name in gait.FORWARD_ONLY:
        rules.insert(2, 'it moves backwards')
    yield (
        f'Termination (discount 0), looked at every {gait.SAMPLE:g} s',
        '\n'.join(_fold(f'- {rule}') for rule in rules),
    )


def _samples_until_fall(gait: Any) -> int:
    down, count = 0.0, 0
    while down <= gait.FALLEN:
        down, count = gait.FADING * down + gait.SHARE, count + 1
    return count


def _gait_time(row: catalogue.Row, task: Any) -> str:
    from trl_suite.tasks import gait

    control, physics = 1 / gait.CONTROL_TIMESTEP, 1 / task.physics_timestep
    step = f'one cycle, at most {gait.LONGEST_CYCLE * gait.FRAME:.3g} s'
    if task.interface == 'base_action':
        step = f'{gait.FRAME:.3g} s'
    return (
        f'  a step is {step}; control {control:.4g} Hz, physics {physics:.4g} Hz; an episode is cut\n'
        f'  (discount 1) after {row.step_limit} steps'
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
