"""What a learner learns in a run, and the seeds of training and tests."""

from __future__ import annotations

import dataclasses

import numpy as np

from trl_suite.registry import catalogue
from trl_suite.registry.spec import EnvSpec

FIRST_TEST_SEED = 2**31  # smaller seeds are for training
EPISODES = 32  # per test and environment


@dataclasses.dataclass(frozen=True)
class Course:
    """Environments in the order in which they are learnt.

    Attributes:
      name: a name.
      ids: ids of the T environments, without repeats.
      description: one line.
      parts: number of stages in which each is learnt; what a stage leaves of its samples, the next
        one of the same environment may take.
      step_limit: control steps after which an episode is truncated; by default those of the ids.

    Raises:
      ValueError: an id is unknown (the message has the closest matches) or occurs twice.
    """

    name: str
    ids: tuple[str, ...]
    description: str = ''
    parts: int = 1
    step_limit: int | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, 'ids', tuple(catalogue.find(id).id for id in self.ids))
        if len(set(self.ids)) < len(self.ids):
            raise ValueError(
                f'{self.name!r}: expected environments, each once; got {", ".join(self.ids)}'
            )

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def stages(self) -> tuple[str, ...]:
        """The id that is learnt in each stage."""
        return tuple(id for id in self.ids for _ in range(self.parts))

    def spec(self, id: str) -> EnvSpec:
        """Returns the spec of one of the environments, with the step limit of this course."""
        spec = catalogue.find(id)
        return dataclasses.replace(spec, step_limit=self.step_limit or spec.step_limit)

    def left(self, number: int, budget: int, samples: list[list[int]]) -> int:
        """Returns how many samples may be taken in a stage.

        Args:
          number: of the stage.
          budget: samples for each environment.
          samples: those taken in the stages before, (number, T).
        """
        first = number - number % self.parts
        taken = sum(sum(row) for row in samples[first:number])
        return budget * (number - first + 1) // self.parts - taken


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
