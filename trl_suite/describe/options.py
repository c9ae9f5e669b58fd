"""What `task_kwargs` may hold: name, default and meaning of every option of an environment."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from trl_suite import catalogue
from trl_suite.describe.layout import Section, Table, section

MEANINGS = {
    'base_actions': "'default', or 'original': those of the papers, where the default ones are our own",
    'blend': "which of the terrain's parameter sets to draw from; 0 is the first, 0.5 half-way to the second",
    'centre': "pose at action 0: mean of the 'clip', working 'posture', or the 'original' map of actions",
    'controller': 'footstep controller: an id whose policy is shipped, a policy file, or a function',
    'footstep_scale': 'times the squared miss of a landing place in the reward: more teaches accuracy',
    'goal': 'whether plans head for a goal on the terrain',
    'goal_distance': 'm, the least and the most from the walker (soccer: from the ball) at which goals are drawn; by default as told above',
    'goal_reached': 'm; nearer, a goal is reached; by default 1 m, in soccer and without hierarchy 0.5 m',
    'grace': 's after a push or a sharp turn in which no foot misses its place',
    'half_range': 'rad per unit action; by default 1.5, about a clip in space 1',
    'heading_scale': 'times the squared error of the heading in the reward',
    'mirrored': 'observe and act as if the right foot always stood first',
    'hidden_plan': "observe a goal instead of the plan, as the original's 'Hard' environments do",
    'miss': 'm; a foot that lands farther from its place ends the episode; by default it does not',
    'muscle_set': "'plain', or the motion that the muscles were optimised for",
    'plans': 'how footstep plans are drawn: a mapping, see trl_suite.tasks.plans; by default as told above',
    'pushes': 'forces on the torso: a mapping, see trl_suite.tasks.plans; by default there are none',
    'reward': "'goal', or 'original': what the original computes",
    'sight': "maps that are observed, of 'height' and 'velocity'",
    'spawn': "where planar ground begins: as 'intended', or 'upstream', as the original builds it",
    'start_noise': 'rad; standard deviation of joint angles at the start',
    'start_phase': 'phase of the clip at the start, in [0, 1), or pairs to draw it between; by default any',
    'start_phases': 'phases of the clock, one of which an episode starts with',
    'step_length': 'm; of the steps that action 0 means',
    'substeps': 'physics steps per step of the joint controller',
    'target': "observe the reference's state instead of the phase",
    'target_speed': 'm/s towards the goal from which on the reward is full',
    'terrain_map': 'observe the heights around, 32 x 32',
    'terrain_samples': 'heights of the ground ahead that are observed; 0: blind',
    'terrain_view': 'observe the ground ahead, in space around',
}
_EVERYWHERE = (
    ('rewards, observations, failures', '-', 'functions of your own, see docs/make_your_own.md'),
    ('random', '-', 'seed; by default another one every time'),
    ('time_limit', '-', 's of simulated time after which an episode is cut'),
)
_INTERFACES = {
    'gait': "'parameters': an action sets a gait cycle; 'base_action': prefers a gait, every 1/30 s",
    'plan': "'plan': a step is a footstep; 'frame': 1/30 s, an action has plan and joints' targets",
}
_ONLY = {'centre': 'position', 'half_range': 'position', 'muscle_set': 'muscle'}  # actuation


def options(row: catalogue.Row, known: Mapping[str, Any]) -> Section:
    """Returns what may be set of an environment.

    Args:
      row: of the environment.
      known: options of its task, with what they are by default: `suite.task_options(row)`.
    """
    cells: list[tuple[object, ...]] = []
    for name, default in sorted(known.items()):
        if _ONLY.get(name, row.actuation) == row.actuation:
            meaning = MEANINGS.get(name, '')  # a task of the user's has others
            if name == 'interface':
                meaning = _INTERFACES['gait' if row.rules == 'gait' else 'plan']
            cells.append((name, _shown(default), meaning))
    cells += _EVERYWHERE
    cells.append(('step_limit', row.step_limit, 'steps after which an episode is cut'))
    return section('Options, by task_kwargs', Table(('option', 'default', 'meaning'), cells))


def _shown(value: Any) -> str:
    return '-' if value is None else repr(dict(value) if isinstance(value, Mapping) else value)
