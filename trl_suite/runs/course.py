"""What a learner learns in a run, and the seeds of training and tests."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import numpy as np

from trl_suite.registry import catalogue
from trl_suite.registry.build import build_task
from trl_suite.registry.spec import EnvSpec
from trl_suite.util.options import checked

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
      ValueError: an id is unknown (the message has the closest matches) or occurs twice, or the name
        is no string.
    """

    name: str
    ids: tuple[str, ...]
    description: str = ''
    parts: int = 1
    step_limit: int | None = None

    def __post_init__(self) -> None:
        checked('name', self.name, str)
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

    def check_alike(self) -> None:
        """Checks that one network fits all environments.

        Raises:
          ValueError: one has other blocks of observations or other actions than the first.
        """
        for id in self.ids[1:]:
            if _layout(id) != _layout(self.ids[0]):
                raise ValueError(
                    f'{self.name!r}: {id} has other observations or actions than {self.ids[0]}; '
                    'expected environments that one network fits'
                )

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


@functools.cache
def _layout(id: str) -> tuple[Any, ...]:
    """Returns the blocks of observations and the names of actions of an environment."""
    task = build_task(catalogue.find(id))
    return list(task.blocks.items()), list(task.action_map.names)


def train_seeds(count: int, seed: int | tuple[int, ...] = 0) -> list[int]:
    """Returns seeds for training, integers in [0, 2**31), for `VectorEnvironment`.

    Args:
      count: number of seeds.
      seed: seed from which these seeds are drawn, e.g. (run, stage).
    """
    count = checked('count', count, int, at_least=0, at_most=2**32)
    drawn = np.random.SeedSequence(seed).generate_state(count, np.uint32)
    return (drawn % FIRST_TEST_SEED).tolist()


def test_seeds(count: int, seed: int | tuple[int, ...] = 0) -> list[int]:
    """Returns seeds for tests, integers in [2**31, 2**32), for `evaluation.evaluate`.

    The arguments are those of `train_seeds`.
    """
    return [FIRST_TEST_SEED + number for number in train_seeds(count, seed)]
