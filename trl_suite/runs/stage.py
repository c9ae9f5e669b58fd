"""What a learner may use in one stage: simulations that count their samples."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Mapping
from collections.abc import Sequence as Numbers
from typing import Any

import numpy as np

from trl_suite.environments.arguments import Ids, given_ids, unique_ids
from trl_suite.environments.vector import MOST_ENVS, Step, VectorEnvironment
from trl_suite.registry import catalogue
from trl_suite.registry.spec import EnvSpec
from trl_suite.runs.course import FIRST_TEST_SEED, Course, train_seeds
from trl_suite.util import errors
from trl_suite.util.options import checked

POINTS = 20  # of a learning curve


class BudgetExceededError(RuntimeError):
    """A step was refused, since it would exceed the budget of its stage or comes after its end."""


class Stage:
    """One stage of a run.

    A sample is one control step of one simulation. A vector step of n simulations takes n samples,
    also of simulations that it only resets (`autoreset='next_step'`); resets are free.

    Attributes:
      id: the environment to be learnt.
      ids: all environments of the run, in order.
      number: 0 to S - 1, where S is the number of stages.
      count: S.
      budget: samples that may be taken, in all environments together.
      seed: seed of the run.
      samples: samples taken so far in each environment, (T,) int.
    """

    def __init__(
        self, course: Course, number: int, budget: int, seed: int = 0, num_threads: int = 0
    ) -> None:
        self.ids, self.number, self.id = course.ids, number, course.stages[number]
        self.count, self.budget, self.seed = len(course.stages), budget, seed
        self.samples = np.zeros(len(course), int)
        self._course, self._num_threads = course, num_threads
        self._made = itertools.count()
        self._over = False
        self._counting = threading.Lock()  # environments of a stage may run in several threads
        self._returns: list[tuple[int, float]] = []  # samples at the end of an episode, and score

    @property
    def left(self) -> int:
        """Samples that may still be taken."""
        return self.budget - int(self.samples.sum())

    def environments(
        self, num_envs: int, id: str | None = None, **options: Any
    ) -> VectorEnvironment:
        """Makes simulations with training seeds.

        Every call draws other seeds; they depend on the seed of the run, the stage and the number
        of the call.

        Args:
          num_envs: number of simulations.
          id: id or alias of an environment of the run; by default the one to be learnt. Which others a
            learner has used, and how much, is part of its result.
          options: further arguments of `VectorEnvironment`, such as `autoreset`.

        Returns:
          An environment whose `step` raises `BudgetExceededError`, without effect, if it would exceed
          the budget, and which refuses seeds for tests.

        Raises:
          ValueError: an environment that is not in the run, or invalid options.
        """
        id = self.id if id is None else catalogue.find(id).id
        errors.check_known('environment of the run', self.ids, id)
        if 'seed' in options:
            raise ValueError('seed: expected none, since the stage draws it from that of the run')
        num_envs = checked('num_envs', num_envs, int, at_least=1, at_most=MOST_ENVS)
        seeds = train_seeds(num_envs, (self.seed, self.number, next(self._made)))
        options = {'num_threads': self._num_threads, **options}
        return _Counted(
            self, self.ids.index(id), self._course.spec(id), num_envs, seed=seeds, **options
        )

    def spend(self, task: int, count: int) -> None:
        """Counts samples in an environment.

        Raises:
          BudgetExceededError: more than are left, or after the end of the stage; none are counted.
        """
        with self._counting:
            if self._over:
                raise BudgetExceededError(
                    f'stage {self.number} ({self.id}) has ended; expected steps in train only'
                )
            if count > self.left:
                raise BudgetExceededError(
                    f'stage {self.number} ({self.id}): {count} more samples; expected at most '
                    f'{self.left}, since {self.budget - self.left} of {self.budget} are taken'
                )
            self.samples[task] += count

    def refund(self, task: int, count: int) -> None:
        """Takes back what `spend` has counted, of a step that failed."""
        with self._counting:
            self.samples[task] -= count

    def finish(self) -> None:
        """Ends the stage: its simulations refuse further steps."""
        self._over = True

    def record(self, task: int, returns: np.ndarray) -> None:
        """Records the scores of episodes of the environment to be learnt, (k,); NaN is unknown."""
        if self.ids[task] == self.id:
            now = int(self.samples.sum())
            self._returns += [(now, float(each)) for each in returns if not np.isnan(each)]

    def curve(self) -> list[float | None]:
        """Returns the learning curve: scores of training episodes, with exploration noise.

        `POINTS` numbers, the mean over episodes that ended in each part of the budget, None where
        none did. Only episodes of the environment to be learnt count, and of these only those with a
        step limit that were not continued from a state of `get_state`.
        """
        parts: list[list[float]] = [[] for _ in range(POINTS)]
        for samples, score in self._returns:
            parts[min(POINTS * (samples - 1) // self.budget, POINTS - 1)].append(score)
        return [float(np.mean(part)) if part else None for part in parts]


class _Counted(VectorEnvironment):
    """Simulations whose steps a stage counts."""

    def __init__(
        self, stage: Stage, task: int, spec: EnvSpec, num_envs: int, **options: Any
    ) -> None:
        self._stage, self._number = stage, task
        self.sums = np.zeros(num_envs)  # of the rewards of each episode so far
        super().__init__(spec, num_envs, **options)

    def step(self, action: np.ndarray, env_ids: Ids = None) -> Step:
        asked = self.num_envs if env_ids is None else len(unique_ids(env_ids, self.num_envs))
        self._stage.spend(self._number, asked)
        try:
            step = super().step(action, env_ids)
        except BaseException:
            self._stage.refund(self._number, asked)
            raise
        self.sums += step.reward
        ended = step.terminated | step.truncated
        if ended.any():
            self._stage.record(self._number, self.sums[ended] / (self.step_limit or np.nan))
            self.sums[ended] = 0
        return step

    def reset(self, env_ids: Ids = None, seed: Any = None, level: Any = None) -> Any:
        observation = super().reset(env_ids, seed, level)
        self.sums[unique_ids(env_ids, self.num_envs)] = 0
        return observation

    def seed(self, seed: int | Numbers[int] | None, env_ids: Ids = None) -> None:
        """Reseeds as `VectorEnvironment.seed`; one seed for all gives `train_seeds`.

        Raises:
          ValueError: None, or a seed for tests.
        """
        if seed is None:
            raise ValueError('seed is None; expected seeds, so that the run can be repeated')
        kind = Numbers[int] if np.ndim(seed) else int
        seeds = checked('seed', seed, kind, at_least=0)
        _check_training(seeds)
        super().seed(seeds if np.ndim(seed) else train_seeds(self.num_envs, seeds), env_ids)

    def set_state(self, state: dict[str, Any], env_ids: Ids = None) -> None:
        """Restores a state as `VectorEnvironment.set_state`.

        Raises:
          ValueError: a simulation of the state has a seed for tests.
        """
        _check_training(state.get('seeds', ()) if isinstance(state, Mapping) else ())
        super().set_state(state, env_ids)
        self.sums[unique_ids(env_ids, self.num_envs)] = np.nan

    def copy_from(
        self, other: VectorEnvironment, other_ids: Numbers[int], env_ids: Numbers[int]
    ) -> None:
        """Copies states as `VectorEnvironment.copy_from`.

        Raises:
          ValueError: a simulation that is copied has a seed for tests.
        """
        if isinstance(other, VectorEnvironment):  # others are refused below
            _check_training(other.seeds[given_ids(other_ids, other.num_envs)])
        super().copy_from(other, other_ids, env_ids)
        ids, sources = given_ids(env_ids, self.num_envs), given_ids(other_ids, other.num_envs)
        self.sums[ids] = other.sums[sources] if isinstance(other, _Counted) else np.nan


def _check_training(seeds: Any) -> None:
    """Raises ValueError if one of the seeds is for tests."""
    largest = np.max(seeds, initial=0)
    if largest >= FIRST_TEST_SEED:
        raise ValueError(
            f'seed {largest} is for tests; expected training seeds, below {FIRST_TEST_SEED}'
        )
