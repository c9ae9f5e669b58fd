"""The search over base actions, and the policy that learns from it."""

import pathlib
import sys
import tempfile

import numpy as np
from absl.testing import absltest

from trl_suite import policies
from trl_suite.util import machine
from trl_suite.vector import VectorEnvironment

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / 'examples'))
import search_gaits

HOPPER = 'FSM_Hopper2D_Terrain_Gaps-v0'
TINY = search_gaits.Settings(
    samples=8, num_envs=2, hidden=(8,), epochs=2, evaluate_every=4, evaluation_episodes=2
)


class SearchTest(absltest.TestCase):
    def test_results_of_all_choices_without_changing_the_simulation(self):
        search = search_gaits.Search(HOPPER, TINY, 1)
        default = np.zeros(search.choices.shape[1])
        np.testing.assert_array_equal(search.choices[0], default)
        self.assertLen(np.unique(search.choices, axis=0), len(search.choices))
        environments = VectorEnvironment(HOPPER, 2, 1, 3, autoreset='disabled')
        environments.reset()
        environments.step(np.tile(default, (2, 1)))

        def network(observation):
            return np.zeros(len(observation), int)

        worth = search(environments, network)
        self.assertEqual(worth.shape, (2, len(search.choices)))
        self.assertGreater(np.ptp(worth), 0.01)  # base actions differ
        choice = len(search.choices) - 1
        other = VectorEnvironment(HOPPER, 2, 1, 3, autoreset='disabled')
        other.reset()
        other.step(np.tile(default, (2, 1)))
        expected = np.zeros(2)
        for action in (search.choices[choice], default):
            steps = [e.step(np.tile(action, (2, 1))) for e in (environments, other)]
            np.testing.assert_array_equal(steps[0].observation, steps[1].observation)
            expected += steps[0].reward
            self.assertFalse(steps[0].terminated.any())
        np.testing.assert_allclose(worth[:, choice], expected + TINY.alive)

    def test_the_network_uses_the_near_ground(self):
        environments = VectorEnvironment(HOPPER, 1, 1, 0)
        terrain = environments.blocks['terrain']
        columns = search_gaits.visible(environments.blocks, 5.0)
        ahead = np.linspace(-0.5, 10, 200)
        near = columns[(columns >= terrain.start) & (columns < terrain.stop)] - terrain.start
        np.testing.assert_array_equal(near, np.flatnonzero(ahead <= 5))
        rest = environments.task.observation.shape[1] - 200
        self.assertLen(columns, len(near) + rest)

    def test_a_run_writes_its_policy_and_resumes(self):
        with tempfile.TemporaryDirectory() as name:
            folder = pathlib.Path(name)
            curve = search_gaits.train(HOPPER, 1, TINY, folder, 1)
            self.assertEqual([point['samples'] for point in curve], [4, 8])
            policy = policies.load(folder / 'last.npz')
            policy.check(VectorEnvironment(HOPPER, 1, 1))
            self.assertEqual(policy.info['samples'], 8)
            self.assertLessEqual(machine.made_with().items(), policy.info.items())
            again = search_gaits.train(HOPPER, 1, TINY, folder, 1)
            self.assertEqual(again, curve)  # there was nothing left to do
            with self.assertRaisesRegex(ValueError, 'other settings'):
                other = search_gaits.Settings(samples=8, alive=1.0)
                search_gaits.train(HOPPER, 1, other, folder, 1)
            (folder / 'checkpoint.pt').touch()
            with self.assertRaisesRegex(ValueError, 'holds a run of learn_gaits.py'):
                search_gaits.train(HOPPER, 1, TINY, folder, 1)


if __name__ == '__main__':
    absltest.main()
