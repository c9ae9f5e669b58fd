"""The command line: `trl-suite NAME` is the function `run` of the module `trl_suite.cli.NAME`."""

from trl_suite.cli.main import main

__all__ = ['main']
