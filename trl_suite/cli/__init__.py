"""The command line; each module declares and runs its command, `trl_suite.cli.runs` two of them."""

from trl_suite.cli.main import main

__all__ = ['main']
