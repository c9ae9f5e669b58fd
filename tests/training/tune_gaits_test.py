"""Searches for gaits, and the simulations in which they are measured."""

import sys
from unittest import mock

import gait_bench
import numpy as np
import tune_gaits
from absl.testing import absltest

from trl_suite import controllers


class TuneTest(absltest.TestCase):
    def test_gaits_within_the_action_range_are_stored_and_kept(self):
        gait = controllers.load('dog')

        class Strategy:
            def __init__(self, start, sd, options):
                self.rng, self.shape = np.random.default_rng(0), (options['popsize'], len(start))
                self.result = mock.Mock(xfavorite=start)

            def ask(self):
                return list(self.rng.normal(0, 50, self.shape))

            def tell(self, candidates, values):
                pass

        arguments = mock.Mock(action='complement', population=5, generations=3, sd=1.0)
        for within in (True, False):
            arguments.within = within
            with mock.patch.dict(sys.modules, cma=mock.Mock(CMAEvolutionStrategy=Strategy)):
                found = tune_gaits.search(
                    lambda vectors: np.zeros(len(vectors)), gait.base_actions[3], gait, arguments,
                    np.random.default_rng(0),
                )  # fmt: skip
            self.assertEqual(bool(np.abs(gait.action(found)).max() <= 1 + 1e-9), within)
        np.testing.assert_allclose(found[0], gait.base_actions[3], atol=1e-4)

        stairs = {'vector': gait.base_actions[3].tolist(), 'tuning': {'within': True}}
        others = {'vector': gait.base_actions[1].tolist(), 'tuning': {}}
        data = gait_bench.stored('dog')
        with (
            mock.patch.object(tune_gaits, 'stored', lambda name: data),
            mock.patch.object(tune_gaits, 'write', lambda name, data: data),
        ):
            with self.assertRaisesRegex(ValueError, "'wall'.*did you mean 'walk'"):
                tune_gaits.add('dog', {'walk': stairs, 'other': others}, ['wall'])
            with self.assertRaisesRegex(ValueError, "'other'"):
                tune_gaits.add('dog', {'walk': stairs, 'other': others}, ['other'])
            tune_gaits.add('dog', {'walk': stairs}, ['walk'])
            written = tune_gaits.enter('dog', {}, ['0', '1'])
            data['action_offset'] = 1  # the default gait is the second base action
            with self.assertRaisesRegex(ValueError, '1 gaits.*base action 1'):
                tune_gaits.enter('dog', {}, ['0'])
        self.assertEqual(written['sets']['walk'], stairs['vector'])
        self.assertEqual(written['tuning']['walk'], {'within': True})
        self.assertNotIn('walk', [name for names in written['base_actions'] for name in names])

    def test_a_steady_gait_lands_where_it_is_expected(self):
        gait, seeds = controllers.load('hopper'), np.arange(6)
        vectors = np.array([gait.sets['run'], gait.sets['steady'], gait.sets['foot_back']])
        rows = len(vectors) * len(seeds) * tune_gaits.COPIES
        bench = gait_bench.Bench('hopper', rows, gait.action_offset)
        score, figures = tune_gaits.steadiness(bench, vectors, 1.4, seeds)
        self.assertEqual(figures['spread'].shape, (3, tune_gaits.AHEAD))
        np.testing.assert_array_less(2 * figures['spread'][1, 1:], figures['spread'][0, 1:])
        self.assertGreater(score[1], score[0])
        self.assertEqual(figures['upright'][:2].tolist(), [1, 1])
        self.assertLess(figures['upright'][2], 1)  # this action is not one to repeat
        self.assertLess(score[2], score[0])
        longer, again = tune_gaits.steadiness(bench, vectors, 3.0, seeds)
        np.testing.assert_array_equal(again['length'], figures['length'])
        expected = (
            score - 2 * (3.0 - figures['length']) + 2 * np.maximum(0, 1.4 - figures['length'])
        )
        np.testing.assert_allclose(longer, expected)

    def test_base_actions_of_the_hopper_differ_in_the_length_of_a_hop(self):
        gait = controllers.load('hopper')
        names = [f'shorter_{n}' for n in range(5, 0, -1)] + ['steady']
        names += [f'longer_{n}' for n in range(1, 6)]
        bench = gait_bench.Bench('hopper', len(names), gait.action_offset)
        environments = bench.environments
        environments.reset(seed=[3] * len(names))
        for _ in range(6):
            environments.step(bench.actions(np.tile(gait.sets['steady'], (len(names), 1))))
        before = gait_bench.position(environments)
        np.testing.assert_array_equal(before, before[0])
        environments.step(bench.actions(np.array([gait.sets[name] for name in names])))
        length = gait_bench.position(environments) - before
        np.testing.assert_array_less(0.02, np.diff(length))
        self.assertLess(length[0], 0.6)
        self.assertGreater(length[-1], 2.2)
