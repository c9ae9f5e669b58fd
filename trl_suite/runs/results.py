"""Files of results: reading and checking.

A result is a dict, written as JSON:

* 'format': the benchmark and its version; 'trl_suite': version of the package; 'learner': module
  and class.
* 'mujoco': version of the engine; 'cpu': class of CPU, or of several, if the run was
  resumed on another. 'policy': SHA-256 of the file of the last policy, if the learner's `policy()`
  is a `policies.Policy`. Results without these three are valid.
* The settings: name of the `Course`, 'ids' (T), 'budget' (samples per environment), 'episodes' (per
  test and environment), 'seed'.
* 'initial': scores before any training, (T,); 'scores': R, (S, T), one row per stage.
* 'samples': samples taken, (S, T): row i in stage i, column j in environment j.
* 'curves': learning curves, (S, `stage.POINTS`); see `Stage.curve`.
* 'seconds': duration of training, (S,).
* 'metrics': those of the benchmark.
* 'digest': SHA-256 of everything else, against damage and edits by hand.

A score is the mean return over the step limit. The file of a run that has not ended has fewer rows
and no metrics.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import os
import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from trl_suite import evaluation
from trl_suite.registry import catalogue
from trl_suite.runs import stage
from trl_suite.runs.course import EPISODES, Course
from trl_suite.util import errors, files
from trl_suite.util.options import checked

ROWS = ('scores', 'samples', 'curves', 'seconds')  # lists with one entry per stage
MADE_WITH = ('mujoco', 'cpu')
MOST_SAMPLES = LARGEST_SEED = 2**53  # whole numbers that JSON's readers agree on
LEARNER = re.compile(r'[\w.]+:(\w+(\.<locals>)?\.)*\w+')  # module and class, as Python names them


def digest(result: dict[str, Any]) -> str:
    """Returns the SHA-256 of a result without its field 'digest', in hexadecimal digits."""
    content = {name: value for name, value in result.items() if name != 'digest'}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


@dataclasses.dataclass(frozen=True)
class Format:
    """Result files of a benchmark, and the settings with which they are comparable.

    Attributes:
      format: content of the field 'format'; another version has another one.
      field: field with the name of the course.
      courses: the courses of the benchmark, by name.
      custom: makes a course that is not among them from its name and ids; may raise a ValueError.
      budgets: samples per environment, by name.
      seeds: of the runs.
      measured: computes the metrics of a course from 'scores' and 'initial'.
    """

    format: str
    field: str
    courses: Mapping[str, Course]
    custom: Callable[[str, tuple[str, ...]], Course]
    budgets: Mapping[str, int]
    seeds: tuple[int, ...]
    measured: Callable[[Course, list[list[float]], list[float]], dict[str, float]]

    @property
    def settings(self) -> dict[str, tuple[Any, dict[str, float]]]:
        """The fields of settings, with their types and bounds."""
        return {
            'learner': (str, {}), self.field: (str, {}), 'ids': (list[str], {}),
            'budget': (int, {'at_least': 1, 'at_most': MOST_SAMPLES}),
            'episodes': (int, {'at_least': 1, 'at_most': evaluation.MOST_EPISODES}),
            'seed': (int, {'at_least': 0, 'at_most': LARGEST_SEED}),
        }  # fmt: skip

    @property
    def fields(self) -> tuple[str, ...]:
        """The fields that every result has."""
        return ('format', 'trl_suite', *self.settings, 'initial', *ROWS, 'digest')

    def get(self, name: str) -> Course:
        """Returns a course of the benchmark by its name; one with the name of an id also by its aliases.

        Raises:
          ValueError: an unknown name; the message has the closest matches.
        """
        if name in catalogue.ALIASES:
            name = catalogue.ALIASES[name].id
        errors.check_known(f'{self.field} of the benchmark', self.courses, name)
        return self.courses[name]

    def course_of(self, result: dict[str, Any]) -> Course:
        """Returns what was learnt in the run of a result."""
        name = result[self.field]
        return self.courses.get(name) or self.custom(name, tuple(result['ids']))

    def read(self, path: str | os.PathLike[str], complete: bool = True) -> dict[str, Any]:
        """Reads and checks a result.

        Args:
          path: path of the file.
          complete: whether the run must have ended.

        Raises:
          ValueError: the file is not JSON, or a field is wrong; the message has the path, the field
            and what was expected.
          OSError: the file cannot be read.
        """
        result = files.read_json(files.existing(path, ('.json',)))
        with errors.naming(path):
            self.check(result, complete)
        return result

    def check(self, result: Any, complete: bool = True) -> None:
        """Checks a result: fields, shapes, budget, metrics and digest.

        Args:
          result: content of a file.
          complete: whether the run must have ended.
        """
        if not isinstance(result, dict):
            expected = ', '.join(self.fields)
            raise ValueError(f'a {type(result).__name__}; expected an object with {expected}')
        if result.get('format', self.format) != self.format:  # others may have other fields
            raise ValueError(f'format is {result["format"]!r}; expected {self.format!r}')
        optional = (*MADE_WITH, 'policy')
        errors.check_known('field', (*self.fields, 'metrics', *optional), *result)
        for name in (*self.fields, 'metrics') if complete else self.fields:
            if name not in result:
                hint = '; the run has not ended' if name == 'metrics' else ''
                raise ValueError(f'{name} is missing{hint}')
        for name, (kind, bounds) in self.settings.items():
            checked(name, result[name], kind, **bounds)
        for name in ('trl_suite', *optional):
            checked(name, result.get(name, ''), str)
        if not LEARNER.fullmatch(result['learner']):
            raise ValueError(f'learner is {result["learner"]!r}; expected module:Class')
        course = self.course_of(result)
        if result['ids'] != list(course.ids):
            raise ValueError(f'ids is {result["ids"]}; expected {list(course.ids)}')
        _check_rows(result, course, complete)
        if 'metrics' in result:
            _check_metrics(
                result['metrics'], self.measured(course, result['scores'], result['initial'])
            )
        if result['digest'] != digest(result):
            raise ValueError(
                f'digest is {result["digest"]!r}; expected {digest(result)!r}: the file was changed '
                'after the run'
            )

    def departures(self, result: dict[str, Any]) -> list[str]:
        """Returns in which settings a result departs from the benchmark's; none if it is comparable."""
        allowed: dict[str, Iterable[Any]] = {
            self.field: self.courses, 'budget': self.budgets.values(), 'episodes': (EPISODES,),
            'seed': self.seeds,
        }  # fmt: skip
        return [
            f'{name} is {result[name]}, not {" or ".join(map(str, values))}'
            for name, values in allowed.items()
            if result[name] not in values
        ]


