"""Differences from the original, in sentences; docs/differences.md has the reasons."""

from __future__ import annotations

from collections.abc import Callable

from trl_suite.registry.build import character_of, task_type
from trl_suite.registry.spec import EnvSpec

ORIGINS = {  # by tag
    'completion': 'not registered in the original: a combination that its papers name or imply',
    'addition': 'not part of the original',
}
ACTUATION = {
    'position': 'damping is split between servo and joint; joints have an armature of 0.01 kg m^2',
    'torque': 'joints have passive damping and an armature of 0.01 kg m^2; action 1 is 0.75 of the limit',
    'velocity': 'joints have an armature of 0.01 kg m^2; the velocity gain is the damping gain kd',
    'muscle': "MuJoCo's muscle curves fitted to the original's, rigid tendons, constant moment arms",
}
_OVERLAPS = (
    'obstacles have vertical faces, and where two overlap the higher one counts; in the original, faces '
    'slope over 0.2 m, and the obstacle placed later counts'
)
_BELTS = (
    'a belt is one box with a moving surface; in the original it is a sequence of moving boxes that '
    'reappear at the other end'
)
TERRAIN = {
    'conveyor3d': _BELTS,
    'conveyor3d_wide': _BELTS,
    'dynamic_obstacles3d': (
        'moving boxes have an armature of 2000 kg and push with up to 2000 N in the long run: they push '
        'and carry other bodies, and yield to what is caught between two of them; in the original they '
        'are kinematic, and have a mass of 1 kg in contacts'
    ),
    'mixed_humanoid': 'the terrain is inferred: slopes_mixed_humanoid without slopes',
    'obstacles3d': _OVERLAPS,
    'pillars3d': _OVERLAPS,
    'stairs3d': (
        'treads have vertical faces and extend to both sides; in the original, faces slope over 0.2 m and '
        'treads change 1 m to the side of the start'
    ),
}

_FROM = 'MuJoCo at {} Hz instead of Bullet at {} Hz; see the option substeps'
_ACTIONS = 'actions are in [-1, 1] and clipped; the original takes physical units'
_AXES = 'axes are x forward, y left, z up; the original has y up and z to the right'
_CONES = 'a ball joint is limited by one cone, as wide as the widest of its three ranges'
_ROTATIONS = (
    'targets of ball joints are rotation vectors about the mean pose; the option '
    "action_offset='original' selects the original's angle and axis",
    'rotation errors are the shortest rotation; angular velocities of character and reference are '
    'compared in the same frame',
)


def _shipped_clip(spec: EnvSpec) -> bool:
    return 'clip' not in spec.own


_OWN_CLIP = (
    "the clip was made for this suite, with gait and speed close to the original's",
    _shipped_clip,
)
_START_PHASE = 'the start phase is drawn uniformly, not in a fixed sequence'
_LANDING = 'a landing error ends the episode only with the option max_landing_error'
_FACES = (
    'faces of gaps, walls and steps are exactly vertical without the option face_length, and every start '
    'has flat ground from -1 to 1 m',
    lambda spec: spec.terrain != 'flat',
)
_CUT = 'episodes are truncated after 256 steps (discount 1)'
_PLANNED = (
    _AXES,
    _CONES,
    'a step is a whole footstep, from one switch of stance to the next; in the original it is 1/30 s, '
    'and the caller decides when to plan; see the option interface',
    'the footstep controller is part of the environment, and its policy was trained for this suite; in '
    'the original the caller runs it; see the option controller',
    'actions are in [-1, 1], clipped, and scaled as in the native learner of the original, whose Python '
    'interface takes m and rad',
    'the reward is for the whole step; in the original it is for the time since the last plan, which '
    'may be a few ms',
    'episodes are truncated after 200 s (discount 1); the configured limit of the original has no effect',
)
_SPATIAL = (_AXES, _ACTIONS, *_ROTATIONS, _CONES)
_DIRECT = (
    _FROM.format(300, 1200),
    *_SPATIAL,
    ("the clip was made for this suite, 1.3 m/s; the original's walks at 1.535 m/s", _shipped_clip),
    _START_PHASE,
    _CUT,
)
# By task type; with a function, a difference is only that of environments for which it returns True.
TASKS: dict[str, tuple[str | tuple[str, Callable[[EnvSpec], bool]], ...]] = {
    'planar_imitation': (
        (_FROM.format(600, 3000), lambda spec: 'substeps' in spec.options),
        (_FROM.format(300, 3000), lambda spec: 'substeps' not in spec.options),
        _ACTIONS,
        _OWN_CLIP,
        _START_PHASE,
        _FACES,
        _CUT,
    ),
    'spatial_imitation': (
        _FROM.format(300, 3000),
        *_SPATIAL,
        'the goal is 3 m ahead on the line along +x through the start; the original observes bearing '
        'and distance of the start',
        _START_PHASE,
        _CUT,
    ),
    'planar_footsteps': (
        _FROM.format(300, 3000),
        _ACTIONS,
        _LANDING,
        'the reference of a step is half a cycle of the walk, for all step lengths',
        _OWN_CLIP,
        _START_PHASE,
        _CUT,
    ),
    'spatial_footsteps': (
        _FROM.format(300, 1200),
        *_SPATIAL,
        (
            'observations and actions are mirrored; in the original, this id runs the same environment as '
            'PD_Biped3D_LLC_General_Step-v0',
            lambda spec: spec.options.get('mirrored', False),
        ),
        _LANDING,
        (
            'a goal is redrawn when the walker is within 1 m; the original draws one, at the start',
            lambda spec: spec.options.get('goal', False),
        ),
        _START_PHASE,
        _CUT,
    ),
    'goal_navigation': (
        *_PLANNED,
        'whether a goal is reached or has expired is tested once per step',
    ),
    'soccer': (*_PLANNED, 'whether ball and goal have expired is tested once per step'),
    'direct_navigation': (
        *_DIRECT,
        'the reward depends on the goal, and a goal that is reached is redrawn; in the original, the '
        'reward is for footsteps that are not observed, and the goal is fixed; see the option reward',
    ),
    'direct_soccer': (
        *_DIRECT,
        'there is a ball, which half of the reward depends on; the configuration of the original '
        'has none',
    ),
    'gait': (
        'MuJoCo at 1200 Hz, control at 600 Hz; the original controls most of these characters at 30 '
        'Hz, at which they fall in this suite',
        'actions are in [-1, 1], clipped, and mapped to the learnt parameters; the original assigns '
        'them to the first entries of the vector of all parameters, so that most of them set a wrong '
        'parameter',
        'a step ends with its cycle or a fall, not up to 1/30 s later; the first action of an '
        'episode takes effect',
        'the reward is that of the cycle that the action controlled, and never NaN',
        _FACES,
        'episodes are truncated after 5000 cycles (discount 1)',
    ),
}


def differences_of(spec: EnvSpec) -> list[str]:
    """Returns the sentences that apply to an environment."""
    type_ = task_type(spec)
    found = [text for tag, text in ORIGINS.items() if tag in spec.tags]
    for each in () if type_ is None else TASKS.get(type_.name, ()):
        text, applies = each if isinstance(each, tuple) else (each, None)
        if applies is None or applies(spec):
            found.append(text)
    found += [*spec.differences, *character_of(spec).differences.get(spec.actuation, ())]
    for table, name in (ACTUATION, spec.actuation), (TERRAIN, spec.terrain):
        if name in table:
            found.append(table[name])
    return found
