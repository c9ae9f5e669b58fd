"""Every environment as one row of data: ids of the paper, aliases, tags, one-line descriptions.

Rows marked 'original' are registered in the original simulator; 'completion' rows are combinations
that its papers name and its registry lacks. Source: the registry of Terrain RL Simulator (Berseth,
Peng, van de Panne 2018).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from trl_suite import errors

STEP_LIMIT = 256  # control steps after which an episode is cut
# Of gaits, whose steps are cycles of 1 to 2 m: the best policies of the 2016 paper fall after 2 km on
# average, some 1200 cycles, and one episode in sixty of theirs would last longer than this.
GAIT_STEP_LIMIT = 5000
PLAID_SAMPLES = 50  # heights that a PLAiD environment sees, unless it is blind


@dataclasses.dataclass(frozen=True)
class Row:
    """One environment.

    Attributes:
      id: id in the paper's manner.
      domain: family, for `suite.load`.
      task: name within the family, for `suite.load`.
      character: name in `trl_suite.characters.CHARACTERS`.
      actuation: one of `trl_suite.actuation.ACTUATIONS`, or 'gait'.
      terrain: preset, file, or mapping that `trl_suite.terrain.load` takes.
      rules: which task class makes it (see `trl_suite.suite`).
      clip: clip in mocap/, or None where the rules need none.
      options: keyword arguments of the task class, where they differ from its defaults.
      description: one line.
      tags: for selection.
      aliases: other ids.
      step_limit: control steps after which an episode is cut.
    """

    id: str
    domain: str
    task: str
    character: str
    actuation: str
    terrain: Any
    description: str
    rules: str = 'imitation'
    clip: str | None = None
    options: Mapping[str, Any] = dataclasses.field(default_factory=lambda: MappingProxyType({}))
    tags: frozenset[str] = frozenset()
    aliases: tuple[str, ...] = ()
    step_limit: int = STEP_LIMIT

    def __reduce__(self) -> tuple[Any, ...]:
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return _row, ({**values, 'options': dict(self.options)},)


def _row(values: dict[str, Any]) -> Row:
    return Row(**{**values, 'options': MappingProxyType(values['options'])})


# The original's name of each character in ids, and the words for descriptions.
_IN_ID = {'biped2d': 'Biped2D', 'biped2d_full': 'Biped2D', 'dog': 'Dog2D', 'raptor': 'Raptor2D'}
_GAIT = {
    'biped2d_walk': 'walk', 'biped2d_run': 'run', 'biped2d_full_walk': 'walk', 'dog_bound': 'bound',
    'raptor_run_050': 'run', 'raptor_run_066': 'run',
}  # fmt: skip
_PREFIX = {'position': 'PD', 'torque': 'Torque', 'muscle': 'MTU', 'velocity': 'Vel'}
_BY = {
    'position': 'PD targets', 'torque': 'joint torques', 'muscle': 'muscle excitations',
    'velocity': 'joint velocity targets',
}  # fmt: skip
_PLAID_CHARACTERS = {
    'biped2d_full': 'biped2d_full_walk', 'dog': 'dog_bound', 'raptor': 'raptor_run_050',
}  # fmt: skip
# Name in ids, preset, words.
_PLAID_TERRAINS = (
    ('Flat', 'flat', 'flat ground'),
    ('Incline', 'inclines', 'a steady ramp of about 10 degrees'),
    ('Steps', 'steps_humanoid', 'ever ascending steps of 5 to 15 cm'),
    ('Slopes', 'slopes_humanoid', 'rough rolling slopes'),
    ('Gaps', 'gaps_humanoid', 'gaps 25 to 30 cm wide'),
    ('Walls', 'walls_humanoid', 'walls 5 to 25 cm high'),
    ('Mixed', 'mixed_humanoid', 'a mix of gaps, walls and steps'),
    ('Slopes_Mixed', 'slopes_mixed_humanoid', 'gaps, walls and steps on rolling slopes'),
)  # fmt: skip
_NOT_REGISTERED = {
    'PD_Dog2D_Flat_Terrain-v0', 'PD_Raptor2D_Flat_Terrain-v0', 'PD_Biped2D_Mixed_Terrain-v0',
    'PD_Dog2D_Mixed_Terrain-v0', 'PD_Raptor2D_Mixed_Terrain-v0', 'PD_Dog2D_Flat-v0',
    'PD_Raptor2D_Flat-v0',
}  # fmt: skip


def _status(id_: str, original: bool) -> str:
    return 'original' if original and id_ not in _NOT_REGISTERED else 'completion'


def _plaid(character: str, name: str, preset: str, words: str, blind: bool) -> Row:
    clip = _PLAID_CHARACTERS[character]
    id_ = f'PD_{_IN_ID[character]}_{name}{"" if blind else "_Terrain"}-v0'
    figure = _IN_ID[character][:-2].lower()
    sight = 'without seeing the ground' if blind else 'seeing 3 m of ground ahead'
    return Row(
        id=id_,
        domain='plaid',
        task=f'{figure}_{name.lower()}{"_blind" if blind else ""}',
        character=character,
        actuation='position',
        terrain=preset,
        clip=clip,
        options=MappingProxyType({} if blind else {'terrain_samples': PLAID_SAMPLES}),
        description=f'The {figure} tracks a {_GAIT[clip]} over {words}, {sight}.',
        tags=frozenset({'planar', _status(id_, True), *(['blind'] if blind else [])}),
    )


# Phases in the air. Where the clip brakes in stance, its hips turn at 12 rad/s, and the raptor's hip
# extensors, which shorten as fast, pull with a third of what it takes: hardly a start there is
# survived.
_FLIGHT = ((0.25, 0.5), (0.75, 1.0))


def _imitation(character: str, model: str, clip: str, original: bool) -> Row:
    run = '_Run' if clip == 'biped2d_run' else ''
    # Where servos or torques drive joints hard into their limits, limits hold at 600 Hz; see
    # benchmarks/physics_rate.md.
    fine = model == 'velocity' or (model == 'torque' and character != 'biped2d')
    id_ = f'{_PREFIX[model]}_{_IN_ID[character]}_LLC_Imitate{run}_Flat-v0'
    figure = _IN_ID[character][:-2].lower()
    options: dict[str, Any] = {'target': True, **({'substeps': 20} if fine else {})}
    if (character, model) == ('raptor', 'muscle'):
        options['start_phase'] = _FLIGHT
    return Row(
        id=id_,
        domain='imitation',
        task=f'{_PREFIX[model].lower()}_{figure}{run.lower()}',
        character=character,
        actuation=model,
        terrain='flat',
        clip=clip,
        options=MappingProxyType(options),
        description=f'The {figure} tracks a {_GAIT[clip]} on flat ground by {_BY[model]}.',
        tags=frozenset({'planar', 'flat', _status(id_, original)}),
    )


# Name in ids, preset, words; then who crosses it in a completion of ours.
_GAIT_TERRAINS = (
    ('Gaps', 'gaps', 'gaps'),
    ('Cliffs', 'cliffs_humanoid', 'drops'),
    ('Mixed', 'mixed', 'a mix of gaps, walls and steps'),
    ('Slopes_Mixed', 'slopes_mixed', 'gaps, walls and steps on rolling slopes'),
    ('Slopes', 'slopes', 'rolling slopes'),
    ('Stairs_Rugged', 'cliffs_rugged', 'rugged stairs'),
    ('Walls', 'walls', 'walls'),
    ('Steps', 'steps', 'steps up and down'),
)
_GAIT_CHARACTERS = {
    'biped2d_simbicon': 'Biped2D', 'dog': 'Dog2D', 'raptor': 'Raptor2D', 'hopper': 'Hopper2D',
}  # fmt: skip
_MORE_GAITS = (
    ('dog', 'Narrow_Gaps', 'narrow_gaps', 'clusters of narrow gaps'),
    ('dog', 'Tight_Gaps', 'tight_gaps', 'clusters of gaps with little room between'),
    ('dog', 'Slopes_Gaps', 'slopes_gaps0', 'gaps on rolling slopes'),
    ('dog', 'Slopes_Steps', 'slopes_steps', 'steps on rolling slopes'),
    ('dog', 'Slopes_Walls', 'slopes_walls', 'walls on rolling slopes'),
    ('raptor', 'Narrow_Gaps', 'narrow_gaps', 'clusters of narrow gaps'),
    ('raptor', 'Mixed_Raptor', 'mixed_raptor', 'gaps, walls and steps of its own size'),
    ('goat', 'Variable_Steps', 'cliffs_rugged', 'rugged stairs'),
    ('goat', 'Cliffs', 'cliffs_humanoid', 'drops'),
    ('hopper', 'Gaps_Easy', 'gaps_hopper', 'gaps of its own size'),
    ('hopper', 'Mixed_Easy', 'mixed_hopper', 'gaps, walls and steps of its own size'),
)


def _gait(character: str, name: str, preset: str, words: str, original: bool) -> Row:
    figure = {**_GAIT_CHARACTERS, 'goat': 'Goat2D'}[character]
    return Row(
        id=f'FSM_{figure}_Terrain_{name}-v0',
        domain='terrainrl',
        task=f'{figure[:-2].lower()}_{name.lower()}',
        character=character,
        actuation='gait',
        terrain=preset,
        rules='gait',
        description=f'The {figure[:-2].lower()} crosses {words}; an action sets the gait of a cycle.',
        tags=frozenset({'planar', 'original' if original else 'completion'}),
        step_limit=GAIT_STEP_LIMIT,
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


def _imitation3d(
    name: str, preset: str, words: str, original: bool, clip: str = 'biped3d_walk', **options: Any
) -> Row:
    gait = 'run' if clip.endswith('run') else 'walk'
    seeing = options.get('terrain_map', False)
    sight = ', seeing the ground around it,' if seeing else ''
    sight = ', whose state it sees,' if options.get('target') else sight
    return Row(
        id=f'PD_Biped3D_Imitate{"-" if name else ""}{name}{"_Terrain" if seeing else ""}-v0',
        domain='imitation',
        task=f'pd_biped3d{"_" if name else ""}{name.lower()}{"_terrain" if seeing else ""}',
        character='biped3d',
        actuation='position',
        terrain=preset,
        rules='imitation3d',
        clip=clip,
        options=MappingProxyType(options),
        description=f'The 3D biped tracks a {gait}{sight} straight on over {words} by PD targets.',
        tags=frozenset({'spatial', 'original' if original else 'completion'}),
    )


def _step(
    id_: str,
    task: str,
    words: str,
    *,
    character: str = 'biped3d_mocap',
    preset: str = 'plane',
    original: bool = True,
    aliases: tuple[str, ...] = (),
    **options: Any,
) -> Row:
    return Row(
        id=id_,
        domain='deeploco',
        task=task,
        character=character,
        actuation='position',
        terrain=preset,
        rules='footsteps',
        clip=character,
        options=MappingProxyType(options),
        description=f'The 3D biped {words}.',
        tags=frozenset({'spatial', 'original' if original else 'completion'}),
        aliases=aliases,
    )


_STEP2D = Row(
    id='PD_Biped2D_LLC_Flat_Step-v0',
    domain='deeploco',
    task='llc_flat_step',
    character='biped2d_full',
    actuation='position',
    terrain='flat',
    rules='footsteps2d',
    clip='biped2d_full_walk',
    description='The biped with arms walks along planned footsteps, straight on over flat ground.',
    tags=frozenset({'planar', 'flat', 'completion'}),
)

_STEPS = (
    _step(
        'PD_Biped3D_LLC_General_Step-v0', 'llc_general_step',
        'walks along planned footsteps, around turns',
    ),
    _step(
        'PD_Biped3D_LLC_Symetric_Step-v0', 'llc_symmetric_step',
        'walks along planned footsteps; what it sees and does is mirrored in left stance',
        aliases=('PD_Biped3D_LLC_Symmetric_Step-v0',), mirrored=True,
    ),
    _step(
        'PD_Biped3D_LLC_Run_FootStep-v0', 'llc_run_footstep', 'runs along planned footsteps',
        character='biped3d_mocap_run',
        plans={'length': (1.15, 1.15), 'turn': 0.0, 'sharp': 0.0},
    ),
    _step(
        'PD_Biped3D_LLC_Bumps_Step-v0', 'llc_bumps_step',
        'walks along planned footsteps over a raised chequerboard', preset='checkers_3d',
        original=False,
    ),
    _step(
        'PD_Biped3D_LLC_Trail_Step-v0', 'llc_trail_step',
        'walks along footsteps that head for goals on a trail', preset='trail3d2', original=False,
        goal=True, plans={'length': (0.4, 0.4)},
    ),
    _step(
        'PD_Biped3D_FULL_Imitate-Steps-v0', 'llc_full_step',
        'with arms and head walks along planned footsteps', character='biped3d_full_mocap',
        aliases=('PD_Biped3D_Full_LLC_Step-v0',),
    ),
)  # fmt: skip

HIKE_LIMIT = 400  # plans after which an episode is cut: 200 s
RUN_LIMIT = 667  # the same of a run, whose footsteps last 0.3 s


def _hike(
    name: str, preset: str, words: str, *, character: str = 'biped3d_mocap', original: bool = True,
    rules: str = 'hike', limit: int = HIKE_LIMIT, aliases: tuple[str, ...] = (), **options: Any,
) -> Row:  # fmt: skip
    return Row(
        id=f'PD_Biped3D_HLC_{name}-v0',
        domain='deeploco',
        task=f'hlc_{name.lower()}',
        character=character,
        actuation='position',
        terrain=preset,
        rules=rules,
        clip=character,
        options=MappingProxyType(options),
        description=f'The 3D biped {words}; an action plans its next two footsteps.',
        tags=frozenset({'spatial', 'hierarchical', 'original' if original else 'completion'}),
        aliases=aliases,
        step_limit=limit,
    )


_FROM_ZERO = (0.0,)  # phase of the start
_HIKES = (
    _hike('LargeBlocks', 'obstacles3d', 'goes from goal to goal among large blocks'),
    _hike(
        'DynamicsObstacles', 'dynamic_obstacles3d', 'goes from goal to goal among moving boxes',
        aliases=('PD_Biped3D_HLC_DynamicObstacles-v0',), sight=('velocity',),
        start_phases=_FROM_ZERO,
    ),
    _hike('Soccer', 'plane', 'dribbles a ball to a goal', rules='soccer', sight=()),
    _hike(
        'Forest', 'pillars3d', 'goes from goal to goal between the pillars of a forest',
        start_phases=_FROM_ZERO,
    ),
    _hike(
        'Conveyors', 'conveyor3d', 'goes from goal to goal over conveyor belts',
        sight=('velocity',), start_phases=_FROM_ZERO,
    ),
    _hike(
        'Conveyors_Wide', 'conveyor3d_wide', 'goes from goal to goal over a wide conveyor belt',
        sight=('velocity',), start_phases=_FROM_ZERO,
    ),
    _hike('PathFollowing', 'trail3d1', 'follows a winding trail between hills', original=False),
    _hike(
        'PathFollowing_Run', 'trail3d_wide', 'runs along a wide trail between hills',
        character='biped3d_mocap_run', original=False, limit=RUN_LIMIT,
        controller='PD_Biped3D_LLC_Run_FootStep-v0', start_phases=_FROM_ZERO, step_length=1.0,
        target_speed=3.0, goal_reached=2.0,
    ),
)  # fmt: skip


def _hard(
    name: str, preset: str, words: str, *, original: bool = True, rules: str = 'journey',
    aliases: tuple[str, ...] = (), **options: Any,
) -> Row:  # fmt: skip
    return Row(
        id=f'PD_Biped3D_Terrain_{name}_Hard-v0',
        domain='deeploco',
        task=f'{name.lower()}_hard',
        character='biped3d_mocap',
        actuation='position',
        terrain=preset,
        rules=rules,
        clip='biped3d_mocap_walk',
        options=MappingProxyType(options),
        description=f'The 3D biped {words}, without hierarchy: by PD targets 30 times a second.',
        tags=frozenset({'spatial', 'flat_control', 'original' if original else 'completion'}),
        aliases=aliases,
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
        'Soccer', 'plane', 'dribbles a ball to a goal', original=False, rules='ball_journey',
        terrain_map=False,
    ),
)  # fmt: skip

_BLIND = (('biped2d_full', 0), ('biped2d_full', 1), ('dog', 0), ('raptor', 0))  # terrain by index

ROWS: tuple[Row, ...] = (
    *(
        _plaid(character, *terrain, blind=False)
        for character in _PLAID_CHARACTERS
        for terrain in _PLAID_TERRAINS
    ),
    *(_plaid(character, *_PLAID_TERRAINS[i], blind=True) for character, i in _BLIND),
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
    *(
        _gait(character, *terrain, original=True)
        for character in _GAIT_CHARACTERS
        for terrain in _GAIT_TERRAINS
    ),
    *(_gait(*row, original=False) for row in _MORE_GAITS),
    *(_imitation3d(*terrain) for terrain in _SPATIAL_TERRAINS),
    # The original is blind on all of them.
    *(_imitation3d(*terrain[:3], False, terrain_map=True) for terrain in _SPATIAL_TERRAINS[1:]),
    _imitation3d('Track', 'plane', 'flat ground', True, target=True),
    _imitation3d('Run', 'plane', 'flat ground', False, clip='biped3d_run'),
    *_STEPS,
    _STEP2D,
    *_HIKES,
    *_JOURNEYS,
)  # fmt: skip

BY_ID: dict[str, Row] = {row.id: row for row in ROWS}
BY_TASK: dict[tuple[str, str], Row] = {(row.domain, row.task): row for row in ROWS}
ALIASES: dict[str, Row] = {
    alias: row for row in ROWS for alias in (*row.aliases, f'{row.domain}/{row.task}')
}


def find(id: str) -> Row:
    """Returns the row of an id or alias.

    Raises:
      ValueError: unknown id; the message has the closest matches.
    """
    row = BY_ID.get(id) or ALIASES.get(id)
    if row is None:
        raise ValueError(errors.unknown('environment', id, ALIASES if '/' in str(id) else BY_ID))
    return row
