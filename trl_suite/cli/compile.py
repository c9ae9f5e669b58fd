"""`trl-suite compile`: compiles environments, for images of containers and for clusters."""

from __future__ import annotations

import argparse
import time
from typing import TYPE_CHECKING, Any

import numpy as np

from trl_suite.cli import engine
from trl_suite.cli.arguments import add_command
from trl_suite.registry import catalogue
from trl_suite.util import compiled

if TYPE_CHECKING:
    from trl_suite.environments.environment import Environment
    from trl_suite.environments.vector import VectorEnvironment


def declare(commands: Any) -> None:
    """Declares the command and its arguments."""
    text = 'compile environments, so that their first steps need not wait'
    command = add_command(commands, 'compile', text, run)
    command.add_argument('ids', metavar='ID', nargs='*', help="ids, or 'domain/task'")
    command.add_argument('--all', action='store_true', help='all environments of the catalogue')


def run(arguments: argparse.Namespace) -> None:
    """Takes a step in each environment, alone and in a vector; what that needs is compiled and kept."""
    if arguments.all == bool(arguments.ids):
        raise ValueError('expected ids, or --all (see trl-suite compile --help)')
    suite = engine.load()
    import tqdm  # a dependency of dm_control

    from trl_suite.environments.vector import VectorEnvironment

    specs = catalogue.SPECS if arguments.all else [suite.find(id_) for id_ in arguments.ids]
    folder, begin = compiled.cache_folder(), time.perf_counter()
    if folder is None:
        raise RuntimeError('there is no folder in which compiled code can be kept')
    if compiled.AS_PYTHON:
        raise RuntimeError('NUMBA_DISABLE_JIT is set, so that nothing is compiled; unset it')
    for spec in (bar := tqdm.tqdm(specs, unit='environment', disable=None)):
        bar.set_description(spec.id)
        made: tuple[Environment | VectorEnvironment, ...] = (
            suite.build_environment(spec, {'random': 0}, {}),
            VectorEnvironment(spec, 2, 1, seed=0),
        )
        for environment, shape in zip(made, ((), (2,)), strict=True):
            environment.reset()
            environment.step(np.zeros((*shape, len(environment.action_map))))
            world = environment.task.world
            world.forward(world.all_ids)  # as when a ground moves, which few steps do
            environment.close()
    count = f'{len(specs)} environment{"" if len(specs) == 1 else "s"}'
    print(f'{count} compiled in {time.perf_counter() - begin:.0f} s; the code is in {folder}')
