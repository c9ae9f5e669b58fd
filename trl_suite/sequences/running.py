"""Runs of learners on sequences."""

from __future__ import annotations

import contextlib
import os
import pathlib
import shutil
import time
from collections.abc import Callable, Iterator
from typing import Any, Protocol, runtime_checkable

import numpy as np
import tqdm

import trl_suite
from trl_suite import evaluation
from trl_suite.sequences import results
from trl_suite.sequences.catalogue import BUDGETS, EPISODES, Sequence, get, test_seeds
from trl_suite.sequences.metrics import metrics
from trl_suite.sequences.stage import Stage
from trl_suite.util import files, machine
from trl_suite.util.options import checked

SCORE = 'normalized_return'  # entry of an evaluation: the mean return over the step limit


@runtime_checkable
class Learner(Protocol):
    """The methods of a learner that `run` calls.

    `trl-suite sequences run` makes it as `Class(sequence, seed)`.
    """

    def train(self, stage: Stage) -> None:
        """Trains in `stage.environments(n)` with at most `stage.budget` samples."""

    def policy(self) -> Callable[[np.ndarray], np.ndarray]:
        """Returns the current policy: observations (n, k) -> actions (n, a), without noise.

        One policy is tested on all environments. Also called before the first `train`.
        """


@runtime_checkable
class Resumable(Protocol):
    """The methods of a learner that can resume an interrupted run."""

    def save(self, folder: pathlib.Path) -> None:
        """Writes the complete state of the learner into an empty folder."""

    def load(self, folder: pathlib.Path) -> None:
        """Restores the state that `save` wrote there."""


def scores(
    sequence: Sequence | str,
    policy: Callable[[np.ndarray], np.ndarray],
    episodes: int = EPISODES,
    seed: int = 0,
    num_threads: int = 0,
    executor: evaluation.Executor | None = None,
) -> list[float]:
    """Tests a policy on all environments.

    Args:
      sequence: the environments, or the name of a sequence.
      policy: observations (n, k) -> actions (n, a).
      episodes: episodes per environment; the same seed gives the same episodes.
      seed: seed from which the test seeds are drawn.
      num_threads: threads that step the physics; 0 uses all cores.
      executor: runs the episodes of all environments at the same time; see `evaluation.evaluate`.

    Returns:
      Mean return over the step limit for each environment, (T,).
    """
    sequence = get(sequence) if isinstance(sequence, str) else sequence
    seeds = test_seeds(episodes, seed)
    cases = [(id, policy) for id in sequence.ids]
    found = evaluation.evaluate_all(cases, episodes, seeds, num_threads, executor=executor)
    return [result[SCORE] for result in found]


