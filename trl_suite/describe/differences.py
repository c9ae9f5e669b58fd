"""Differences from the original, in sentences; docs/differences.md has the reasons."""

from __future__ import annotations

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


def differences_of(spec: EnvSpec) -> list[str]:
    """Returns the sentences that apply to an environment."""
    type_ = task_type(spec)
    found = [text for tag, text in ORIGINS.items() if tag in spec.tags]
    if type_ is not None:
        found += [each.text for each in type_.differences if each.applies(spec)]
    found += [*spec.differences, *character_of(spec).differences.get(spec.actuation, ())]
    for table, name in (ACTUATION, spec.actuation), (TERRAIN, spec.terrain):
        if name in table:
            found.append(table[name])
    return found
