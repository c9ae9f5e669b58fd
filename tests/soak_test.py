"""The soak: its actions, what it counts, and that runs accumulate in one file."""

import itertools
import json
import pathlib
import sys
from unittest import mock

import numpy as np
from helpers import FolderTest
from programs import output

from trl_suite import suite
from trl_suite.tasks.task_type import TASK_TYPES

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / 'benchmarks'))
import soak

FIGURES = {
    'steps': 10, 'control_steps': 100, 'episodes': 2, 'diverged': 1, 'not_finite': 0, 'largest': 3.0,
}  # fmt: skip


class SoakTest(FolderTest):
    def test_every_task_type_and_every_id(self):
        self.assertEqual({spec.task_type for spec in soak.SPECS}, set(TASK_TYPES))
        self.assertContainsSubset(suite.ALL_IDS, [spec.id for spec in soak.SPECS])

    def test_actions_are_extreme(self):
        chosen = soak.actions(np.random.default_rng(0), (4, 3))
        uniform, changing, held, huge = (
            np.array(list(itertools.islice(chosen, 50))) for _ in soak.KINDS
        )
        self.assertLess(np.abs(uniform).max(), 1)
        np.testing.assert_array_equal(np.abs(np.stack([changing, held])), 1)
        self.assertGreater((changing[1:] != changing[:-1]).any((1, 2)).mean(), 0.9)
        self.assertLess((held[1:] != held[:-1]).any((1, 2)).mean(), 0.5)
        self.assertGreater(np.abs(huge).max(), 1e250)
        self.assertTrue(np.isfinite(huge).all())

    def test_numbers_that_are_not_finite_are_counted(self):
        step = soak.VectorEnvironment.step
        spec = suite.find('PD_Biped2D_LLC_Imitate_Flat-v0')

        def broken(environments, action):
            found = step(environments, action)
            found.observation[1, 2] = np.nan
            return found

        found = soak.soak(spec, 0.0, 3, 1, 0)
        self.assertEqual((found['steps'], found['not_finite']), (3, 0))
        self.assertEqual(found['control_steps'], 3)
        self.assertBetween(found['largest'], 0.1, 1e3)
        with mock.patch.object(soak.VectorEnvironment, 'step', broken):
            found = soak.soak(spec, 0.0, 3, 1, 0)
        self.assertEqual((found['steps'], found['not_finite']), (3, 1))
        self.assertTrue(np.isfinite(found['largest']))

    def test_control_steps_of_gaits_are_those_within_cycles(self):
        durations, step = [], soak.VectorEnvironment.step

        def timed(environments, action):
            found = step(environments, action)
            durations.append(found.info['duration'].copy())
            return found

        with mock.patch.object(soak.VectorEnvironment, 'step', timed):
            found = soak.soak(suite.find('FSM_Dog2D_Terrain_Mixed-v0'), 0.0, 3, 1, 0)
        self.assertEqual(found['control_steps'], round(600 * np.sum(durations)))
        self.assertGreater(found['control_steps'], 100)

    def run_soak(self, *arguments, meanwhile=None, **figures):
        seen, path = [], self.folder / 'a.json'

        def run(spec, seconds, num_envs, threads, seed):
            seen.append((spec.id, seed))
            if meanwhile is not None:
                meanwhile()
            return {**FIGURES, **figures}

        with mock.patch.object(soak, 'soak', run):
            out = output(soak.main, '--seconds', 0, '--file', path, *arguments)
        return seen, json.loads(path.read_text()), out

    def test_runs_accumulate(self):
        first, _, _ = self.run_soak()
        second, figures, out = self.run_soak(not_finite=2, largest=5.0)
        self.assertNotEqual(first, second)
        self.assertEqual([run['seed'] for run in figures['runs']], [0, 1])
        total = list(figures['task_types'].values())
        self.assertEqual(sum(each['steps'] for each in total), 20)
        self.assertEqual(max(each['largest'] for each in total), 5.0)
        (bad,) = figures['not_finite']
        self.assertEqual((bad['id'], bad['seed'], bad['run']), (*second[0], 1))
        self.assertIn('all: 200 control steps', out)
        self.assertIn('all: 20 steps', out)
        self.assertIn(f"NOT FINITE: {{'id': '{second[0][0]}'", out)
        # Another one during the next run, with a seed of its own.
        _, figures, _ = self.run_soak(meanwhile=self.run_soak)
        self.assertEqual([run['seed'] for run in figures['runs']], [0, 1, 2, 3])
        self.assertEqual([run['environments'] for run in figures['runs']], [1] * 4)
        self.assertEqual(sum(each['steps'] for each in figures['task_types'].values()), 40)
        # A run with the same seed does the same.
        (self.folder / 'a.json').unlink()
        self.assertEqual(self.run_soak('--seed', '1')[0], second)
        seen, _, out = self.run_soak('--show')
        self.assertEqual((seen, out.count('seed 1: 1 environments')), ([], 1))
