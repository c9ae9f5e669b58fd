"""Data sets in Minari's format: contents, and the same bytes from the same recipe."""

import importlib.util
import json
import os
import unittest
from unittest import mock

import gymnasium
import numpy as np

if importlib.util.find_spec('minari') is None:
    raise unittest.SkipTest('needs minari')

import minari
from helpers import assert_uniform
from programs import CommandTest, run_example

from trl_suite import policies
from trl_suite.adapters import minari as adapter
from trl_suite.util.digest import digest
from trl_suite.vector import VectorEnvironment

ID = 'PD_Biped2D_Flat-v0'


class DataSetTest(CommandTest):
    def setUp(self):
        super().setUp()
        self.enter('a')

    def enter(self, name):
        path = str(self.folder / name)
        self.enterContext(mock.patch.dict(os.environ, {adapter.FOLDER: path}))

    def contents(self, name, dataset):
        folder = self.folder / name / dataset / 'data'
        return {path.name: path.read_bytes() for path in folder.iterdir()}

    def test_every_episode_draws_the_share_of_random_actions(self):
        environments = VectorEnvironment(ID, 64, 1, seed=0)
        act, shipped = adapter.mixed(environments), adapter.reference(environments)
        seen = environments.reset()
        share = np.mean([(act(seen) != shipped(seen)).any(1) for _ in range(100)], 0)
        assert_uniform(share, 0, 1)

    def test_episodes_are_those_of_gymnasium(self):
        name = adapter.write(ID, 'mixed', 4, seed=3, num_threads=2)
        dataset = minari.load_dataset(name)
        self.assertEqual(dataset.total_episodes, 4)
        env = dataset.recover_environment()
        for episode in dataset.iterate_episodes():
            observation, info = env.reset(seed=self.seed(episode))
            np.testing.assert_array_equal(episode.observations[0], observation)
            for t, action in enumerate(episode.actions):
                observation, reward, terminated, truncated, info = env.step(action)
                np.testing.assert_array_equal(episode.observations[t + 1], observation)
                self.assertEqual(episode.rewards[t], reward)
                self.assertEqual(episode.terminations[t], terminated)
                self.assertEqual(episode.truncations[t], truncated)
                self.assertEqual(episode.infos['distance'][t + 1], info['distance'])
            self.assertTrue(terminated or truncated)
        self.assertEqual(gymnasium.spec(f'trl_suite/{ID}').id, env.spec.id)

    @staticmethod
    def seed(episode):
        return int(np.random.SeedSequence(3).generate_state(4, np.uint32)[episode.id])

    def test_the_same_recipe_gives_the_same_bytes(self):
        name = adapter.write(ID, 'mixed', 3, num_threads=1)
        first = self.contents('a', name)
        self.enter('b')
        with mock.patch.object(adapter, 'CHUNK', 2):
            out = self.output('dataset', ID, '--policy', 'mixed', '--episodes', '3', '--minari')
        self.assertEqual(out, f'{name}\n')
        self.assertEqual(self.contents('b', name), first)
        recipe = json.loads(json.loads(first['metadata.json'])['description'])
        self.assertEqual((recipe['policy'], recipe['episodes'], recipe['seed']), ('mixed', 3, 0))
        self.assertLen(recipe['sha256'], 64)
        self.assertEqual(recipe['numpy'], np.__version__)
        self.assertEqual(recipe['weights'], digest(policies.reference(ID)))
        self.enter('c')
        adapter.write(ID, 'mixed', 3, seed=1)
        self.assertNotEqual(self.contents('c', name)['main_data.hdf5'], first['main_data.hdf5'])

    @unittest.skipUnless(importlib.util.find_spec('torch'), 'needs torch')
    def test_a_policy_is_cloned(self):
        name = adapter.write(ID, 'reference', 2, num_threads=1)
        out = run_example('behaviour_cloning', name, '--epochs', '3', '--episodes', '1')
        errors = [float(line.split()[-1]) for line in out.splitlines()[:-1]]
        self.assertLess(errors[-1], 0.7 * errors[0])
        self.assertRegex(out, r'\nreturn \d+\.\d of 256\n$')

    def test_refusals(self):
        name = adapter.write(ID, 'random', 1)
        with self.assertRaisesRegex(
            ValueError, f'{name}: exists; remove it, or set another folder'
        ):
            adapter.write(ID, 'random', 1)
        with self.assertRaisesRegex(ValueError, "unknown policy 'mixd'; did you mean 'mixed'"):
            adapter.write(ID, 'mixd', 1)
        with self.assertRaisesRegex(ValueError, 'episodes is 0'):
            adapter.write(ID, 'random', 0)
        self.assertEqual([path.name for path in (self.folder / 'a').iterdir()], [name])
