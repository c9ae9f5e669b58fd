"""The sequences, and the budgets and seeds with which results are comparable."""

from __future__ import annotations

import dataclasses

from trl_suite.runs import Benchmark, Course
from trl_suite.sequences.metrics import metrics

BUDGETS = {'small': 100_000, 'full': 1_000_000}  # samples of each stage
SEEDS = (0, 1, 2)  # of the runs


@dataclasses.dataclass(frozen=True)
class Sequence(Course):
    """Two or more environments, each learnt in one stage; see `Course`.

    Raises:
      ValueError: an id is unknown (the message has the closest matches) or occurs twice, or there
        are fewer than two.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self) < 2:
            raise ValueError(
                f'sequence {self.name!r}: expected two or more environments; got '
                f'{", ".join(self.ids)}'
            )


# The order of PLAiD (Berseth et al. 2018), then the other terrains of the family.
_PLAID = ('Flat', 'Incline', 'Steps', 'Slopes', 'Gaps')
_MORE = ('Walls', 'Mixed', 'Slopes_Mixed')
# From single features on level ground to slopes, drops and rugged stairs.
_GAITS = ('Steps', 'Walls', 'Gaps', 'Mixed', 'Slopes', 'Slopes_Mixed', 'Cliffs', 'Stairs_Rugged')
_FAMILIES = (
    ('plaid', 'PD_{}_{}_Terrain-v0', _PLAID, 'tracks a clip over'),
    ('plaid_long', 'PD_{}_{}_Terrain-v0', _PLAID + _MORE, 'tracks a clip over'),
    ('gaits', 'FSM_{}_Terrain_{}-v0', _GAITS, 'sets the gait parameters of every cycle to cross'),
)

SEQUENCES: dict[str, Sequence] = {
    f'{family}_{character}': Sequence(
        f'{family}_{character}',
        tuple(id.format(f'{character.capitalize()}2D', terrain) for terrain in terrains),
        f'The {character} {words} {", ".join(terrains).lower()}.',
    )
    for family, id, terrains, words in _FAMILIES
    for character in ('biped', 'dog', 'raptor')
}

BENCHMARK = Benchmark(
    'trl_suite sequence 1', 'sequence', SEQUENCES, Sequence, BUDGETS, SEEDS,
    lambda course, scores, initial: metrics(scores, initial),
)  # fmt: skip
