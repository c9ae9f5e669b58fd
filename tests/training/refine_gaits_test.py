"""PPO over base actions: initial policy, advantages, the exported policy, exact resumption."""

import dataclasses
import functools
import json
from unittest import mock

import learn_gaits
import numpy as np
import refine_gaits
import torch
from absl.testing import parameterized
from helpers import FolderTest

from trl_suite import policies

from .learn_gaits_test import HOPPER, TINY, WALLS, trained_in_parts

FIRST = dataclasses.replace(TINY, samples=16, expert_cycles=0, members=2)
SMALL = refine_gaits.Settings(
    first=FIRST, samples=64, num_envs=4, horizon=8, epochs=2, minibatch=16, value_first=1,
    value_epochs=1, write_every=32, evaluate_every=32,
)  # fmt: skip


@functools.cache
def initial_policy():
    """The policy of a short Q-learning."""
    learner = learn_gaits.Learner(HOPPER, 1, FIRST, 1)
    for _ in range(6):
        learner.advance()
    learner.finish()
    return learner.exported()


def make(**changes):
    """A run that begins with this policy, and the policy."""
    initial, settings = initial_policy(), dataclasses.replace(SMALL, **changes)
    return refine_gaits.Refiner(HOPPER, 1, settings, 1, initial), initial


