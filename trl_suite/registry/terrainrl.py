"""TerrainRL: planar characters, controlled by gait state machines, on random terrain.

Source: the registry of Terrain RL Simulator (Berseth, Peng, van de Panne 2018).
"""

from __future__ import annotations

from trl_suite.registry.naming import NAMES
from trl_suite.registry.spec import EnvSpec

# Cycles: 5 to 10 km, several times the mean distance of any shipped policy before a fall.
STEP_LIMIT = 5000

# Name in ids, preset, words.
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
_ON_ALL_TERRAINS = ('biped2d_simbicon', 'dog', 'raptor', 'hopper')
_MORE_GAITS = (
    ('dog', 'Narrow_Gaps', 'narrow_gaps', 'clusters of narrow gaps'),
    ('dog', 'Tight_Gaps', 'tight_gaps', 'clusters of closely spaced gaps'),
    ('dog', 'Slopes_Gaps', 'slopes_gaps0', 'gaps on rolling slopes'),
    ('dog', 'Slopes_Steps', 'slopes_steps', 'steps on rolling slopes'),
    ('dog', 'Slopes_Walls', 'slopes_walls', 'walls on rolling slopes'),
    ('raptor', 'Narrow_Gaps', 'narrow_gaps', 'clusters of narrow gaps'),
    ('raptor', 'Mixed_Raptor', 'mixed_raptor', 'gaps, walls and steps scaled to its size'),
    ('goat', 'Variable_Steps', 'cliffs_rugged', 'rugged stairs'),
    ('goat', 'Cliffs', 'cliffs_humanoid', 'drops'),
    ('hopper', 'Gaps_Easy', 'gaps_hopper', 'gaps scaled to its size'),
    ('hopper', 'Mixed_Easy', 'mixed_hopper', 'gaps, walls and steps scaled to its size'),
)


def _gait(character: str, name: str, preset: str, words: str, origin: str) -> EnvSpec:
    figure = NAMES[character]
    return EnvSpec(
        id=f'FSM_{figure}_Terrain_{name}-v0',
        domain='terrainrl',
        task=f'{figure[:-2].lower()}_{name.lower()}',
        character=character,
        actuation='gait',
        terrain=preset,
        task_type='gait',
        description=f'The {figure[:-2].lower()} crosses {words}; an action sets the gait parameters of a cycle.',
        tags=frozenset({'planar', origin}),
        step_limit=STEP_LIMIT,
    )


SPECS = (
    *(
        _gait(character, *terrain, 'original')
        for character in _ON_ALL_TERRAINS
        for terrain in _GAIT_TERRAINS
    ),
    *(_gait(*each, 'completion') for each in _MORE_GAITS),
)
