"""Tests of trl_suite.util.program, and of what signals must not interrupt."""

import ctypes
import signal
import sys
import time
from unittest import mock

from absl.testing import parameterized

from trl_suite import suite
from trl_suite.util import program


class SignalTest(parameterized.TestCase):
    @parameterized.product(
        signal_and_error=(
            (signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, program.Terminated),
        ),
        place=('destructor', 'conversion of ctypes'),
    )  # fmt: skip
    def test_a_signal_where_exceptions_are_lost_ends_the_program(self, signal_and_error, place):
        """Python ignores exceptions in destructors; ctypes replaces those of its conversions.

        Exceptions in destructors after the signal are not reported, either: an object may be half
        freed if the signal arrived in the destructor of another one.
        """
        number, error = signal_and_error

        class Signalling:
            def __del__(self):
                signal.raise_signal(number)

            @classmethod
            def from_param(cls, value):
                signal.raise_signal(number)

        class Failing:
            def __del__(self):
                raise RuntimeError('half freed')

        function = ctypes.PYFUNCTYPE(None, ctypes.py_object)(lambda value: None)
        function.argtypes = [Signalling]
        before = signal.getsignal(signal.SIGTERM)
        with (
            mock.patch.object(sys, 'unraisablehook') as report,
            self.assertRaises(KeyboardInterrupt) as caught,
            program.terminable(),
        ):
            Failing()
            report.assert_called_once()
            if place == 'destructor':
                Signalling()
                Failing()
                time.sleep(10)
            else:
                function(1)
        report.assert_called_once()
        self.assertIs(type(caught.exception), error)
        self.assertIs(signal.getsignal(signal.SIGTERM), before)
        if place != 'destructor':
            self.assertIsInstance(caught.exception.__cause__, ctypes.ArgumentError)

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


class MessageTest(parameterized.TestCase):
    @parameterized.parameters(
        ('a\nb  c', 'a b c'), ('\x1b]0;title\x07', r'\x1b]0;title\x07'), ('\u202egnp', r'\u202egnp'),
        ('\udce4 ä', r'\udce4 ä'), ('x' * 10**6, f'{"x" * 1000} ... {"x" * 1000}'),
    )  # fmt: skip
    def test_a_message_is_one_short_line_without_controls(self, message, line):
        self.assertEqual(program.in_one_line(ValueError(message)), line)
