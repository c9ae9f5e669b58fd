"""What all trainings share: command line, checkpoints with a check of their integrity, files of results.

A checkpoint is a line that names the format, a line with the SHA-256 of the rest, and the output of
`torch.save`. It is read with `weights_only`, so that loading a file cannot run code: it may contain
dicts, lists, tuples, numbers, strings, tensors and arrays.
"""

from __future__ import annotations

import argparse
import codecs
import contextlib
import dataclasses
import hashlib
import io
import pathlib
import platform
import re
from collections.abc import Collection, Iterator, Mapping
from typing import Any

import numpy as np
import torch

from trl_suite import suite
from trl_suite.util import files, resources
from trl_suite.util.machine import cores
from trl_suite.util.options import checked

# In the folder of a run; an interrupted one may have only some of them.
WRITTEN = 'checkpoint.pt', 'curve.json', 'policy.npz', 'first', 'run_1', 'log.txt', '.lock'
TEST_SEED = 0  # of published results
EVALUATION_SEED = 2**31  # of learning curves; used neither for training nor for published results
# Of files with results: one line, since they have long lists; settings may be infinite.
FORM: dict[str, Any] = {'indent': None, 'allow_nan': True}
FORMAT = b'trl_suite checkpoint 1\n'
LARGEST = 2**32  # bytes
# Globals in pickled arrays; `bytes` in empty ones.
ARRAYS = [
    np.ndarray, np.dtype, np._core.multiarray._reconstruct, np._core.multiarray.scalar, codecs.encode,
    bytes,
    *(type(np.dtype(kind)) for kind in '?bhilqBHILQefd'),
]  # fmt: skip


def command_line(
    description: str, sample: str, further: Mapping[str, Mapping[str, Any]] | None = None
) -> tuple[str, int, dict[str, Any], pathlib.Path, int]:
    """Parses the command line of a training program.

    Args:
      description: description of the program.
      sample: what its samples are.
      further: further settings, and keyword arguments of `argparse.ArgumentParser.add_argument`.

    Returns:
      Id, seed, settings other than the defaults, folder and threads.
    """
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument('id', metavar='ID', help="id of an environment, or 'domain/task'")
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--threads', type=int, default=0, help='0: all cores')
    parser.add_argument('--output', type=pathlib.Path, default=pathlib.Path('runs'))
    parser.add_argument('--samples', type=float, help=f'{sample}, instead of the default')
    for name, keywords in (further or {}).items():
        parser.add_argument(f'--{name}', **keywords)
    chosen = parser.parse_args()
    id_ = suite.find(chosen.id).id
    checked('--seed', chosen.seed, int, at_least=0)
    checked('--samples', chosen.samples, float | None, above=0)
    given = {name: getattr(chosen, name) for name in ('samples', *(further or ()))}
    changes = {name: value for name, value in given.items() if value is not None}
    return id_, chosen.seed, changes, chosen.output / id_ / f'seed_{chosen.seed}', chosen.threads


def check_seeds(option: str, *seeds: int) -> None:
    """Refuses to train with seeds of evaluations, which draw the same starts and terrains."""
    checked(option, list(seeds), list[int], at_least=0, at_most=EVALUATION_SEED - 1)
    if TEST_SEED in seeds:
        raise ValueError(f'{option}: {TEST_SEED} is the seed of the tests; choose another')


def passed(before: float, now: float, every: float) -> bool:
    """Returns whether a multiple of `every` has been reached since `before`."""
    return now // every > before // every


# Files of a run.


def write_curve(
    folder: pathlib.Path, id_: str, seed: int, settings: Any, threads: int, curve: list[Any],
    **more: Any,
) -> None:  # fmt: skip
    """Writes `curve.json`: the learning curve of a run, its settings, a dataclass, and `more`."""
    record = {
        'id': id_, 'seed': seed, **more, 'settings': dataclasses.asdict(settings),
        'threads': threads, 'curve': curve,
    }  # fmt: skip
    files.write_json(record, folder / 'curve.json', allow_nan=True)  # settings may be infinite


def save(state: dict[str, Any], path: pathlib.Path) -> None:
    """Writes a checkpoint; an old one is replaced only when the new one is complete."""
    content = io.BytesIO()
    torch.save(state, content)
    data = content.getbuffer()
    with files.replacing(path) as part, part.open('wb') as file:
        file.write(FORMAT)
        file.write(hashlib.sha256(data).hexdigest().encode() + b'\n')
        file.write(data)


