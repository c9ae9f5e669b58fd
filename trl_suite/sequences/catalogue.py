"""The sequences, and the budgets and seeds with which results are comparable."""

from __future__ import annotations

import dataclasses

import numpy as np

from trl_suite.registry import catalogue
from trl_suite.util import errors

FIRST_TEST_SEED = 2**31  # smaller seeds are for training
BUDGETS = {'small': 100_000, 'full': 1_000_000}  # samples of each stage
EPISODES = 32  # per test and task
SEEDS = (0, 1, 2)  # of the runs


@dataclasses.dataclass(frozen=True)
class Sequence:
    """Environments in the order in which they are learnt.

    Attributes:
      name: name in `SEQUENCES`, or a custom one.
      ids: ids of the T environments, without repeats; T >= 2.
      description: one line.

    Raises:
      ValueError: an id is unknown (the message has the closest matches) or occurs twice, or there
        are fewer than two.
    """

    name: str
    ids: tuple[str, ...]
    description: str = ''

    def __post_init__(self) -> None:
        object.__setattr__(self, 'ids', tuple(catalogue.find(id).id for id in self.ids))
        if len(self) < 2 or len(set(self.ids)) < len(self):
            raise ValueError(
                f'sequence {self.name!r}: expected two or more environments, each once; got '
                f'{", ".join(self.ids)}'
            )

    def __len__(self) -> int:
        return len(self.ids)


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
    f'{family}_{figure}': Sequence(
        f'{family}_{figure}',
        tuple(id.format(f'{figure.capitalize()}2D', terrain) for terrain in terrains),
        f'The {figure} {words} {", ".join(terrains).lower()}.',
    )
    for family, id, terrains, words in _FAMILIES
    for figure in ('biped', 'dog', 'raptor')
}


def get(name: str) -> Sequence:
    """Returns a sequence by its name in `SEQUENCES`.

    Raises:
      ValueError: an unknown name; the message has the closest matches.
    """
    errors.check_known('sequence', SEQUENCES, name)
    return SEQUENCES[name]


def train_seeds(count: int, seed: int | tuple[int, ...] = 0) -> list[int]:
    """Returns seeds for training, integers in [0, 2**31), for `VectorEnvironment`.

    Args:
      count: number of seeds.
      seed: seed from which these seeds are drawn, e.g. (run, stage).
    """
    drawn = np.random.SeedSequence(seed).generate_state(count, np.uint32)
    return (drawn % FIRST_TEST_SEED).tolist()


def test_seeds(count: int, seed: int | tuple[int, ...] = 0) -> list[int]:
    """Returns seeds for tests, integers in [2**31, 2**32), for `evaluation.evaluate`.

    The arguments are those of `train_seeds`.
    """
    return [FIRST_TEST_SEED + number for number in train_seeds(count, seed)]
