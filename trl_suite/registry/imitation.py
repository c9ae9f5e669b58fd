"""Imitation: a motion clip is tracked with one of four actuation models, or in three dimensions.

Source: the registry of Terrain RL Simulator (Berseth, Peng, van de Panne 2018).
"""

from __future__ import annotations

from types import MappingProxyType
from typing import Any

from trl_suite.registry.naming import GAITS, NAMES, status
from trl_suite.registry.spec import EnvSpec

PREFIX = {'position': 'PD', 'torque': 'Torque', 'muscle': 'MTU', 'velocity': 'Vel'}
BY = {
    'position': 'PD targets', 'torque': 'joint torques', 'muscle': 'muscle excitations',
    'velocity': 'joint velocity targets',
}  # fmt: skip

# Phases in the air. Where the clip brakes in stance, its hips turn at 12 rad/s, and the raptor's hip
# extensors, which shorten as fast, pull with a third of what it takes: hardly a start there is
# survived.
_FLIGHT = ((0.25, 0.5), (0.75, 1.0))


def _imitation(character: str, model: str, clip: str, original: bool) -> EnvSpec:
    run = '_Run' if clip == 'biped2d_run' else ''
    # Where servos or torques drive joints hard into their limits, limits hold at 600 Hz; see
    # benchmarks/physics_rate.md.
    fine = model == 'velocity' or (model == 'torque' and character != 'biped2d')
    id_ = f'{PREFIX[model]}_{NAMES[character]}_LLC_Imitate{run}_Flat-v0'
    figure = NAMES[character][:-2].lower()
    options: dict[str, Any] = {'reference_observation': True, **({'substeps': 20} if fine else {})}
    differences: tuple[str, ...] = ()
    if (character, model) == ('raptor', 'muscle'):
        options['start_phase'] = _FLIGHT
        differences = (
            'episodes start in the air, in phases 0.25 to 0.5 and 0.75 to 1: in stance its muscles cannot '
            'brake the clip',
        )
    return EnvSpec(
        id=id_,
        domain='imitation',
        task=f'{PREFIX[model].lower()}_{figure}{run.lower()}',
        character=character,
        actuation=model,
        terrain='flat',
        clip=clip,
        options=MappingProxyType(options),
        differences=differences,
        description=f'The {figure} tracks a {GAITS[clip]} on flat ground by {BY[model]}.',
        tags=frozenset({'planar', 'flat', status(id_, original)}),
    )


# Name in ids, preset, words. The original tracks a walk over all of them.
_SPATIAL_TERRAINS = (
    ('', 'plane', 'flat ground', True),
    ('Hills', 'hills3d', 'hills', True),
    ('Ramp', 'ramp3d', 'a ramp', True),
    ('Stairs', 'stairs3d', 'stairs', True),
    ('Steps', 'steps3d', 'scattered low boxes', True),
    ('Rough', 'checkers3d', 'a raised chequerboard', False),
)


_CLIPS = {'biped3d_walk': "the clip is our own, 1.2 m/s; the original's walks at 1.535 m/s"}


def _spatial(
    name: str, preset: str, words: str, original: bool, clip: str = 'biped3d_walk', **options: Any
) -> EnvSpec:
    gait = 'run' if clip.endswith('run') else 'walk'
    seeing = options.get('terrain_observation', False)
    view = ', seeing the ground around it,' if seeing else ''
    view = ', whose state it sees,' if options.get('reference_observation') else view
    return EnvSpec(
        id=f'PD_Biped3D_Imitate{"-" if name else ""}{name}{"_Terrain" if seeing else ""}-v0',
        domain='imitation',
        task=f'pd_biped3d{"_" if name else ""}{name.lower()}{"_terrain" if seeing else ""}',
        character='biped3d',
        actuation='position',
        terrain=preset,
        task_type='spatial_imitation',
        differences=(
            _CLIPS.get(clip, "the clip is our own, close to the original's in gait and speed"),
        ),
        clip=clip,
        options=MappingProxyType(options),
        description=f'The 3D biped tracks a {gait}{view} straight on over {words} by PD targets.',
        tags=frozenset({'spatial', 'original' if original else 'completion'}),
    )


SPECS = (
    *(
        _imitation(character, model, clip, original=model != 'velocity')
        for character, clips in (
            ('biped2d', ('biped2d_walk', 'biped2d_walk')),
            ('dog', ('dog_bound', 'dog_bound')),
            # The original tracks another run of the raptor with PD than with the other models.
            ('raptor', ('raptor_run_050', 'raptor_run_066')),
        )
        for model, clip in (
            ('position', clips[0]), ('torque', clips[1]), ('muscle', clips[1]),
            ('velocity', clips[1]),
        )
    ),
    _imitation('biped2d', 'position', 'biped2d_run', original=False),
    _imitation('biped2d', 'muscle', 'biped2d_run', original=False),
    *(_spatial(*terrain) for terrain in _SPATIAL_TERRAINS),
    # The original is blind on all of them.
    *(_spatial(*terrain[:3], False, terrain_observation='height') for terrain in _SPATIAL_TERRAINS[1:]),
    _spatial('Track', 'plane', 'flat ground', True, reference_observation=True),
    _spatial('Run', 'plane', 'flat ground', False, clip='biped3d_run'),
)  # fmt: skip