def load(path: pathlib.Path) -> dict[str, Any]:
    """Returns the state in a checkpoint.

    Raises:
      ValueError: the file is too large or damaged, has another format, or contains other objects;
        the message has its path.
    """
    file = io.BytesIO(files.read_bytes(path, LARGEST))
    known = file.readline(len(FORMAT)) == FORMAT
    digest, data = file.readline(66).strip(), file.read()
    remedy = 'remove it to start again'
    if not known:
        raise ValueError(
            f'{path}: not a checkpoint of this version (or its beginning is damaged); {remedy}'
        )
    if hashlib.sha256(data).hexdigest().encode() != digest:
        raise ValueError(f'{path}: the checkpoint is damaged or incomplete; {remedy}')
    try:
        with torch.serialization.safe_globals(ARRAYS):
            return torch.load(io.BytesIO(data), weights_only=True)
    except Exception as error:  # torch's message suggests to trust the file
        other = re.search(r'GLOBAL (\S+)', str(error))
        raise ValueError(
            f'{path}: the checkpoint contains {other[1] if other else "other objects"}; '
            f'expected arrays, numbers and strings; {remedy}'
        ) from None


def load_run(
    folder: pathlib.Path, settings: Any, changeable: Collection[str] = ()
) -> dict[str, Any]:
    """Returns the state in the checkpoint of a run.

    Args:
      folder: of the run; the file is `checkpoint.pt`.
      settings: settings with which the run continues, a dataclass.
      changeable: names of settings that may differ from those in the checkpoint.

    Raises:
      ValueError: as `load`, or the checkpoint has other settings.
    """
    state, own = load(folder / 'checkpoint.pt'), dataclasses.asdict(settings)
    found = {**state['settings'], **{name: own[name] for name in changeable}}
    if found != own:
        others = ', '.join(different(found, own))
        raise ValueError(
            f'{folder} holds a run with other settings: {others}; give another --output, or remove it'
        )
    return state


def different(found: Mapping[str, Any], asked: Mapping[str, Any], owner: str = '') -> Iterator[str]:
    """Yields in which settings, also those of a setting, a run differs from what is asked."""
    for name in dict.fromkeys((*found, *asked)):
        one, other = found.get(name), asked.get(name)
        if isinstance(one, Mapping) and isinstance(other, Mapping):
            yield from different(one, other, f'{owner}{name}.')
        elif one != other:
            yield f'{owner}{name} is {one!r}, not {other!r}'


@contextlib.contextmanager
def only_run(folder: pathlib.Path) -> Iterator[None]:
    """Creates a folder, and locks it against other runs until this run ends or its process dies.

    Raises:
      RuntimeError: another process trains in the folder; the message has its id.
    """
    folder.mkdir(parents=True, exist_ok=True)
    what = f'trains in {folder}; wait for it, or give another --output'
    with files.locked(folder / '.lock', what):
        yield


def remove(folder: pathlib.Path) -> None:
    """Removes the folder of a run.

    Raises:
      FileExistsError: it has files, but none that a run writes.
      RuntimeError: another process trains there; see `only_run`.
    """
    if not folder.exists():
        return
    if any(folder.iterdir()) and not any((folder / name).exists() for name in WRITTEN):
        raise FileExistsError(f'{folder}: is not the folder of a run; remove it, or choose another')
    with only_run(folder):
        files.remove_folder(folder)


# Results in `trained/`, or in the folder TRL_SUITE_TRAINED.


def machine() -> str:
    """Returns a description of this machine for results."""
    return f'{cores()} cores, {platform.machine()}, {platform.system()}'


def place(name: str) -> pathlib.Path:
    """Returns the path of a file with results."""
    return resources.directory('trained') / name


def read(name: str) -> dict[str, Any]:
    """Returns the content of a .json file with results, {} if there is none."""
    path = place(name)
    return files.read_json(path) if path.exists() else {}


def write(name: str, content: Any) -> None:
    """Writes a .json file with results."""
    place(name).parent.mkdir(parents=True, exist_ok=True)
    files.write_json(content, place(name), **FORM)


def changing(name: str) -> contextlib.AbstractContextManager[dict[str, Any]]:
    """Yields the content of a .json file with results, to be changed; see `files.changing`."""
    return files.changing(place(name), **FORM)


def add(name: str, id_: str, key: str, value: Any) -> None:
    """Adds a result of an environment to a .json file."""
    with changing(name) as content:
        content.setdefault(id_, {})[key] = value


def enter(name: str, key: str, value: Any) -> None:
    """Enters a result into a .json file, whose keys are sorted."""
    with changing(name) as content:
        found = sorted({**content, key: value}.items())
        content.clear()
        content.update(found)
