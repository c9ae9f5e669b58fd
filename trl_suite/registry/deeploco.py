"""DeepLoco: footstep controllers, tasks that plan footsteps, and these tasks without hierarchy.

Source: the registry of Terrain RL Simulator (Berseth, Peng, van de Panne 2018).
"""

from __future__ import annotations

import dataclasses
from typing import Any

from trl_suite.registry.spec import EnvSpec

_FIELDS = {field.name for field in dataclasses.fields(EnvSpec)}


def _spec(tags: tuple[str, ...], origin: str = 'original', **given: Any) -> EnvSpec:
    """Returns a spec; what is given and is no field of it is an option of the task."""
    options = {name: given.pop(name) for name in [*given] if name not in _FIELDS}
    return EnvSpec(
        domain='deeploco',
        actuation='position',
        options=options,
        tags=frozenset({*tags, origin}),
        **given,
    )


_MADE = (
    'the 27 reference steps were made for this suite; the original has 14 from motion capture',
)


def _step(
    id_: str,
    task: str,
    words: str,
    character: str = 'biped3d_mocap',
    preset: str = 'plane',
    **given: Any,
) -> EnvSpec:
    fits = 'mirrored' not in given and character != 'biped3d_full_mocap'  # planning environments
    return _spec(
        ('spatial', 'controller') if fits else ('spatial',),
        id=id_,
        task=task,
        character=character,
        terrain=preset,
        task_type='spatial_footsteps',
        clip=character,
        description=f'The 3D biped {words}.',
        **{'differences': _MADE, **given},
    )


_STEP2D = _spec(
    ('planar', 'flat'),
    origin='completion',
    id='PD_Biped2D_LLC_Flat_Step-v0',
    task='llc_flat_step',
    character='biped2d_full',
    terrain='flat',
    task_type='planar_footsteps',
    clip='biped2d_full_walk',
    description='The biped with arms walks straight ahead along planned footsteps on flat ground.',
)

_STEPS = (
    _step(
        'PD_Biped3D_LLC_General_Step-v0', 'llc_general_step',
        'walks along planned footsteps, around turns',
    ),
    _step(
        'PD_Biped3D_LLC_Symetric_Step-v0', 'llc_symmetric_step',
        'walks along planned footsteps; observation and action are mirrored in left stance',
        aliases=('PD_Biped3D_LLC_Symmetric_Step-v0',), mirrored=True,
    ),
    _step(
        'PD_Biped3D_LLC_Run_FootStep-v0', 'llc_run_footstep', 'runs along planned footsteps',
        character='biped3d_mocap_run',
        differences=(
            'the landing place is rewarded in the second half of every step; in the original, the clock '
            'of this reward is slower than the steps',
            "the reference step was made for this suite, 3.83 m/s; the original's is from motion capture, "
            '4.4 m/s',
        ),
        plans={'length': (1.15, 1.15), 'turn': 0.0, 'sharp': 0.0},
    ),
    _step(
        'PD_Biped3D_LLC_Bumps_Step-v0', 'llc_bumps_step',
        'walks along planned footsteps over a raised chequerboard', preset='checkers_3d',
        origin='completion',
    ),
    _step(
        'PD_Biped3D_LLC_React_Step-v0', 'llc_react_step',
        'walks along planned footsteps, which go on from where the feet land', origin='addition',
        plans={'react': 1.0},
    ),
    _step(
        'PD_Biped3D_LLC_Trail_Step-v0', 'llc_trail_step',
        'walks along planned footsteps towards goals on a trail', preset='trail3d2', origin='completion',
        goal=True, plans={'length': (0.4, 0.4)},
    ),
    _step(
        'PD_Biped3D_FULL_Imitate-Steps-v0', 'llc_full_step',
        'with arms and head walks along planned footsteps', character='biped3d_full_mocap',
        aliases=('PD_Biped3D_Full_LLC_Step-v0',),
    ),
)  # fmt: skip


_STYLE = (
    'the reference steps, made for this suite, have the style; the paper adds a term for it to the reward',
)


def _styled(name: str, style: str, words: str, **given: Any) -> EnvSpec:
    return _step(
        f'PD_Biped3D_LLC_{name}_Step-v0', f'llc_{style}_step',
        f'walks along planned footsteps {words}', style=style, pose_scale=10.0,
        **{'origin': 'completion', 'differences': _STYLE, **given},
    )  # fmt: skip


