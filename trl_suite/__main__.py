"""`python -m trl_suite` and `trl-suite`: the command line."""

import sys


def main(prog: str = 'trl-suite') -> int:
    """Runs the command line; an interrupt while it is imported ends in one line, too."""
    try:
        from trl_suite.util import interrupts

        with interrupts.postponed():
            from trl_suite import cli

        return cli.main(prog=prog)
    except KeyboardInterrupt:
        print('trl-suite: interrupted', file=sys.stderr)
        return 130


if __name__ == '__main__':
    sys.exit(main('python -m trl_suite'))