class RefineTest(FolderTest):
    @parameterized.parameters(*refine_gaits.CHANGES)
    def test_it_begins_with_the_mean_values_of_the_initial_policy(self, changes):
        refiner, initial = make(changes=changes)
        observation = refiner.learner.observation
        with torch.no_grad():
            likely = refiner.outputs(refiner.seen())[0].exp()
        np.testing.assert_allclose(likely.sum(1), 1, rtol=1e-5)
        choices = refiner.learner.choices
        chosen = choices[likely.argmax(1).numpy()]
        np.testing.assert_allclose(initial(observation), chosen, atol=learn_gaits.CHOICE_ERROR)
        exported = refiner.exported()
        self.assertLen(exported.networks, 2)
        np.testing.assert_array_equal(exported(observation), initial(observation))

    @parameterized.parameters(
        ({'first': dataclasses.replace(FIRST, action='both')}, "action.*'both'; expected 'discrete'"),
        ({'changes': 'every'}, "unknown kind of changes 'every'"),
        ({'changes': 'all', 'noise': 0.0}, 'noise is 0.0; expected a number above 0'),
        ({'changes': 'all', 'largest_change': -0.3}, 'largest_change is -0.3'),
        ({'changes_first': 8.0}, 'changes_first is 8.0; expected 0 without'),
        ({'also': ('FSM_Hoper2D_*',)}, 'did you mean'),
        ({'also': ('PD_Biped2D_Gaps_Terrain-v0',)}, 'no gait'),
        ({}, 'PD_Biped2D_Flat-v0 has no gait', 'PD_Biped2D_Flat-v0'),
    )  # fmt: skip
    def test_bad_settings_are_refused_before_q_learning(self, changes, message, id_=HOPPER):
        settings = dataclasses.replace(SMALL, **changes)
        with (
            mock.patch.object(learn_gaits, 'train', side_effect=AssertionError),
            self.assertRaisesRegex(ValueError, message),
        ):
            refine_gaits.train(id_, 1, settings, self.folder, 1)

    def test_actions_are_drawn_with_their_probabilities(self):
        refiner, _ = make(num_envs=8, horizon=1)
        counts, expected = np.zeros((2, len(refiner.learner.choices)))
        run = refiner.learner.run
        refiner.learner.run = lambda taken: (np.zeros(8), np.zeros(8, bool), None)
        with torch.no_grad():
            likely = refiner.outputs(refiner.seen())[0].exp().numpy()
        for _ in range(500):
            batch = refiner.collect()
            np.add.at(counts, batch['action'].numpy(), 1)
            expected += likely.sum(0)
        refiner.learner.run = run
        np.testing.assert_array_less(
            np.abs(counts - expected), 5 * np.sqrt(np.maximum(expected, 1)) + 1
        )

    def test_advantages_end_at_falls(self):
        refiner, _ = make(num_envs=4, horizon=3, gamma=0.5, lambda_=1.0)
        rewards = iter(np.array([[1.0] * 4, [2.0] * 4, [4.0] * 4]))
        falls = iter(np.array([[False] * 4, [True, False, False, False], [False] * 4]))
        refiner.learner.run = lambda taken: (next(rewards), next(falls), None)
        batch = refiner.collect()  # the initial value is 0 everywhere
        sums = batch['target'].reshape(3, 4)
        np.testing.assert_allclose(sums[:, 0], [1 + 0.5 * 2, 2, 4])  # after the fall, another one
        np.testing.assert_allclose(sums[:, 1], [1 + 0.5 * 2 + 0.25 * 4, 2 + 0.5 * 4, 4])
        np.testing.assert_allclose(batch['advantage'], batch['target'])

    def test_it_selects_what_pays_more_often(self):
        rates = {'learning_rate': 3e-3, 'kl': 1.0}
        refiner, _ = make(num_envs=8, value_first=0, horizon=16, minibatch=32, **rates)
        chosen, better = [], 3

        def run(taken):
            number = np.abs(taken[:, None] - refiner.learner.choices).sum(2).argmin(1)
            chosen.append((number == better).mean())
            return (number == better).astype(float), np.ones(8, bool), None

        refiner.learner.run = run
        for _ in range(20):
            refiner.advance()
        self.assertGreater(np.mean(chosen[-16:]), 0.9)
        self.assertLess(np.mean(chosen[:16]), 0.6)

    @parameterized.parameters('all', 'each')
    def test_it_learns_changes_that_pay_at_a_constant_divergence(self, changes):
        refiner, initial = make(
            num_envs=16, value_first=0, horizon=16, minibatch=64, changes=changes,
            changes_first=np.inf, kl=1.0, averaged=0.0,
        )  # fmt: skip
        choices = refiner.learner.choices

        def run(taken):
            number = np.abs(taken[:, None] - choices).sum(2).argmin(1)
            return 9 * (taken - choices[number])[:, 1], np.ones(16, bool), None

        refiner.learner.run = run
        found = []
        for _ in range(40):
            refiner.advance()
            found.append(refiner.divergence)
        self.assertBetween(np.median(found[10:]), 0.005, 0.02)
        observation = refiner.learner.observation
        policy = refiner.exported()
        inner = np.abs(initial(observation)[:, 1]) < 0.8
        change = (policy(observation) - initial(observation))[inner]
        self.assertGreater(change[:, 1].min(), 0.1)
        self.assertLess(np.abs(change).max(), refine_gaits.Settings.largest_change)
        self.assertLess(np.abs(np.delete(change, 1, 1)).mean(), 0.05)
        point = refiner.evaluate()
        self.assertEqual(point['divergence'], found[-1])
        self.assertGreater(point['change_rate'], refine_gaits.Settings.change_rate)
        # The selection has not been trained.
        for one, other in zip(policy.networks, initial.networks, strict=True):
            np.testing.assert_array_equal(one[1][0], other[1][0])
        # The next run begins with these changes.
        again = refine_gaits.Refiner(HOPPER, 1, refiner.settings, 1, policy)
        np.testing.assert_array_equal(again.exported()(observation), policy(observation))
        other = dataclasses.replace(refiner.settings, largest_change=0.2)
        with self.assertRaisesRegex(
            ValueError, f"changes='{changes}', largest_change=0.3; .* largest_change=0.2"
        ):
            refine_gaits.Refiner(HOPPER, 1, other, 1, policy)

    def test_training_may_have_a_coarser_physics(self):
        for substeps, timestep in ((1, 1 / 600), (2, 1 / 1200)):
            refiner, _ = make(substeps=substeps)
            task = refiner.learner.environments.task
            self.assertAlmostEqual(task.physics_timestep, timestep, places=12)

    def test_the_value_is_learnt_first(self):
        refiner, _ = make()
        before = refiner.outputs(refiner.seen())[0].detach()
        seen = refiner.seen()
        refiner.advance()
        np.testing.assert_array_equal(refiner.outputs(seen)[0].detach(), before)
        self.assertTrue((refiner.estimate(seen) != 0).all())
        refiner.advance()
        self.assertTrue((refiner.outputs(seen)[0].detach() != before).any())

    @parameterized.parameters(0.0, 64.0)
    def test_the_weights_that_are_written_may_be_an_average(self, averaged):
        refiner, _ = make(value_first=0, averaged=averaged)

        def weights():
            return refiner.policy[0].last.weight.detach().numpy().copy()

        refiner.advance()
        first, expected = weights(), weights()
        for _ in range(3):  # 32 cycles each
            refiner.advance()
            expected += (0.5 if averaged else 1.0) * (weights() - expected)
        self.assertTrue((weights() != first).any())
        _, written, _ = refiner.exported().networks[0]
        np.testing.assert_allclose(written[-1], expected.T, rtol=1e-5, atol=1e-7)

    @parameterized.parameters(
        {}, {'also': (WALLS,), 'averaged': 96.0}, {'changes': 'each', 'changes_first': 48.0}
    )
    def test_a_run_writes_its_policy_and_resumes_exactly(self, **changes):
        settings = dataclasses.replace(SMALL, last_learning_rate=SMALL.learning_rate, **changes)
        train = refine_gaits.train
        folder, curve, policy = trained_in_parts(self, train, settings, (32, 64), ('policy.npz',))
        written = json.loads((folder / 'curve.json').read_text())
        points = [point['samples'] for point in written['curve']]
        self.assertEqual(points, [16, 48, 80])  # Q-learning first
        self.assertEqual(points, [point['samples'] for point in curve])
        settings = dataclasses.replace(settings, samples=64)
        with mock.patch.object(learn_gaits, 'train', side_effect=AssertionError):
            again = train(HOPPER, 1, settings, folder, 1)
        self.assertEqual([{**point, 'seconds': None} for point in again], curve)
        self.assertEqual(policy.info['samples'], 80)
        with self.assertRaisesRegex(ValueError, 'other settings'):
            train(HOPPER, 1, dataclasses.replace(settings, gamma=0.9), folder, 1)

    def test_an_initial_policy_of_another_environment_is_refused(self):
        initial = policies.reference('FSM_Dog2D_Terrain_Mixed-v0')
        with self.assertRaisesRegex(ValueError, 'FSM_Dog2D_Terrain_Mixed-v0'):
            refine_gaits.Refiner(HOPPER, 1, SMALL, 1, initial)

    def test_a_run_begins_with_a_file(self):
        path = self.folder / 'initial.npz'
        policies.save(make()[1], path)
        settings = dataclasses.replace(SMALL, start=str(path), samples=32)
        curve = refine_gaits.train(HOPPER, 1, settings, self.folder / 'run', 1)
        self.assertEqual([point['samples'] for point in curve], [32])
        self.assertFalse((self.folder / 'run' / 'first').exists())