# Ways of walking of the paper beside the nominal one.
_STYLES = (
    _styled('HighKnees', 'high_knees', 'with high knees'),
    _styled('StraightLegs', 'straight_legs', 'with straight legs'),
    _styled('OneStraightLeg', 'one_straight_leg', 'with a straight left leg'),
    _styled('ForwardLean', 'forward_lean', 'and leans forward'),
    _styled('SidewaysLean', 'sideways_lean', 'and leans to the right'),
    _styled(
        'InPlace', 'in_place', 'in place',
        plans={'length': (0.0, 0.1), 'turn': 0.2, 'change': 1.0},
    ),
    _styled(
        'Stand', 'stand', 'with stops', plans={'stop': 0.1},
        origin='addition', differences=(),
    ),
)  # fmt: skip

PLAN_LIMIT = 400  # footsteps after which an episode is truncated: 200 s
RUN_LIMIT = 667  # the same for running, where a footstep lasts 0.3 s


def _hike(
    name: str,
    preset: str,
    words: str,
    character: str = 'biped3d_mocap',
    rate: int = 1200,
    **given: Any,
) -> EnvSpec:
    physics = f'MuJoCo at 300 Hz instead of Bullet at {rate} Hz; see the option substeps'
    differences = (physics, *given.pop('differences', ()))
    return _spec(
        ('spatial', 'hierarchical'),
        id=f'PD_Biped3D_HLC_{name}-v0',
        task=f'hlc_{name.lower()}',
        character=character,
        terrain=preset,
        clip=character,
        description=f'The 3D biped {words}; an action plans the next two footsteps.',
        differences=differences,
        **{'task_type': 'goal_navigation', 'step_limit': PLAN_LIMIT, **given},
    )


_FROM_ZERO = (0.0,)  # phase of the clock at the start
_HIKES = (
    _hike('LargeBlocks', 'obstacles3d', 'goes from goal to goal among large blocks'),
    _hike(
        'DynamicsObstacles', 'dynamic_obstacles3d', 'goes from goal to goal among moving boxes',
        aliases=('PD_Biped3D_HLC_DynamicObstacles-v0',), rate=3000, terrain_observation='velocity',
        start_phases=_FROM_ZERO,
    ),
    _hike('Soccer', 'plane', 'dribbles a ball to a goal', task_type='soccer', terrain_observation=()),
    _hike(
        'Forest', 'pillars3d', 'goes from goal to goal between the pillars of a forest',
        rate=3000,
        differences=(
            'terrain heights are observed, including the pillars; the original observes surface velocities, '
            'which are all zero',
        ),
        start_phases=_FROM_ZERO,
    ),
    _hike(
        'Conveyors', 'conveyor3d', 'goes from goal to goal over conveyor belts',
        rate=3000, terrain_observation='velocity', start_phases=_FROM_ZERO,
    ),
    _hike(
        'Conveyors_Wide', 'conveyor3d_wide', 'goes from goal to goal over a wide conveyor belt',
        rate=3000, terrain_observation='velocity', start_phases=_FROM_ZERO,
    ),
    _hike('PathFollowing', 'trail3d1', 'follows a winding trail between hills', origin='completion'),
    _hike(
        'PathFollowing_Run', 'trail3d_wide', 'runs along a wide trail between hills',
        character='biped3d_mocap_run', origin='completion', step_limit=RUN_LIMIT,
        controller='PD_Biped3D_LLC_Run_FootStep-v0', start_phases=_FROM_ZERO, step_length=1.0,
        target_speed=3.0, goal_reached=2.0,
    ),
)  # fmt: skip


def _hard(name: str, preset: str, words: str, **given: Any) -> EnvSpec:
    return _spec(
        ('spatial', 'flat_control'),
        id=f'PD_Biped3D_Terrain_{name}_Hard-v0',
        task=f'{name.lower()}_hard',
        character='biped3d_mocap',
        terrain=preset,
        clip='biped3d_mocap_walk',
        description=f'The 3D biped {words}, without hierarchy: an action sets PD targets, at 30 Hz.',
        **{'task_type': 'direct_navigation', **given},
    )


_JOURNEYS = (
    _hard('Trail', 'trail3d1', 'follows a winding trail between hills'),
    _hard('Forest', 'pillars3d', 'goes from goal to goal between the pillars of a forest'),
    _hard('Blocks', 'obstacles3d', 'goes from goal to goal among large blocks'),
    _hard(
        'Dyanmics_Obs', 'dynamic_obstacles3d', 'goes from goal to goal among moving boxes',
        aliases=('PD_Biped3D_Terrain_Dynamic_Obs_Hard-v0',),
    ),
    _hard(
        'Dynamic_Obs_Velocity', 'dynamic_obstacles3d',
        'goes to goals among moving boxes, and observes velocities', origin='addition',
        terrain_observation=('height', 'velocity'),
    ),
    _hard(
        'Soccer', 'plane', 'dribbles a ball to a goal', origin='completion', task_type='direct_soccer',
        terrain_observation=(),
    ),
)  # fmt: skip

SPECS = (*_STEPS, *_STYLES, _STEP2D, *_HIKES, *_JOURNEYS)
