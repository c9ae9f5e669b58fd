"""Runs of learners: training in stages, tests, and what a killed run needs to continue."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import os
import pathlib
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any, Protocol, runtime_checkable

import numpy as np
import tqdm

import trl_suite
from trl_suite import evaluation, policies
from trl_suite.runs import results
from trl_suite.runs.course import EPISODES, Course, test_seeds
from trl_suite.runs.stage import Stage
from trl_suite.util import errors, files, machine
from trl_suite.util.options import checked

SCORE = 'normalized_return'  # entry of an evaluation: the mean return over the step limit
MARK = '.trl_suite_state'  # file in the folder of a learner's state; other folders are not removed
TOLERANCE = 0.05  # of scores that are measured again on another class of CPU


@runtime_checkable
class Learner(Protocol):
    """The methods of a learner that a run calls; the command line makes it as `Class(course, seed)`."""

    def train(self, stage: Stage) -> None:
        """Trains in `stage.environments(n)` with at most `stage.budget` samples."""

    def policy(self) -> Callable[[np.ndarray], np.ndarray]:
        """Returns the current policy: observations (n, k) -> actions (n, a), without noise.

        One policy is tested on all environments. Also called before the first `train`. If it is a
        `policies.Policy`, the last one is stored beside the result.
        """


@runtime_checkable
class Resumable(Protocol):
    """The methods of a learner that can resume an interrupted run."""

    def save(self, folder: pathlib.Path) -> None:
        """Writes the complete state of the learner into an empty folder."""

    def load(self, folder: pathlib.Path) -> None:
        """Restores the state that `save` wrote there."""


@dataclasses.dataclass(frozen=True)
class Benchmark(results.Format):
    """Courses, and the budgets, seeds and metrics with which results are comparable."""

    def run(
        self,
        course: Course | str,
        learner: Learner,
        budget: int | None = None,
        path: str | os.PathLike[str] = 'result.json',
        episodes: int = EPISODES,
        seed: int = 0,
        num_threads: int = 0,
        progress: bool = False,
        stages: int | None = None,
        executor: evaluation.Executor | None = None,
    ) -> dict[str, Any]:
        """Trains a learner in stages, and tests it on all environments before and after each.

        The result is written after every stage. If the file at `path` holds an unfinished result
        with the same settings, the run resumes after its last stage, provided that the learner is
        `Resumable`: its state is in a folder next to the result, with the same name and the suffix
        .stageN. A finished result is returned unchanged.

        Args:
          course: what is learnt, or the name of a course of the benchmark.
          learner: see `Learner`.
          budget: samples for each environment; by default the smallest of `budgets`.
          path: file of the result, .json; the last policy, if it is a `policies.Policy`, is written
            to a file with the same name and the suffix .npz.
          episodes: episodes per test and environment.
          seed: seed from which the seeds of training and tests are drawn.
          num_threads: threads that step the physics; 0 uses all cores.
          progress: show a progress bar.
          stages: end after this number of stages in total, which leaves an unfinished result to be
            resumed; None for all.
          executor: runs the episodes of tests, for example on the nodes of a cluster; see
            `evaluation.evaluate`. The learner stays in this process.

        Returns:
          The content of the file; `trl_suite.runs.results` describes it.

        Raises:
          ValueError: invalid arguments, a result with other settings, or a learner that cannot
            resume.
          RuntimeError: another process writes this result.
          TypeError: the learner lacks a method.
          BudgetExceededError: the learner exceeds the budget; the result of the stage is not
            written.
          OSError: a file cannot be read or written.
        """
        course = self.get(course) if isinstance(course, str) else course
        budget = min(self.budgets.values()) if budget is None else budget
        budget = checked('budget', budget, int, at_least=course.parts, at_most=results.MOST_SAMPLES)
        episodes = checked('episodes', episodes, int, at_least=1, at_most=evaluation.MOST_EPISODES)
        seed = checked('seed', seed, int, at_least=0, at_most=results.LARGEST_SEED)
        if self.courses.get(course.name, course) != course:
            raise ValueError(
                f'{course.name!r} is a {self.field} of the benchmark with other contents; expected '
                'another name'
            )
        if course.name not in self.courses:
            found = self.custom(course.name, course.ids)
            for name in ('parts', 'step_limit'):  # which results do not hold
                if getattr(course, name) != (expected := getattr(found, name)):
                    raise ValueError(
                        f'{course.name!r} has {name}={getattr(course, name)}; expected {expected}'
                    )
        course.check_alike()
        count = len(course.stages)
        stages = checked(
            'stages', count if stages is None else stages, int, at_least=1, at_most=count
        )
        kind = type(learner)
        if isinstance(learner, type) or not isinstance(learner, Learner):
            raise TypeError(
                f'learner is {learner!r}; expected an object with methods train and policy'
            )
        if stages < count and not isinstance(learner, Resumable):
            raise ValueError(
                f'stages is {stages}; expected {count}, since a {kind.__name__} cannot resume: it has no '
                'methods save and load'
            )
        path = files.check_path(path, ('.json',))
        result: dict[str, Any] = {
            'format': self.format, 'trl_suite': trl_suite.__version__, **machine.made_with(),
            'learner': f'{kind.__module__}:{kind.__qualname__}', self.field: course.name,
            'ids': list(course.ids), 'budget': int(budget), 'episodes': int(episodes),
            'seed': int(seed), 'initial': [], **{name: [] for name in results.ROWS},
        }  # fmt: skip

        def tested(policy: Callable[[np.ndarray], np.ndarray]) -> list[float]:
            found = self._tested(course, policy, episodes, seed, num_threads, executor)
            if executor is not None and 'cpu' in result:  # it may have tested on other processors
                result['cpu'] = _joined(result['cpu'], *(each['cpu'] for each in found))
            return [each[SCORE] for each in found]

        what = f'writes {path}; wait for it, or choose another path'
        with files.locked(path.with_name(f'.{path.name}.lock'), what):
            if path.exists():
                result = self._resumed(path, result, learner, count)
                done = len(result['scores'])
                if progress and done >= stages:
                    note = f'{path} holds {done} of {count} stages; remove it to run again'
                    print(note, file=sys.stderr)
            else:
                # Else a folder or a policy of the user would be removed.
                for own in (path.with_suffix('.npz'), *(_state(path, n) for n in range(1, count))):
                    if os.path.lexists(own):
                        raise FileExistsError(f'{own}: exists; remove it, or choose another result')
                result['initial'] = tested(learner.policy())
                _write(path, result)
            done = len(result['scores'])
            _forget(path, done)  # the run may have been killed before it did so
            with tqdm.tqdm(
                total=stages, initial=done, unit='stage', disable=None if progress else True
            ) as bar:
                for number in range(done, stages):
                    left = course.left(number, budget, result['samples'])
                    stage = Stage(course, number, left, int(seed), num_threads)
                    bar.set_description(stage.id)
                    begin = time.perf_counter()
                    learner.train(stage)
                    stage.finish()
                    result['seconds'].append(round(time.perf_counter() - begin, 1))
                    result['samples'].append(stage.samples.tolist())
                    result['curves'].append(stage.curve())
                    policy = learner.policy()
                    result['scores'].append(tested(policy))
                    if number == count - 1:
                        if isinstance(policy, policies.Policy):
                            policies.save(policy, path.with_suffix('.npz'))
                            result['policy'] = _sha256(path.with_suffix('.npz'))
                        result['metrics'] = self.measured(
                            course, result['scores'], result['initial']
                        )
                    elif isinstance(learner, Resumable):
                        with _folder(_state(path, number + 1)) as folder:
                            learner.save(folder)
                    _write(path, result)  # this completes the stage
                    _forget(path, number + 1)
                    bar.update()
            return result

    def scores(
        self,
        course: Course | str,
        policy: Callable[[np.ndarray], np.ndarray],
        episodes: int = EPISODES,
        seed: int = 0,
        num_threads: int = 0,
        executor: evaluation.Executor | None = None,
    ) -> list[float]:
        """Tests a policy on all environments.

        Args:
          course: the environments, or the name of a course of the benchmark.
          policy: observations (n, k) -> actions (n, a).
          episodes: episodes per environment; the same seed gives the same episodes.
          seed: seed from which the test seeds are drawn.
          num_threads: threads that step the physics; 0 uses all cores.
          executor: runs the episodes of all environments at the same time; see `evaluation.evaluate`.

        Returns:
          Mean return over the step limit for each environment, (T,).

        Raises:
          ValueError: invalid numbers.
        """
        course = self.get(course) if isinstance(course, str) else course
        found = self._tested(course, policy, episodes, seed, num_threads, executor)
        return [each[SCORE] for each in found]

    def _tested(
        self,
        course: Course,
        policy: Callable[[np.ndarray], np.ndarray],
        episodes: int,
        seed: int,
        num_threads: int,
        executor: evaluation.Executor | None,
    ) -> list[dict[str, Any]]:
        """Returns the results of `evaluation.evaluate` for each environment; see `scores`."""
        seed = checked('seed', seed, int, at_least=0, at_most=results.LARGEST_SEED)
        seeds = test_seeds(episodes, seed)
        cases = [(course.spec(id), policy) for id in course.ids]
        return evaluation.evaluate_all(cases, episodes, seeds, num_threads, executor=executor)

    def verify(
        self, path: str | os.PathLike[str], num_threads: int = 0
    ) -> tuple[dict[str, Any], float]:
        """Checks a result, and repeats its last test with the policy beside it.

        Args:
          path: file of the result, .json; the policy has the same name and the suffix .npz.
          num_threads: threads that step the physics; 0 uses all cores.

        Returns:
          The result, and by how much scores were allowed to differ: 0, or `TOLERANCE` if it was made
          with another version of MuJoCo or on another class of CPU.

        Raises:
          ValueError: the result or the policy is invalid, there is no policy, or its scores differ by
            more than that.
          OSError: a file cannot be read.
        """
        result, path = self.read(path), pathlib.Path(path)
        if 'policy' not in result:
            raise ValueError(
                f'{path}: has no policy; expected a run of a learner whose policy() is a policies.Policy'
            )
        stored = files.existing(path.with_suffix('.npz'))
        if result['policy'] != (found := _sha256(stored)):
            raise ValueError(
                f'{path}: policy is {result["policy"]!r}; expected {found!r}, the SHA-256 of '
                f'{stored.name}: one of the two was changed after the run'
            )
        course = self.course_of(result)
        policy = policies.load(stored)
        with errors.naming(path):
            again = self.scores(course, policy, result['episodes'], result['seed'], num_threads)
        same = all(result.get(name) == value for name, value in machine.made_with().items())
        allowed = 0.0 if same else TOLERANCE
        if not np.allclose(again, result['scores'][-1], rtol=0, atol=allowed):
            raise ValueError(
                f'{path}: scores[-1] is {result["scores"][-1]}; measured {again}; expected '
                + (f'a difference of at most {allowed}' if allowed else 'no difference')
            )
        return result, allowed

    def _resumed(
        self, path: pathlib.Path, expected: dict[str, Any], learner: Learner, stages: int
    ) -> dict[str, Any]:
        """Returns the result so far, and restores the learner if the run has not ended."""
        result = self.read(path, complete=False)
        unfinished = len(result['scores']) < stages
        for name in (*self.settings, *(('mujoco', 'trl_suite') if unfinished else ())):
            if result.get(name, expected[name]) != expected[name]:
                raise ValueError(
                    f'{path} holds another run: {name} is {result[name]}; expected {expected[name]}'
                )
        done = len(result['scores'])
        if 0 < done < stages:
            if not isinstance(learner, Resumable):
                raise ValueError(
                    f'{path} holds {done} of {stages} stages, and a {type(learner).__name__} '
                    'cannot resume: it has no methods save and load; remove the file to start again'
                )
            state = _state(path, done)
            if not state.is_dir():
                raise FileNotFoundError(
                    f"{state}: there is no such folder, the learner's state after {done} stages; "
                    f'remove {path} to start again'
                )
            learner.load(state)
        if done < stages and 'cpu' in result:
            result['cpu'] = _joined(result['cpu'], expected['cpu'])
        return result


def _joined(*cpus: str) -> str:
    """Returns all classes of CPU that are in these lists."""
    return ', '.join(dict.fromkeys(cpu for each in cpus for cpu in each.split(', ')))


def _sha256(path: pathlib.Path) -> str:
    return hashlib.sha256(files.read_bytes(path)).hexdigest()


def _state(path: pathlib.Path, done: int) -> pathlib.Path:
    return path.with_name(f'{path.stem}.stage{done}')


def _forget(path: pathlib.Path, done: int) -> None:
    """Removes the learner's states before the last of these stages, which are obsolete."""
    for earlier in range(1, done):
        _remove(_state(path, earlier))


def _remove(folder: pathlib.Path) -> None:
    """Removes a learner's state, and no other folder."""
    if (folder / MARK).is_file():
        files.remove_folder(folder)


@contextlib.contextmanager
def _folder(path: pathlib.Path) -> Iterator[pathlib.Path]:
    """Yields a temporary folder that replaces `path` if no exception is raised."""
    with files.folder_beside(path) as outer:
        part = pathlib.Path(outer, path.name)
        part.mkdir()
        yield part
        (part / MARK).touch()
        _remove(path)  # left by a run that was interrupted before it wrote its result
        os.replace(part, path)


def _write(path: pathlib.Path, result: dict[str, Any]) -> None:
    result['digest'] = results.digest(result)
    files.write_json(result, path)
