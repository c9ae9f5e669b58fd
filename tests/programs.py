"""Shared by tests of programs: commands and scripts that run in this process, and their policies."""

import contextlib
import io
import itertools
import pathlib
import runpy
import sys
from unittest import mock

import numpy as np
from helpers import FolderTest

from trl_suite import cli, policies, suite
from trl_suite.util import program

EXAMPLES = pathlib.Path(__file__).resolve().parents[1] / 'examples'
GAPS = 'PD_Biped2D_Gaps_Terrain-v0'


def run(*arguments):
    """Runs a command; returns exit status, stdout and stderr."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            status = cli.main(arguments)
        except SystemExit as stop:  # argparse, after --help and --version
            status = stop.code
    return status, out.getvalue(), err.getvalue()


def output(function, *arguments):
    """Calls what a script does with arguments of the command line; returns what it prints."""
    with (
        contextlib.redirect_stdout(io.StringIO()) as out,
        contextlib.redirect_stderr(io.StringIO()),
        mock.patch.object(sys, 'argv', ['script', *map(str, arguments)]),
    ):
        function()
    return out.getvalue()


def run_example(name, *arguments):
    """Runs an example as a program in this process; returns what it printed."""
    with mock.patch.object(program, 'begin_script'):  # it is for processes of their own
        return output(
            lambda: runpy.run_path(str(EXAMPLES / f'{name}.py'), run_name='__main__'), *arguments
        )


class CommandTest(FolderTest):
    """A test of commands, in a temporary folder."""

    def setUp(self):
        super().setUp()
        self.enterContext(contextlib.chdir(self.folder))
        self.addCleanup(setattr, sys, 'path', list(sys.path))  # modules of learners are found there

    def output(self, *arguments):
        status, out, err = run(*arguments)
        self.assertEqual((status, err), (0, ''))
        return out

    def assert_refused(self, message, *arguments):
        status, out, err = run(*arguments)
        self.assertEqual((status, out), (2, ''))
        self.assertRegex(err, f'^trl-suite: error: [^\n]*{message}[^\n]*\n$')


def policy_for(id_, seed=0, scale=0.2, hidden=()):
    """Returns a policy with random weights that fits an environment."""
    task, rng = suite.build_task(suite.find(id_)), np.random.default_rng(seed)
    blocks = [(name, part.stop - part.start) for name, part in task.blocks.items()]
    sizes = [sum(size for _, size in blocks), *hidden, len(task.action_map)]
    return policies.Policy(
        id=id_, blocks=blocks, actions=task.action_map.names, quantity=task.action_map.quantity,
        mean=rng.normal(0, 0.1, sizes[0]), std=np.ones(sizes[0]), clip=5.0, activation='tanh',
        weights=[rng.normal(0, scale, shape) for shape in itertools.pairwise(sizes)],
        biases=[np.zeros(size) for size in sizes[1:]], log_std=np.zeros(sizes[-1]),
    )  # fmt: skip
