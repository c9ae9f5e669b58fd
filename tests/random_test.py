"""Tests of random numbers drawn by compiled functions."""

import numpy as np
from absl.testing import absltest, parameterized

from trl_suite.util import random


class DrawTest(parameterized.TestCase):
    """From NumPy's generators, whatever their bits come from."""

    @parameterized.parameters('PCG64', 'PCG64DXSM', 'MT19937', 'Philox', 'SFC64')
    def test_draws_go_on_where_those_of_the_generator_end(self, name):
        one, other = (np.random.Generator(getattr(np.random, name)(3)) for _ in range(2))
        bits = random.address(one)
        for _ in range(3):
            found = [random.draw(bits) for _ in range(700)]
            np.testing.assert_array_equal(found, other.random(700))
            self.assertEqual(one.standard_normal(), other.standard_normal())
            self.assertEqual(one.integers(100), other.integers(100))


if __name__ == '__main__':
    absltest.main()
