"""Imitation: tracking a motion clip, in the plane with four actuation models, or in 3D.

Source: the registry of Terrain RL Simulator (Berseth, Peng, van de Panne 2018).
"""

from __future__ import annotations

from typing import Any

from trl_suite.registry.naming import GAITS, NAMES, status
from trl_suite.registry.spec import EnvSpec

PREFIX = {'position': 'PD', 'torque': 'Torque', 'muscle': 'MTU', 'velocity': 'Vel'}
BY = {
    'position': 'PD targets',
    'torque': 'joint torques',
    'muscle': 'muscle excitations',
    'velocity': 'joint velocity targets',
}

# Phases in the air. In stance the clip brakes: its hips turn at 12 rad/s, and at the corresponding
# shortening velocity the raptor's hip extensors produce a third of the force that braking requires,
# so that nearly all episodes that start there fail.
_FLIGHT = ((0.25, 0.5), (0.75, 1.0))


def _imitation(character: str, model: str, clip: str, original: bool) -> EnvSpec:
    run = '_Run' if clip == 'biped2d_run' else ''
    # Servos or torques that push joints against their limits need 600 Hz to keep within the limits;
    # see benchmarks/physics_rate.md.
    fine = model == 'velocity' or (model == 'torque' and character != 'biped2d')
    id_ = f'{PREFIX[model]}_{NAMES[character]}_LLC_Imitate{run}_Flat-v0'
    figure = NAMES[character][:-2].lower()
    options: dict[str, Any] = {'reference_observation': True, **({'substeps': 20} if fine else {})}
    differences: tuple[str, ...] = ()
    if (character, model) == ('raptor', 'muscle'):
        options['start_phase'] = _FLIGHT
        differences = (
            "episodes start in the air, at phases 0.25 to 0.5 and 0.75 to 1, since the raptor's muscles are "
            'too weak to brake as the clip does in stance',
        )
    return EnvSpec(
        id=id_,
        domain='imitation',
        task=f'{PREFIX[model].lower()}_{figure}{run.lower()}',
        character=character,
        actuation=model,
        terrain='flat',
        clip=clip,
        options=options,
        differences=differences,
        description=f'The {figure} tracks a {GAITS[clip]} on flat ground with {BY[model]}.',
        tags=frozenset({'planar', 'flat', status(id_, original)}),
    )


# Terrains of the walk: name in ids, preset, words, whether the original has the environment.
_SPATIAL_TERRAINS = (
    ('', 'plane', 'flat ground', True),
    ('Hills', 'hills3d', 'hills', True),
    ('Ramp', 'ramp3d', 'a ramp', True),
    ('Stairs', 'stairs3d', 'stairs', True),
    ('Steps', 'steps3d', 'scattered low boxes', True),
    ('Rough', 'checkers3d', 'a raised chequerboard', False),
)


def _spatial(
    name: str, preset: str, words: str, original: bool, clip: str = 'biped3d_walk', **options: Any
) -> EnvSpec:
    gait = 'run' if clip.endswith('run') else 'walk'
    seeing = options.get('terrain_observation', False)
    view = ', observing the terrain around it' if seeing else ''
    view = ', observing the state of the clip' if options.get('reference_observation') else view
    return EnvSpec(
        id=f'PD_Biped3D_Imitate{"-" if name else ""}{name}{"_Terrain" if seeing else ""}-v0',
        domain='imitation',
        task=f'pd_biped3d{"_" if name else ""}{name.lower()}{"_terrain" if seeing else ""}',
        character='biped3d',
        actuation='position',
        terrain=preset,
        task_type='spatial_imitation',
        differences=(
            "the clip was made for this suite, 1.2 m/s; the original's walks at 1.535 m/s"
            if gait == 'walk'
            else "the clip was made for this suite, with gait and speed close to the original's",
        ),
        clip=clip,
        options=options,
        description=f'The 3D biped tracks a {gait} straight ahead over {words} with PD targets{view}.',
        tags=frozenset({'spatial', 'original' if original else 'completion'}),
    )


SPECS = (
    *(
        _imitation(
            character, model, first if model == 'position' else other, original=model != 'velocity'
        )
        for character, first, other in (
            ('biped2d', 'biped2d_walk', 'biped2d_walk'),
            ('dog', 'dog_bound', 'dog_bound'),
            # For the raptor, the original tracks one run with PD control and another otherwise.
            ('raptor', 'raptor_run_050', 'raptor_run_066'),
        )
        for model in PREFIX
    ),
    _imitation('biped2d', 'position', 'biped2d_run', original=False),
    _imitation('biped2d', 'muscle', 'biped2d_run', original=False),
    *(_spatial(*terrain) for terrain in _SPATIAL_TERRAINS),
    # The original does not observe the terrain in these environments.
    *(_spatial(*each[:3], False, terrain_observation='height') for each in _SPATIAL_TERRAINS[1:]),
    _spatial('Track', 'plane', 'flat ground', True, reference_observation=True),
    _spatial('Run', 'plane', 'flat ground', False, clip='biped3d_run'),
)
