"""Sequences of environments as benchmarks for multi-task and continual learning.

    from trl_suite import sequences

    sequence = sequences.get('plaid_biped')
    result = sequences.run(sequence, learner, budget=200_000, path='result.json')
    print(sequences.forgetting(result['scores']))

A learner is trained on the environments one after the other and is scored on all of them after
each. All environments of a sequence have the same observation and action spaces, so that one
network fits all of them. For multi-task learning, train on `sequence.ids` in any order and call
`scores`.

Seeds below 2**31 are for training, the others, below 2**32, for tests: `train_seeds` and
`test_seeds` never overlap. The 128-bit seed of an episode's terrain is drawn from the random stream
of its environment's seed, so that different seeds give different terrain. `run` tests with test
seeds; a learner should train with `VectorEnvironment(id, n, seed=train_seeds(n, seed))`.

The metrics take a matrix R, where R[i, j] is the score on task j after training on tasks 0 to i.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import pathlib
import shutil
from collections.abc import Callable, Iterator
from typing import Any, Protocol, runtime_checkable

import numpy as np
import tqdm
from numpy.typing import ArrayLike

import trl_suite
from trl_suite import evaluation
from trl_suite.registry import catalogue
from trl_suite.util import errors, files

FIRST_TEST_SEED = 2**31  # smaller seeds are for training
EPISODES = 32  # per test and task
SCORE = 'normalized_return'  # entry of an evaluation: the mean return over the step limit
_SETTINGS = ('sequence', 'ids', 'budget', 'episodes', 'seed')  # must be equal to resume a run


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
    if name not in SEQUENCES:
        raise ValueError(errors.unknown('sequence', name, SEQUENCES))
    return SEQUENCES[name]


def train_seeds(count: int, seed: int | tuple[int, ...] = 0) -> list[int]:
    """Returns seeds for training, integers in [0, 2**31), for `VectorEnvironment`.

    Args:
      count: number of seeds.
      seed: seed from which these seeds are drawn, e.g. (run, stage).
    """
    return [number % FIRST_TEST_SEED for number in _drawn(count, seed)]


def test_seeds(count: int, seed: int | tuple[int, ...] = 0) -> list[int]:
    """Returns seeds for tests, integers in [2**31, 2**32), for `evaluation.evaluate`.

    The arguments are those of `train_seeds`.
    """
    return [FIRST_TEST_SEED + number for number in train_seeds(count, seed)]


def _drawn(count: int, seed: int | tuple[int, ...]) -> list[int]:
    return np.random.SeedSequence(seed).generate_state(count, np.uint32).tolist()


# Metrics


def average_performance(scores: ArrayLike) -> float:
    """Mean score over all tasks after the last stage (Lopez-Paz & Ranzato 2017, ACC).

    All metrics take `scores` in this form and raise the same errors.

    Args:
      scores: R, (T, T); entries that a metric does not use may be NaN.

    Raises:
      ValueError: R is not square, has fewer than two tasks, or an entry that is used is not finite.
    """
    return _mean(_matrix(scores)[-1])


def backward_transfer(scores: ArrayLike) -> float:
    """Effect of learning later tasks on earlier ones (Lopez-Paz & Ranzato 2017, BWT).

    Negative values mean forgetting. The mean over j < T - 1 of R[T-1, j] - R[j, j].
    """
    found = _matrix(scores)
    return _mean((found[-1] - np.diag(found))[:-1])


def forward_transfer(scores: ArrayLike, initial: ArrayLike) -> float:
    """Effect of earlier tasks on a task not yet learnt (Lopez-Paz & Ranzato 2017, FWT).

    The mean over j > 0 of R[j-1, j] - initial[j].

    Args:
      scores: R.
      initial: scores before any training, (T,).
    """
    found, begin = _matrix(scores), np.asarray(initial, float)
    if begin.shape != found.shape[:1]:
        raise ValueError(f'initial: shape is {begin.shape}; expected {found.shape[:1]}')
    return _mean(np.diag(found, 1) - begin[1:])


def forgetting(scores: ArrayLike) -> float:
    """Mean drop of the final score below the best earlier one (Chaudhry et al. 2018).

    The mean over j < T - 1 of (max over i < T - 1 of R[i, j]) - R[T-1, j]; usually >= 0.
    """
    found = _matrix(scores)
    return _mean((found[:-1].max(0) - found[-1])[:-1])


def metrics(scores: ArrayLike, initial: ArrayLike) -> dict[str, float]:
    """Returns all metrics by name; the functions above define them.

    Lopez-Paz & Ranzato: Gradient Episodic Memory for Continual Learning. NeurIPS 2017. Chaudhry,
    Dokania, Ajanthan & Torr: Riemannian Walk for Incremental Learning. ECCV 2018.
    """
    return {
        'average_performance': average_performance(scores),
        'forgetting': forgetting(scores),
        'backward_transfer': backward_transfer(scores),
        'forward_transfer': forward_transfer(scores, initial),
    }


def _matrix(scores: ArrayLike) -> np.ndarray:
    found = np.asarray(scores, float)
    if found.ndim != 2 or found.shape[0] != found.shape[1] or len(found) < 2:
        raise ValueError(f'scores: shape is {found.shape}; expected (T, T) with T >= 2')
    return found


def _mean(values: np.ndarray) -> float:
    if not np.isfinite(values).all():
        raise ValueError(f'scores: the metric uses an entry that is not finite: {values.tolist()}')
    return float(values.mean())


# Runs


class Learner(Protocol):
    """The methods of a learner that `run` calls."""

    def learn(self, environment: str, budget: int) -> None:
        """Continues training, in the environment of this id, for `budget` control steps."""

    def policy(self, environment: str) -> Callable[[np.ndarray], np.ndarray]:
        """Returns the current policy: observations (n, k) -> actions (n, a), without noise.

        Also called before the first `learn`. A learner that should not know which task is tested
        must ignore `environment`.
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
    learner: Learner,
    episodes: int = EPISODES,
    seed: int = 0,
    num_threads: int = 0,
    executor: evaluation.Executor | None = None,
) -> list[float]:
    """Tests the current policy of a learner on all tasks.

    Args:
      sequence: the tasks, or the name of a sequence.
      learner: the learner; see `Learner`.
      episodes: episodes per task; the same seed gives the same episodes.
      seed: seed from which the test seeds are drawn.
      num_threads: threads that step the physics; 0 uses all cores.
      executor: runs the episodes of all tasks at the same time; see `evaluation.evaluate`.

    Returns:
      Mean return over the step limit for each task, (T,).
    """
    sequence = get(sequence) if isinstance(sequence, str) else sequence
    seeds = test_seeds(episodes, seed)
    cases = [(id, learner.policy(id)) for id in sequence.ids]
    found = evaluation.evaluate_all(cases, episodes, seeds, num_threads, executor=executor)
    return [result[SCORE] for result in found]


