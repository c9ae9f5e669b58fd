"""What differs from the original, in sentences; docs/differences.md has the reasons."""

from __future__ import annotations

from trl_suite.registry.build import character_of, task_type
from trl_suite.registry.spec import EnvSpec

COMPLETION = 'not in the registry of the original: a combination that its papers name or imply'
ACTUATION = {
    'position': 'damping is split between servo and joint, joints have an armature of 0.01 kg m^2',
    'torque': 'joints have passive damping and an armature of 0.01 kg m^2; action 1 is 0.75 of the limit',
    'velocity': 'joints have an armature of 0.01 kg m^2; the damping gain is the servo',
    'muscle': "MuJoCo's muscle curves fitted to the original's, rigid tendons, constant moment arms",
}
_OVERLAPS = (
    'what stands on the ground has vertical faces, and where it overlaps the higher one counts; faces of the '
    'original slope over 0.2 m, and the later one counts'
)
_BELTS = (
    'a belt is one box whose surface moves; that of the original is a row of boxes that move and re-enter '
    'behind'
)
TERRAIN = {
    'conveyor3d': _BELTS,
    'conveyor3d_wide': _BELTS,
    'dynamic_obstacles3d': (
        'moving boxes have an inertia of 10^6 kg: they push, carry, and are not stopped; those of the original '
        'are kinematic, and of 1 kg to whom they meet'
    ),
    'mixed_humanoid': 'the terrain is inferred: slopes_mixed_humanoid without slopes',
    'obstacles3d': _OVERLAPS,
    'pillars3d': _OVERLAPS,
    'stairs3d': (
        'treads have vertical faces and run on to both sides; those of the original slope over 0.2 m and '
        'change 1 m beside the start'
    ),
}


def differences_of(spec: EnvSpec) -> list[str]:
    """Returns the sentences that apply to an environment."""
    type_ = task_type(spec)
    found = [COMPLETION] if 'completion' in spec.tags else []
    if type_ is not None:
        found += [each.text for each in type_.differences if each.applies(spec)]
    found += [*spec.differences, *character_of(spec).differences.get(spec.actuation, ())]
    for table, name in (ACTUATION, spec.actuation), (TERRAIN, spec.terrain):
        if name in table:
            found.append(table[name])
    return found