def run(
    sequence: Sequence | str,
    learner: Learner,
    budget: int = BUDGETS['small'],
    path: str | os.PathLike[str] = 'result.json',
    episodes: int = EPISODES,
    seed: int = 0,
    num_threads: int = 0,
    progress: bool = False,
    stages: int | None = None,
    executor: evaluation.Executor | None = None,
) -> dict[str, Any]:
    """Trains a learner on one environment after the other; tests it on all before and after each.

    The result is written after every stage. If the file at `path` holds an unfinished result with
    the same settings, the run resumes after its last stage, provided that the learner is
    `Resumable`: its state is in a folder next to the result, with the same name and the suffix
    .stageN. A finished result is returned unchanged.

    Args:
      sequence: the environments, or the name of a sequence.
      learner: see `Learner`.
      budget: samples for each stage; `BUDGETS` has those of the benchmark.
      path: file of the result, .json.
      episodes: episodes per test and environment.
      seed: seed from which the seeds of training and tests are drawn.
      num_threads: threads that step the physics; 0 uses all cores.
      progress: show a progress bar.
      stages: end after this number of stages in total, which leaves an unfinished result to be
        resumed; None for all.
      executor: runs the episodes of tests, for example on the nodes of a cluster; see
        `evaluation.evaluate`. The learner stays in this process.

    Returns:
      The content of the file; `trl_suite.sequences.results` describes it.

    Raises:
      ValueError: invalid arguments, a result with other settings, or a learner that cannot resume.
      RuntimeError: another process writes this result.
      TypeError: the learner lacks a method.
      BudgetExceededError: the learner exceeds the budget; the result of the stage is not written.
      OSError: a file cannot be read or written.
    """
    sequence = get(sequence) if isinstance(sequence, str) else sequence
    budget = checked('budget', budget, int, at_least=1, at_most=2**53)
    episodes = checked('episodes', episodes, int, at_least=1, at_most=evaluation.MOST_EPISODES)
    seed = checked('seed', seed, int, at_least=0, at_most=2**53)
    stages = len(sequence) if stages is None else stages
    stages = checked('stages', stages, int, at_least=1, at_most=len(sequence))
    kind = type(learner)
    if not isinstance(learner, Learner):
        raise TypeError(f'learner is a {kind.__name__}; expected the methods train and policy')
    path = files.check_path(path, ('.json',))
    result: dict[str, Any] = {
        'format': results.FORMAT, 'trl_suite': trl_suite.__version__, **machine.made_with(),
        'learner': f'{kind.__module__}:{kind.__qualname__}', 'sequence': sequence.name,
        'ids': list(sequence.ids), 'budget': int(budget), 'episodes': int(episodes),
        'seed': int(seed), 'initial': [], **{name: [] for name in results.ROWS},
    }  # fmt: skip
    test = (episodes, seed, num_threads, executor)
    what = f'writes {path}; wait for it, or choose another path'
    with files.locked(path.with_name(f'.{path.name}.lock'), what):
        if path.exists():
            result = _resumed(path, result, learner)
        else:
            for number in range(1, len(sequence)):  # else a folder of the user would be removed
                if os.path.lexists(folder := _state(path, number)):
                    raise FileExistsError(f'{folder}: exists; remove it, or choose another result')
            result['initial'] = scores(sequence, learner.policy(), *test)
            _write(path, result)
        done = len(result['scores'])
        _forget(path, done)  # the run may have been killed before it did so
        with tqdm.tqdm(
            total=stages, initial=done, unit='stage', disable=None if progress else True
        ) as bar:
            for number in range(done, stages):
                stage = Stage(sequence, number, int(budget), int(seed), num_threads)
                bar.set_description(stage.id)
                begin = time.perf_counter()
                learner.train(stage)
                stage.finish()
                result['seconds'].append(round(time.perf_counter() - begin, 1))
                result['samples'].append(stage.samples.tolist())
                result['curves'].append(stage.curve())
                result['scores'].append(scores(sequence, learner.policy(), *test))
                if number == len(sequence) - 1:
                    result['metrics'] = metrics(result['scores'], result['initial'])
                elif isinstance(learner, Resumable):
                    with _folder(_state(path, number + 1)) as folder:
                        learner.save(folder)
                _write(path, result)  # this completes the stage
                _forget(path, number + 1)
                bar.update()
        return result


def _resumed(path: pathlib.Path, expected: dict[str, Any], learner: Learner) -> dict[str, Any]:
    """Returns the result so far, and restores the learner if the run has not ended."""
    result = results.read(path, complete=False)
    for name in (*results.SETTINGS, 'mujoco'):
        if result.get(name, expected[name]) != expected[name]:
            raise ValueError(
                f'{path} holds a run with another {name}: {result[name]}; expected {expected[name]}'
            )
    done, stages = len(result['scores']), len(expected['ids'])
    if 0 < done < stages:
        if not isinstance(learner, Resumable):
            raise ValueError(
                f'{path} holds {done} of {stages} stages, and a {type(learner).__name__} '
                'cannot resume: it has no methods save and load; remove the file to start again'
            )
        learner.load(_state(path, done))
    if done < stages and 'cpu' in result:
        result['cpu'] = ', '.join(dict.fromkeys([*result['cpu'].split(', '), expected['cpu']]))
    return result


def _state(path: pathlib.Path, done: int) -> pathlib.Path:
    return path.with_name(f'{path.stem}.stage{done}')


def _forget(path: pathlib.Path, done: int) -> None:
    """Removes the learner's states before the last of these stages, which are obsolete."""
    for earlier in range(1, done):
        shutil.rmtree(_state(path, earlier), ignore_errors=True)


@contextlib.contextmanager
def _folder(path: pathlib.Path) -> Iterator[pathlib.Path]:
    """Yields a temporary folder that replaces `path` if no exception is raised."""
    part = path.with_name(f'.{path.name}.{os.getpid()}.part')
    # A killed process with the same number, as in a restarted container, may have left one.
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir()
    try:
        yield part
        # Left by a run that was interrupted before it wrote its result.
        shutil.rmtree(path, ignore_errors=True)
        os.replace(part, path)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _write(path: pathlib.Path, result: dict[str, Any]) -> None:
    result['digest'] = results.digest(result)
    files.write_json(result, path)