def run(
    sequence: Sequence | str,
    learner: Learner,
    budget: int,
    path: str | os.PathLike[str],
    episodes: int = EPISODES,
    seed: int = 0,
    num_threads: int = 0,
    progress: bool = False,
    executor: evaluation.Executor | None = None,
) -> dict[str, Any]:
    """Trains a learner on one environment after the other; tests it on all before and after each.

    The result is written after every stage. If the file at `path` holds an unfinished result with
    the same settings, the run resumes after its last stage, provided that the learner is
    `Resumable`: its state is in a folder next to the result, with the same name and the suffix
    .stageN. A finished result is returned unchanged.

    Args:
      sequence: the tasks, or the name of a sequence.
      learner: see `Learner`.
      budget: control steps for each task.
      path: file of the result, .json.
      episodes: episodes per test and task.
      seed: seed from which the test seeds are drawn.
      num_threads: threads that step the physics in tests; 0 uses all cores.
      progress: show a progress bar.
      executor: runs the episodes of tests, for example on the nodes of a cluster; see
        `evaluation.evaluate`. The learner stays in this process.

    Returns:
      The content of the file: the settings 'sequence', 'ids', 'budget', 'episodes', 'seed'; the
      version 'trl_suite'; 'initial', scores before any training (T,); 'scores', the rows of R
      so far, one per stage; and after the last stage 'metrics'.

    Raises:
      ValueError: invalid arguments, a result with other settings, or a learner that cannot resume.
      OSError: a file cannot be read or written.
    """
    sequence = get(sequence) if isinstance(sequence, str) else sequence
    for name, value in (('budget', budget), ('episodes', episodes)):
        if int(value) != value or value < 1:
            raise ValueError(f'{name} is {value}; expected a positive integer')
    path = files.check_path(path, ('.json',))
    settings = (sequence.name, list(sequence.ids), int(budget), int(episodes), int(seed))
    result: dict[str, Any] = dict(zip(_SETTINGS, settings, strict=True))
    result |= {'trl_suite': trl_suite.__version__, 'initial': [], 'scores': []}
    if path.exists():
        result = _read(path, result)
        done = len(result['scores'])
        if 0 < done < len(sequence):
            if not isinstance(learner, Resumable):
                raise ValueError(
                    f'{path} holds {done} of {len(sequence)} stages, and a {type(learner).__name__} '
                    'cannot resume: it has no methods save and load; remove the file to start again'
                )
            learner.load(_stage(path, done))
    test = (episodes, seed, num_threads, executor)
    with tqdm.tqdm(
        total=len(sequence),
        initial=len(result['scores']),
        unit='stage',
        disable=None if progress else True,
    ) as bar:
        if not result['initial']:
            result['initial'] = scores(sequence, learner, *test)
            _write(path, result)
        for id in sequence.ids[len(result['scores']) :]:
            bar.set_description(id)
            learner.learn(id, int(budget))
            result['scores'].append(scores(sequence, learner, *test))
            done = len(result['scores'])
            if done == len(sequence):
                result['metrics'] = metrics(result['scores'], result['initial'])
            elif isinstance(learner, Resumable):
                with _folder(_stage(path, done)) as folder:
                    learner.save(folder)
            _write(
                path, result
            )  # this completes the stage; the state of the one before is obsolete
            shutil.rmtree(_stage(path, done - 1), ignore_errors=True)
            bar.update()
    return result


