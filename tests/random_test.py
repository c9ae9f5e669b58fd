"""Random numbers in compiled functions are those of NumPy."""

import numpy as np
from absl.testing import parameterized

from trl_suite.util import random
from trl_suite.util.compiled import compiled

COUNT = 100_000  # a normal number is in the tail of the ziggurat once in 3700


@compiled
def fill_random(i, state, out):
    for k in range(len(out)):
        out[k] = random.random(i, state)


@compiled
def fill_uniform(i, low, high, state, out):
    for k in range(len(out)):
        out[k] = random.uniform(i, low, high, state)


@compiled
def fill_normal(i, state, out):
    for k in range(len(out)):
        out[k] = random.standard_normal(i, state)


def seeded(*seeds):
    state = np.zeros((len(seeds), 6), np.uint64)
    for i, seed in enumerate(seeds):
        random.seed_stream(i, np.random.SeedSequence(seed), state)
    return state


class StreamsTest(parameterized.TestCase):
    """Streams against `numpy.random.Generator`."""

    @parameterized.parameters(0, 7, 2**63, [[1, 2, 3]])
    def test_numbers_are_those_of_numpy(self, seed):
        streams, expected = seeded(1, seed), np.random.default_rng(seed)
        found = np.empty(COUNT)
        fill_random(1, streams, found)
        np.testing.assert_array_equal(found, expected.random(COUNT))
        fill_uniform(1, -0.3, 1e3, streams, found)
        np.testing.assert_array_equal(found, expected.uniform(-0.3, 1e3, COUNT))
        fill_normal(1, streams, found)
        np.testing.assert_array_equal(found, expected.standard_normal(COUNT))
        self.assertGreater(np.abs(found).max(), 3.66)  # in the tail
        fill_random(1, streams, found[:9])  # as many bits were drawn
        np.testing.assert_array_equal(found[:9], expected.random(9))

    def test_python_and_compiled_functions_alternately(self):
        streams, expected = seeded(11), np.random.default_rng(11)
        found = np.empty(7)
        for _ in range(3):
            fill_normal(0, streams, found)
            np.testing.assert_array_equal(found, expected.standard_normal(7))
            with random._continued(streams[0]) as generator:
                # 32 bits of a word remain in the buffer.
                self.assertEqual(generator.integers(5), expected.integers(5))
                draw = generator.uniform(-np.pi, np.pi), generator.permutation(9).tolist()
            self.assertEqual(
                draw, (expected.uniform(-np.pi, np.pi), expected.permutation(9).tolist())
            )
            with random._continued(streams[0]) as generator:
                self.assertEqual(generator.bit_generator.state, expected.bit_generator.state)

    def test_streams_are_independent(self):
        streams = seeded(20, 21)
        before, numbers = streams[0].copy(), np.empty(50)
        fill_normal(1, streams, numbers)
        np.testing.assert_array_equal(streams[0], before)


class DrawTest(parameterized.TestCase):
    """Draws from NumPy's generators by their addresses, whatever their bits come from."""

    @parameterized.parameters('PCG64', 'PCG64DXSM', 'MT19937', 'Philox', 'SFC64')
    def test_draws_continue_those_of_the_generator(self, name):
        one, other = (np.random.Generator(getattr(np.random, name)(3)) for _ in range(2))
        bits = random.address(one)
        for _ in range(3):
            found = [random.draw(bits) for _ in range(700)]
            np.testing.assert_array_equal(found, other.random(700))
            self.assertEqual(one.standard_normal(), other.standard_normal())
            self.assertEqual(one.integers(100), other.integers(100))
