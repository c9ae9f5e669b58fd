"""`python -m trl_suite`: the command line."""

import sys

from trl_suite import cli

if __name__ == '__main__':
    sys.exit(cli.main(prog='python -m trl_suite'))