def _stage(path: pathlib.Path, done: int) -> pathlib.Path:
    return path.with_name(f'{path.stem}.stage{done}')


@contextlib.contextmanager
def _folder(path: pathlib.Path) -> Iterator[pathlib.Path]:
    """Yields a temporary folder that replaces `path` if no exception is raised."""
    part = path.with_name(f'.{path.name}.{os.getpid()}.part')
    part.mkdir()
    try:
        yield part
        shutil.rmtree(
            path, ignore_errors=True
        )  # left by a run interrupted before it wrote its result
        os.replace(part, path)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _write(path: pathlib.Path, result: dict[str, Any]) -> None:
    with files.replacing(path) as part:
        part.write_text(f'{json.dumps(result, indent=1, allow_nan=False)}\n', encoding='utf-8')


def _read(path: pathlib.Path, expected: dict[str, Any]) -> dict[str, Any]:
    try:
        result = json.loads(path.read_text(encoding='utf-8'))
        tasks = len(expected['ids'])
        whole = all(len(row) == tasks for row in result['scores'])
        whole &= len(result['initial']) in (0, tasks) and len(result['scores']) <= tasks
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f'{path}: not a result of sequences.run ({error!r})') from None
    for name in _SETTINGS:
        if result.get(name) != expected[name]:
            raise ValueError(
                f'{path} holds a run with another {name}: {result.get(name)}; expected '
                f'{expected[name]}'
            )
    if not whole:
        raise ValueError(f'{path}: the shape of initial or scores does not fit {tasks} tasks')
    return result
