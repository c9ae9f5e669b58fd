"""Tests of trl_suite.util.program, and of what signals must not interrupt."""

import signal
import time
from unittest import mock

from absl.testing import absltest, parameterized

from trl_suite import suite
from trl_suite.util import program


class SignalTest(parameterized.TestCase):
    @parameterized.parameters(
        (signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, program.Terminated)
    )
    def test_a_signal_in_a_destructor_ends_the_program(self, number, exception):
        """Python ignores exceptions in destructors."""

        class Signalling:
            def __del__(self):
                signal.raise_signal(number)

        before = signal.getsignal(signal.SIGTERM)
        with self.assertRaises(KeyboardInterrupt) as caught, program.terminable():
            Signalling()
            time.sleep(10)
        self.assertIs(type(caught.exception), exception)
        self.assertIs(signal.getsignal(signal.SIGTERM), before)

    def test_closing_an_environment_is_not_interrupted(self):
        """A rendering context that is half freed would be freed again, which prints a traceback."""
        environment = suite.make('PD_Biped2D_Gaps_Terrain-v0')
        environment.reset()
        freed = []

        def free():
            signal.raise_signal(signal.SIGINT)
            freed.append(True)

        with (
            mock.patch.object(environment.physics, 'free', free),
            self.assertRaises(KeyboardInterrupt),
        ):
            environment.close()
        self.assertEqual(freed, [True])


if __name__ == '__main__':
    absltest.main()
