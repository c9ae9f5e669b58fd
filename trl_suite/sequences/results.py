"""Files of results: reading, writing and checking.

A result is a dict, written as JSON:

* 'format': `FORMAT`; 'trl_suite': version of the package; 'learner': module and class.
* 'mujoco': version of the engine; 'cpu': class of the processor, or of several, if the run was
  resumed on another. Results without these two are valid.
* The settings: 'sequence', 'ids' (T), 'budget' (samples per stage), 'episodes' (per test and task),
  'seed'.
* 'initial': scores before any training, (T,); 'scores': R, (T, T), one row per stage.
* 'samples': samples taken, (T, T): row i in stage i, column j in environment j.
* 'curves': learning curves, (T, `stage.POINTS`); see `Stage.curve`.
* 'seconds': duration of training, (T,).
* 'metrics': `metrics(scores, initial)`.
* 'digest': SHA-256 of everything else, against damage and edits by hand.

A score is the mean return over the step limit. The file of a run that has not ended has fewer rows
and no metrics.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Iterable, Mapping
from typing import Any

from trl_suite.sequences import stage
from trl_suite.sequences.catalogue import BUDGETS, EPISODES, SEEDS, SEQUENCES, Sequence
from trl_suite.sequences.metrics import metrics
from trl_suite.util import errors, files
from trl_suite.util.options import checked

FORMAT = 'trl_suite sequence 1'
SETTINGS: Mapping[str, tuple[Any, dict[str, float]]] = {  # with their types and bounds
    'learner': (str, {}), 'sequence': (str, {}), 'ids': (list[str], {}),
    'budget': (int, {'at_least': 1}), 'episodes': (int, {'at_least': 1}), 'seed': (int, {'at_least': 0}),
}  # fmt: skip
ROWS = ('scores', 'samples', 'curves', 'seconds')  # lists with one entry per stage
MADE_WITH = ('mujoco', 'cpu')
FIELDS = ('format', 'trl_suite', *SETTINGS, 'initial', *ROWS, 'digest')


def digest(result: dict[str, Any]) -> str:
    """Returns the SHA-256 of a result without its field 'digest', in hexadecimal digits."""
    content = {name: value for name, value in result.items() if name != 'digest'}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def read(path: str | os.PathLike[str], complete: bool = True) -> dict[str, Any]:
    """Reads and checks a result.

    Args:
      path: path of the file.
      complete: whether the run must have ended.

    Raises:
      ValueError: the file is not JSON, or a field is wrong; the message has the path, the field and
        what was expected.
      OSError: the file cannot be read.
    """
    result = files.read_json(files.existing(path, ('.json',)))
    try:
        check(result, complete)
    except ValueError as error:
        raise ValueError(f'{path}: {error}') from None
    return result


def check(result: Any, complete: bool = True) -> None:
    """Checks a result: fields, shapes, budget, metrics and digest.

    Args:
      result: content of a file.
      complete: whether the run must have ended.
    """
    if not isinstance(result, dict):
        raise ValueError(f'a {type(result).__name__}; expected an object with {", ".join(FIELDS)}')
    known = (*FIELDS, 'metrics', *MADE_WITH)
    errors.check_known('field', known, *result)
    for name in (*FIELDS, 'metrics') if complete else FIELDS:
        if name not in result:
            hint = '; the run has not ended' if name == 'metrics' else ''
            raise ValueError(f'{name} is missing{hint}')
    if result['format'] != FORMAT:
        raise ValueError(f'format is {result["format"]!r}; expected {FORMAT!r}')
    for name, (kind, bounds) in SETTINGS.items():
        checked(name, result[name], kind, **bounds)
    for name in MADE_WITH:
        checked(name, result.get(name, ''), str)
    name, ids = result['sequence'], tuple(result['ids'])
    sequence = SEQUENCES.get(name) or Sequence(name, ids)
    if ids != sequence.ids:
        raise ValueError(f'ids is {list(ids)}; expected {list(sequence.ids)}')
    _check_rows(result, len(sequence), complete)
    if 'metrics' in result:
        _check_metrics(result)
    if result['digest'] != digest(result):
        raise ValueError(
            f'digest is {result["digest"]!r}; expected {digest(result)!r}: the file was changed '
            'after the run'
        )


def _check_rows(result: dict[str, Any], tasks: int, complete: bool) -> None:
    """Checks numbers and shapes of everything that was measured."""
    _check_numbers('initial', result['initial'], tasks, at_most=1)
    stages = tasks if complete else min(len(result['scores']), tasks)
    for name in ROWS:
        if not isinstance(result[name], list) or len(result[name]) != stages:
            found = len(result[name]) if isinstance(result[name], list) else result[name]
            raise ValueError(f'{name}: {found} stages; expected {stages}')
    _check_numbers('seconds', result['seconds'], stages, at_least=0)
    for i in range(stages):
        _check_numbers(f'scores[{i}]', result['scores'][i], tasks, at_most=1)
        curve, kind = result['curves'][i], float | None  # with gaps
        _check_numbers(f'curves[{i}]', curve, stage.POINTS, kind, at_most=1)
        row = result['samples'][i]
        _check_numbers(f'samples[{i}]', row, tasks, at_least=0)
        if any(value != int(value) for value in row) or sum(row) > result['budget']:
            raise ValueError(
                f'samples[{i}] is {row}, in total {sum(row)}; expected whole numbers with a total of '
                f'at most {result["budget"]}, the budget'
            )


def _check_numbers(name: str, values: Any, count: int, kind: Any = float, **bounds: float) -> None:
    if not isinstance(values, list) or len(values) != count:
        found = f'{len(values)} entries' if isinstance(values, list) else repr(values)
        raise ValueError(f'{name}: {found}; expected {count} numbers')
    for i, value in enumerate(values):
        checked(f'{name}[{i}]', value, kind, **bounds)


def _check_metrics(result: dict[str, Any]) -> None:
    expected = metrics(result['scores'], result['initial'])
    found = result['metrics']
    if not isinstance(found, dict) or set(found) != set(expected):
        raise ValueError(f'metrics: expected {", ".join(expected)}')
    for name, value in expected.items():
        checked(f'metrics.{name}', found[name], float)
        if not math.isclose(found[name], value, abs_tol=1e-9):
            raise ValueError(
                f'metrics.{name} is {found[name]}; expected {value}, that of scores and initial'
            )


def departures(result: dict[str, Any]) -> list[str]:
    """Returns in which settings a result departs from the benchmark's; none if it is comparable."""
    allowed: dict[str, Iterable[Any]] = {
        'sequence': SEQUENCES, 'budget': BUDGETS.values(), 'episodes': (EPISODES,), 'seed': SEEDS,
    }  # fmt: skip
    return [
        f'{name} is {result[name]}, not {" or ".join(map(str, values))}'
        for name, values in allowed.items()
        if result[name] not in values
    ]
