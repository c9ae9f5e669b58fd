"""The search for a change of the plan that a footstep controller observes."""

import dataclasses
import json
import pathlib
import shutil
import sys
import tempfile
from unittest import mock

import numpy as np
from absl.testing import absltest, parameterized

from trl_suite import policies

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / 'examples'))
import tune_footsteps

CONTROLLER = policies.reference(tune_footsteps.ID)
SOME = {name: tune_footsteps.CONDITIONS[name] for name in ('general', 'belts of 0.6 m/s')}


class TuneFootstepsTest(parameterized.TestCase):
    def setUp(self):
        super().setUp()
        self.enterContext(mock.patch.object(tune_footsteps, 'CONDITIONS', SOME))

    @parameterized.parameters((False, 7), (True, 13))
    def test_the_network_observes_the_changed_plan(self, body, inputs):
        """In right stance, where observations are not mirrored."""
        tuning = tune_footsteps.Tuning(CONTROLLER, body)
        self.assertLen(tuning.inputs, inputs)
        rng = np.random.default_rng(0)
        parameters = 0.1 * rng.standard_normal(tuning.size)
        parameters[tuning.shape[0] * tuning.shape[1] :] = 0.0
        change = parameters[: tuning.shape[0] * tuning.shape[1]].reshape(tuning.shape)
        policy = tuning.policy
        seen = policy.mean + 0.5 * policy.std * rng.standard_normal((9, len(policy.mean)))
        seen[:, policy.mirror.phase] = 0.2
        z = (seen - policy.mean) / policy.std
        other = seen.copy()
        other[:, tuning.plan] += policy.std[tuning.plan] * (
            z[:, tuning.inputs] @ change[:, :-1].T + change[:, -1]
        )
        _, left = policy.mirror.canonical(seen)
        self.assertFalse(left.any())
        np.testing.assert_allclose(tuning.changed(parameters)(seen), policy(other), atol=1e-4)
        parameters[-1] = 0.1
        moved = tuning.changed(parameters).biases[-1] - policy.biases[-1]
        np.testing.assert_allclose(moved[-1], 0.1 * tune_footsteps.BIAS, rtol=1e-4)
        np.testing.assert_array_equal(moved[:-1], 0.0)

    def test_without_a_change_the_controller_is_the_same_on_level_ground(self):
        tuning = tune_footsteps.Tuning(CONTROLLER)
        score = tune_footsteps.Score(2, 1, 1.5)
        level = score.parts[list(SOME).index('general')]
        before = tune_footsteps.with_all_inputs(CONTROLLER)
        one, two = score.in_part(level, [before, tuning.changed(np.zeros(tuning.size))], (0,))
        self.assertEqual(one, two)
        self.assertBetween(one, 1e-4, 0.2)

    def test_other_policies_are_refused(self):
        policy = policies.reference('PD_Biped3D_Imitate-v0')
        with self.assertRaisesRegex(ValueError, f'{policy.id}: expected a footstep controller'):
            tune_footsteps.Tuning(policy)

    def test_inputs_that_were_removed_are_restored(self):
        whole = tune_footsteps.with_all_inputs(CONTROLLER)
        size = sum(size for _, size in CONTROLLER.blocks)
        self.assertLen(whole.mean, size)
        seen = np.random.default_rng(0).standard_normal((9, size))
        np.testing.assert_allclose(whole(seen), CONTROLLER(seen), atol=1e-5)

    def test_a_fall_counts_as_misses_until_the_end(self):
        falls = dataclasses.replace(
            CONTROLLER, biases=(*CONTROLLER.biases[:-1], np.full(len(CONTROLLER.actions), 1.0))
        )
        score = tune_footsteps.Score(1, 2, 4.0)
        found = score([falls], 0)
        self.assertEqual(found.shape, (1, len(SOME)))
        self.assertGreater(found.min(), 0.6 * tune_footsteps.MISS)
        self.assertLessEqual(found.max(), tune_footsteps.MISS)

    def test_the_search_writes_the_mean_of_the_last_generation(self):
        """With a strategy that moves to the best candidate."""

        class Strategy:
            def __init__(self, start, sd, options):
                self.mean, self.sd = start, sd
                self.rng = np.random.default_rng(options['seed'])

            def ask(self):
                return [
                    self.mean + self.sd * self.rng.standard_normal(self.mean.shape) for _ in '12'
                ]

            def tell(self, candidates, scores):
                self.mean = candidates[int(np.argmin(scores))]

        module = mock.Mock(CMAEvolutionStrategy=Strategy)
        with tempfile.TemporaryDirectory() as folder:
            path = pathlib.Path(folder) / 'tuned.npz'
            argv = [
                'tune_footsteps.py',
                '--generations',
                '2',
                '--population',
                '2',
                '--output',
                str(path),
            ]
            with (
                mock.patch.dict(sys.modules, cma=module),
                mock.patch.object(sys, 'argv', argv),
                mock.patch.object(tune_footsteps, 'SECONDS', 0.7),
                mock.patch.object(tune_footsteps, 'COMPARED', 1),
            ):
                tune_footsteps.main()
            found = policies.load(path)
        before = tune_footsteps.with_all_inputs(CONTROLLER)
        self.assertEqual(found.weights[0].shape, before.weights[0].shape)
        self.assertFalse(np.array_equal(found.weights[0], before.weights[0]))
        np.testing.assert_array_equal(found.weights[1], CONTROLLER.weights[1])

    def test_a_tuned_controller_is_entered(self):
        with tempfile.TemporaryDirectory() as folder:
            trained = pathlib.Path(folder)
            source = tune_footsteps.resources.directory('trained') / f'{tune_footsteps.ID}.json'
            shutil.copy(source, trained)
            found = {'return': 1.0}
            with (
                mock.patch.object(tune_footsteps.resources, 'directory', lambda _: trained),
                mock.patch.object(tune_footsteps.evaluation, 'evaluate', lambda *_: found),
            ):
                tune_footsteps.enter(CONTROLLER, {'seed': 5})
            [run] = json.loads((trained / source.name).read_text())['runs']
            self.assertTrue((trained / f'{tune_footsteps.ID}.npz').exists())
        self.assertEqual((run['tuned'][-1], run['evaluation']), ({'seed': 5}, found))
        self.assertNotEmpty(run['curve'])


if __name__ == '__main__':
    absltest.main()