def _check_rows(result: dict[str, Any], course: Course, complete: bool) -> None:
    """Checks numbers and shapes of everything that was measured."""
    tasks, stages = len(course), len(course.stages)
    _check_numbers('initial', result['initial'], tasks, at_most=1)
    if not complete and 'metrics' not in result and isinstance(result['scores'], list):
        stages = min(len(result['scores']), stages)
    for name in ROWS:
        if not isinstance(result[name], list) or len(result[name]) != stages:
            found = len(result[name]) if isinstance(result[name], list) else result[name]
            raise ValueError(f'{name}: {found} stages; expected {stages}')
    _check_numbers('seconds', result['seconds'], stages, at_least=0)
    for i in range(stages):
        _check_numbers(f'scores[{i}]', result['scores'][i], tasks, at_most=1)
        curve, kind = result['curves'][i], float | None  # with gaps
        # Returns of training may have other terms of reward than those of tests.
        _check_numbers(f'curves[{i}]', curve, stage.POINTS, kind)
        row = result['samples'][i]
        _check_numbers(f'samples[{i}]', row, tasks, at_least=0)
        left = course.left(i, result['budget'], result['samples'])
        if any(value != int(value) for value in row) or sum(row) > left:
            raise ValueError(
                f'samples[{i}] is {row}, in total {sum(row)}; expected whole numbers with a total of '
                f'at most {left}, the budget'
            )


def _check_numbers(name: str, values: Any, count: int, kind: Any = float, **bounds: float) -> None:
    if not isinstance(values, list) or len(values) != count:
        found = f'{len(values)} entries' if isinstance(values, list) else repr(values)
        raise ValueError(f'{name}: {found}; expected {count} numbers')
    for i, value in enumerate(values):
        checked(f'{name}[{i}]', value, kind, **bounds)


def _check_metrics(found: Any, expected: dict[str, float]) -> None:
    if not isinstance(found, dict) or set(found) != set(expected):
        raise ValueError(f'metrics: expected {", ".join(expected)}')
    for name, value in expected.items():
        checked(f'metrics.{name}', found[name], float)
        if not math.isclose(found[name], value, abs_tol=1e-9):
            raise ValueError(
                f'metrics.{name} is {found[name]}; expected {value}, that of scores and initial'
            )
