"""Saved states: values with a signature and a checksum, restored whole or refused whole."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np

import trl_suite
from trl_suite.tasks.task import Task
from trl_suite.util import machine
from trl_suite.util.digest import digest

Signature = dict[str, tuple[str, str]]

_NONE = 'none', '-'
_LABELS = ('name', 'description', 'notes', 'differences', 'path', 'xml', 'assets')
# Fields of MjModel that pictures and names need, but not the physics.
_LOOKS = (
    'cam_', 'geom_matid', 'geom_rgba', 'light_', 'mat_', 'mesh_normal', 'mesh_texcoord', 'name',
    'paths', 'site_matid', 'site_rgba', 'skin_', 'tendon_matid', 'tendon_rgba', 'tex_', 'text_',
)  # fmt: skip
_FIELDS = {
    kind: [
        name for name in dir(kind)
        if not name.startswith(('_', *_LOOKS)) and not callable(getattr(kind, name))
    ]
    for kind in (mujoco.MjModel, mujoco.MjOption)
}  # fmt: skip


def signature(task: Task, kind: str) -> Signature:
    """Returns what states of an environment are signed with: label and digest of each part.

    The digests are those of contents, not of names, so that a state is refused by an environment
    with another ground, clip or character of the same name. It is called before the first reset,
    which changes the model.

    Args:
      task: the task, bound to a world.
      kind: of the environment, since each has states of its own.
    """
    versions = f'{kind} of trl_suite {trl_suite.__version__} with MuJoCo {mujoco.__version__}'
    # The label names the class of CPU, on which a continuation is exact; on others it is valid, too.
    parts = {'environment': (f'{versions} on {machine.cpu_class()}', versions), **task.made_of}
    for component in task.components:
        parts |= component.made_of
    found = {name: (label, digest(part, _LABELS)) for name, (label, part) in parts.items()}
    model = task.world.models[0]
    fields = [getattr(of, name) for of in (model, model.opt) for name in _FIELDS[type(of)]]
    # In single precision, since compilers may round in another way on another type of processor.
    numbers = [np.ravel(each) for each in fields if isinstance(each, (int, float, np.ndarray))]
    single = np.concatenate(numbers, dtype=np.float32, casting='unsafe')
    return {**found, 'model': (f'{model.nq} positions, {model.nu} controls', digest(single))}


def seal(state: Mapping[str, Any]) -> dict[str, Any]:
    """Returns a state with the checksum of its contents, which `check` compares.

    Whoever edits a state and seals it again answers for it: its numbers are not checked, and wrong
    ones can end the process.
    """
    content = {name: value for name, value in state.items() if name != 'checksum'}
    return {**content, 'checksum': digest(content)}


def check(state: Any, own: Signature) -> None:
    """Checks that a saved state is what an environment like this one returned.

    Args:
      state: the state.
      own: the signature of this environment.

    Raises:
      TypeError: the state is not a mapping.
      ValueError: it belongs to another environment; the message names the parts that differ. Or its
        contents were changed.
    """
    if not isinstance(state, Mapping):
        raise TypeError(f'a state is a dict from get_state, not {type(state).__name__}')
    difference = differences(state.get('made_for'), own)
    if difference:
        raise ValueError(f'the state belongs to another environment: {difference}')
    if seal(state)['checksum'] != str(state.get('checksum')):
        raise ValueError(
            'the state was changed or damaged after get_state returned it: its checksum differs'
        )


def differences(found: Any, own: Signature) -> str:
    """Returns in words which parts of two signatures differ; '' if none does."""
    if not isinstance(found, Mapping):
        return 'it has no signature'
    words = []
    for name in {**own, **found}:
        (label, code), theirs = own.get(name, _NONE), found.get(name)
        if not isinstance(theirs, (list, tuple)) or len(theirs) != 2:
            theirs = _NONE
        if theirs[1] != code:
            words.append(f'{name} {theirs[0]} [{theirs[1]}] instead of {label} [{code}]')
    return '; '.join(words)
