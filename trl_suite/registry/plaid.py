"""PLAiD: one planar character, many terrains.

Source: the registry of Terrain RL Simulator (Berseth, Peng, van de Panne 2018).
"""

from __future__ import annotations

from trl_suite.registry.naming import GAITS, NAMES, status
from trl_suite.registry.spec import EnvSpec

SAMPLES = 50  # observed terrain heights, except in blind environments
CHARACTERS = {'biped2d_full': 'biped2d_full_walk', 'dog': 'dog_bound', 'raptor': 'raptor_run_050'}
# Name in ids, preset, words.
TERRAINS = (
    ('Flat', 'flat', 'flat ground'),
    ('Incline', 'inclines', 'a constant incline of about 10 degrees'),
    ('Steps', 'steps_humanoid', 'ascending steps of 5 to 15 cm'),
    ('Slopes', 'slopes_humanoid', 'rough rolling slopes'),
    ('Gaps', 'gaps_humanoid', 'gaps 25 to 30 cm wide'),
    ('Walls', 'walls_humanoid', 'walls 5 to 25 cm high'),
    ('Mixed', 'mixed_humanoid', 'a mix of gaps, walls and steps'),
    ('Slopes_Mixed', 'slopes_mixed_humanoid', 'gaps, walls and steps on rolling slopes'),
)


def _plaid(character: str, name: str, preset: str, words: str, blind: bool) -> EnvSpec:
    clip = CHARACTERS[character]
    id_ = f'PD_{NAMES[character]}_{name}{"" if blind else "_Terrain"}-v0'
    figure = NAMES[character][:-2].lower()
    view = 'without observing the terrain' if blind else 'observing 3 m of terrain ahead'
    return EnvSpec(
        id=id_,
        domain='plaid',
        task=f'{figure}_{name.lower()}{"_blind" if blind else ""}',
        character=character,
        actuation='position',
        terrain=preset,
        clip=clip,
        options={} if blind else {'terrain_observation': SAMPLES},
        description=f'The {figure} tracks a {GAITS[clip]} over {words}, {view}.',
        tags=frozenset({'planar', status(id_, True), *(['blind'] if blind else [])}),
    )


BLIND = (('biped2d_full', 0), ('biped2d_full', 1), ('dog', 0), ('raptor', 0))  # terrain by index

SPECS = (
    *(_plaid(character, *terrain, blind=False) for character in CHARACTERS for terrain in TERRAINS),
    *(_plaid(character, *TERRAINS[i], blind=True) for character, i in BLIND),
)
