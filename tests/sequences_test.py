"""Sequences of environments: contents, seeds, budgets, metrics, resumed runs, and results."""

import concurrent.futures
import contextlib
import copy
import json
import os
import pathlib
import sys
import tempfile
from unittest import mock

import cli_test
import numpy as np
import pytest
import torch
from absl.testing import absltest, parameterized

from trl_suite import evaluation, sequences, suite
from trl_suite.runs import results, running
from trl_suite.util import machine
from trl_suite.vector import VectorEnvironment

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / 'training'))
import continual

SHORT = sequences.Sequence('short', ('plaid/dog_flat', 'plaid/dog_steps', 'plaid/dog_gaps'))


class SequenceTest(parameterized.TestCase):
    @parameterized.parameters(
        *(n for n in sequences.SEQUENCES if n.startswith(('plaid_long', 'gaits')))
    )
    def test_one_network_serves_all(self, name):
        sequence = sequences.get(name)
        shapes = set()
        for id_ in sequence.ids:
            task = suite.build_task(suite.find(id_))
            shapes.add((tuple(task.blocks.items()).__repr__(), tuple(task.action_map.names)))
        self.assertLen(shapes, 1)
        self.assertEqual(sequence.name, name)

    @parameterized.parameters('biped', 'dog', 'raptor')
    def test_the_order_of_plaid(self, figure):
        # Berseth et al. 2018, section 4.
        expected = [f'plaid/{figure}_{t}' for t in ('flat', 'incline', 'steps', 'slopes', 'gaps')]
        ids = tuple(suite.find(alias).id for alias in expected)
        self.assertEqual(sequences.get(f'plaid_{figure}').ids, ids)
        self.assertEqual(sequences.get(f'plaid_long_{figure}').ids[:5], ids)
        self.assertLen(sequences.get(f'plaid_long_{figure}'), 8)

    def test_invalid_arguments_are_rejected(self):
        with self.assertRaisesRegex(ValueError, "'plaid_bog'; did you mean 'plaid_dog'"):
            sequences.get('plaid_bog')
        with self.assertRaisesRegex(ValueError, "unknown environment 'PD_Bog2D_Gaps_Terrain-v0'"):
            sequences.Sequence('mine', ('PD_Bog2D_Gaps_Terrain-v0', 'plaid/dog_flat'))
        with self.assertRaisesRegex(ValueError, 'each once'):
            sequences.Sequence('mine', ('plaid/dog_flat', 'PD_Dog2D_Flat_Terrain-v0'))


class SeedsTest(absltest.TestCase):
    def test_train_and_test_seeds_are_disjoint(self):
        train, test = sequences.train_seeds(2000, (1, 2)), sequences.test_seeds(2000, (1, 2))
        self.assertLess(max(train), 2**31)
        self.assertBetween(min(test), 2**31, max(test))
        self.assertLess(max(test), 2**32)
        self.assertGreater(len(set(train)), 1990)
        self.assertEqual(train[:5], sequences.train_seeds(5, (1, 2)))
        self.assertNotEqual(train[:5], sequences.train_seeds(5, (1, 3)))

    def test_environments_accept_the_seeds(self):
        seeds = sequences.test_seeds(3)
        found = evaluation.evaluate('plaid/dog_gaps', evaluation.zero, 3, seeds, factory=True)
        self.assertEqual((found['seeds'], found['seed']), (seeds, None))
        environments = VectorEnvironment('plaid/dog_gaps', 3, 1, sequences.train_seeds(3))
        self.assertEqual(environments.seeds.tolist(), sequences.train_seeds(3))
        with self.assertRaisesRegex(ValueError, '2 seeds for 3 episodes'):
            evaluation.evaluate('plaid/dog_gaps', evaluation.zero, 3, seeds[:2], factory=True)


class MetricsTest(parameterized.TestCase):
    SCORES = ((0.9, 0.2, 0.1), (0.6, 0.8, 0.3), (0.7, 0.5, 1.0))
    INITIAL = (0.1, 0.1, 0.1)

    def test_definitions(self):
        """Sums by hand."""
        found = sequences.metrics(self.SCORES, self.INITIAL)
        expected = {
            'average_performance': (0.7 + 0.5 + 1.0) / 3,
            'learning_accuracy': (0.9 + 0.8 + 1.0) / 3,
            'backward_transfer': ((0.7 - 0.9) + (0.5 - 0.8)) / 2,
            'forward_transfer': ((0.2 - 0.1) + (0.3 - 0.1)) / 2,
            'forgetting': ((0.9 - 0.7) + (0.8 - 0.5)) / 2,
        }
        self.assertCountEqual(found, expected)
        for name, value in expected.items():
            self.assertAlmostEqual(found[name], value, msg=name)

    def test_forgetting_is_from_the_best_of_all_stages(self):
        """Also from one before the task's own; a task that got better was not forgotten."""
        scores = np.array(self.SCORES)
        scores[0, 1] = 0.95
        self.assertAlmostEqual(sequences.forgetting(scores), (0.2 + 0.45) / 2)
        scores[2, :2] = 1.0
        self.assertLess(sequences.forgetting(scores), 0)

    def test_scores_whose_metrics_would_be_infinite(self):
        with self.assertRaisesRegex(
            ValueError, r'scores: -1e\+308 at \[0, 0\]; expected .* numbers of at most 1e.100'
        ):
            sequences.metrics(np.full((3, 3), -1e308), [0.0] * 3)
        with self.assertRaisesRegex(
            ValueError, r'initial: 1e\+308 at \[1\]; expected .* of at most 1e.100'
        ):
            sequences.metrics(self.SCORES, [0.0, 1e308, 0.0])

    def test_values_that_are_not_needed_may_be_missing(self):
        scores = np.array(self.SCORES)
        scores[np.triu_indices(3, 1)] = np.nan
        self.assertAlmostEqual(sequences.backward_transfer(scores), -0.25)
        with self.assertRaisesRegex(ValueError, 'not finite'):
            sequences.forward_transfer(scores, self.INITIAL)

    def test_learning_transfer_is_the_gain_in_mean_over_what_was_missing(self):
        """The curves have means 0.6 and 0.2 where both are known: (0.6 - 0.2) / (1 - 0.2)."""
        found = sequences.learning_transfer([0.5, 0.7, None, 0.9], [0.1, 0.3, 0.5, np.nan])
        self.assertAlmostEqual(found, 0.5)
        self.assertAlmostEqual(sequences.learning_transfer([0.4, 0.4], [0.5, 0.5]), -0.2)
        with self.assertRaisesRegex(ValueError, r'shape is \(1,\); expected \(2,\)'):
            sequences.learning_transfer([0.5], [0.1, 0.3])
        with self.assertRaisesRegex(ValueError, 'no point in common'):
            sequences.learning_transfer([0.5, None], [None, 0.1])
        with self.assertRaisesRegex(ValueError, 'expected less than 1'):
            sequences.learning_transfer([1.0], [1.0])

    @parameterized.parameters((((1, 2, 3), (4, 5, 6)),), (((1,),),), ((1, 2),))
    def test_a_matrix_that_is_not_square_is_rejected(self, scores):
        with self.assertRaisesRegex(ValueError, r'expected \(T, T\)'):
            sequences.average_performance(scores)
        with self.assertRaisesRegex(ValueError, 'initial: shape'):
            sequences.forward_transfer(self.SCORES, (0, 0))


class StageTest(parameterized.TestCase):
    def stage(self, budget=40, number=1, seed=0):
        return sequences.Stage(SHORT, number, budget, seed, 1)

    def test_steps_of_every_simulation_are_samples(self):
        stage = self.stage()
        environments, other = stage.environments(4), stage.environments(2, 'plaid/dog_flat')
        self.assertEqual(environments.spec.id, SHORT.ids[1])
        for each in (environments, other):
            each.reset()
        action = np.zeros((4, len(environments.action_map)))
        environments.step(action)
        environments.step(action, [0, 3])
        environments.step(action, np.array([True, False, False, False]))
        other.step(action[:2])
        self.assertEqual(stage.samples.tolist(), [2, 4 + 2 + 1, 0])
        self.assertEqual(stage.left, 40 - 9)

    def test_the_budget_cannot_be_exceeded(self):
        stage = self.stage(budget=10)
        environments = stage.environments(4)
        environments.reset()
        action = np.zeros((4, len(environments.action_map)))
        environments.step(action)
        environments.step(action)
        before = environments.task.world.time.copy()
        with self.assertRaisesRegex(
            sequences.BudgetExceededError,
            r'stage 1 \(PD_Dog2D_Steps.*4 more samples; expected at most 2, since 8 of 10',
        ):
            environments.step(action)
        np.testing.assert_array_equal(environments.task.world.time, before)
        self.assertEqual(stage.left, 2)
        environments.step(action, [0, 1])  # what is left may be used
        stage.finish()
        with self.assertRaisesRegex(sequences.BudgetExceededError, 'has ended'):
            environments.step(action, [0])

    def test_training_seeds_only(self):
        """Those of two calls, stages or runs differ, and none is a seed for tests."""
        drawn = [
            tuple(stage.environments(3).seeds.tolist())
            for stage in (self.stage(), self.stage(number=0), self.stage(seed=1))
            for _ in range(2)
        ]
        self.assertLen(set(drawn), 6)
        self.assertLess(max(map(max, drawn)), 2**31)
        environments = self.stage().environments(3)
        self.assertEqual(environments.seeds.tolist(), list(drawn[0]))
        environments.reset(seed=5)
        self.assertEqual(environments.seeds.tolist(), sequences.train_seeds(3, 5))
        for seeds in ([1, 2, 2**31], sequences.test_seeds(3)):
            with self.assertRaisesRegex(ValueError, 'is for tests; expected training seeds'):
                environments.seed(seeds)
        with self.assertRaisesRegex(ValueError, 'seed is None'):
            environments.seed(None)
        with self.assertRaisesRegex(ValueError, 'seed: expected none'):
            self.stage().environments(3, seed=1)
        with self.assertRaisesRegex(ValueError, "of the run 'PD_Dog2D_Walls_Terrain-v0'"):
            self.stage().environments(3, 'plaid/dog_walls')

    def test_curve(self):
        """Ten episodes of two steps fill the first half of the budget."""
        stage = self.stage(budget=40)
        environments = stage.environments(1, step_limit=2, autoreset='disabled')
        action = np.zeros((1, len(environments.action_map)))
        rewards = []
        for _ in range(10):
            environments.reset()
            rewards.append(sum(environments.step(action).reward[0] for _ in range(2)))
        limit = suite.find(SHORT.ids[1]).step_limit
        expected = [float(reward) / limit for reward in rewards] + [None] * 10
        self.assertEqual(stage.curve(), expected)
        # An episode that is broken off does not count.
        environments.reset()
        environments.step(action)
        environments.reset()
        for _ in range(2):
            environments.step(action)
        self.assertAlmostEqual(stage.curve()[11], expected[0], delta=0.5 * expected[0])
        self.assertIsNone(stage.curve()[10])


class Counter:
    """A learner that remembers where it was, and whose scores are made up."""

    def __init__(self, stop_at=None):
        self.history, self.stop_at = [], stop_at

    def train(self, stage):
        if len(self.history) == self.stop_at:
            raise KeyboardInterrupt
        self.history.append((stage.id, stage.budget, stage.seed))
        stage.spend(stage.number, 5)

    def policy(self):
        return len(self.history)


class Keeper(Counter):
    def save(self, folder):
        (folder / 'history.json').write_text(json.dumps(self.history))

    def load(self, folder):
        self.history = [tuple(row) for row in json.loads((folder / 'history.json').read_text())]


def made_up(cases, episodes, seeds, threads, executor):
    assert min(seeds) >= 2**31 and len(seeds) == episodes
    for spec, stages in cases:
        yield {'normalized_return': 0.1 * stages + 0.01 * SHORT.ids.index(spec.id)}


class RunTest(parameterized.TestCase):
    def setUp(self):
        super().setUp()
        self.folder = pathlib.Path(self.enterContext(tempfile.TemporaryDirectory()))
        self.path = self.folder / 'result.json'
        self.enterContext(mock.patch.object(evaluation, 'evaluate_all', made_up))
        self.enterContext(mock.patch.object(running.time, 'perf_counter', lambda: 0.0))

    def run_short(self, learner, **changes):
        return sequences.run(SHORT, learner, **{'budget': 7, 'path': self.path, **changes})

    def test_stages(self):
        learner = Counter()
        result = self.run_short(learner, seed=3)
        self.assertEqual(learner.history, [(id_, 7, 3) for id_ in SHORT.ids])
        np.testing.assert_allclose(result['initial'], [0, 0.01, 0.02])
        np.testing.assert_allclose(result['scores'], np.add.outer([0.1, 0.2, 0.3], [0, 0.01, 0.02]))
        self.assertEqual(result['samples'], [[5, 0, 0], [0, 5, 0], [0, 0, 5]])
        self.assertAlmostEqual(result['metrics']['forgetting'], -0.1)
        self.assertAlmostEqual(result['metrics']['forward_transfer'], 0.15)
        self.assertRegex(result['learner'], 'sequences_test:Counter$')
        self.assertEqual(sequences.read(self.path), result)
        self.assertEqual([path.name for path in self.folder.iterdir()], ['result.json'])
        # A finished result needs no learning.
        self.assertEqual(self.run_short(Counter(stop_at=0), seed=3), result)

    @parameterized.parameters(0, 1, 2)
    def test_a_stopped_run_resumes(self, stop_at):
        whole = self.run_short(Keeper(), path=self.folder / 'whole.json')
        with self.assertRaises(KeyboardInterrupt):
            self.run_short(Keeper(stop_at))
        with self.assertRaisesRegex(ValueError, 'metrics is missing; the run has not ended'):
            sequences.read(self.path)
        names = {path.name for path in self.folder.iterdir()} - {'whole.json', 'result.json'}
        self.assertEqual(names, {f'result.stage{stop_at}'} if stop_at else set())
        learner = Keeper()
        self.assertEqual(self.run_short(learner), whole)
        self.assertLen(learner.history, 3)
        self.assertCountEqual(
            [path.name for path in self.folder.iterdir()], ['whole.json', 'result.json']
        )

    def test_a_run_that_resumes_on_another_machine(self):
        def made(mujoco, cpu):
            return mock.patch.object(machine, 'made_with', lambda: {'mujoco': mujoco, 'cpu': cpu})

        with made('3.17.0', 'x86_64 AVX2'):
            part = self.run_short(Keeper(), stages=1)
        self.assertEqual((part['mujoco'], part['cpu']), ('3.17.0', 'x86_64 AVX2'))
        with (
            made('3.18.0', 'x86_64 AVX2'),
            self.assertRaisesRegex(ValueError, 'with another mujoco: 3.17.0; expected 3.18.0'),
        ):
            self.run_short(Keeper())
        for cpu in ('x86_64 AVX-512', 'x86_64 AVX2'):
            with made('3.17.0', cpu):
                result = self.run_short(Keeper(), stages=2 + (cpu == 'x86_64 AVX2'))
        self.assertEqual(result['cpu'], 'x86_64 AVX2, x86_64 AVX-512')
        with made('3.17.0', 'arm64'):  # a finished result is left alone
            self.assertEqual(self.run_short(Keeper()), result)

    def test_a_run_in_parts(self):
        whole = self.run_short(Keeper(), path=self.folder / 'whole.json')
        part = self.run_short(Keeper(), stages=2)
        self.assertEqual(part['scores'], whole['scores'][:2])
        self.assertNotIn('metrics', part)
        self.assertEqual(self.run_short(Keeper()), whole)
        with self.assertRaisesRegex(ValueError, 'stages is 4; expected a whole number from 1 to 3'):
            self.run_short(Keeper(), stages=4)

    def test_a_failed_save_leaves_the_stage_before(self):
        learner = Keeper()
        with (
            mock.patch.object(Keeper, 'save', side_effect=[None, OSError('full')]),
            self.assertRaisesRegex(OSError, 'full'),
        ):
            self.run_short(learner)
        self.assertLen(sequences.read(self.path, complete=False)['scores'], 1)
        self.assertCountEqual(
            [path.name for path in self.folder.iterdir()], ['result.json', 'result.stage1']
        )

    def test_two_runs_that_write_one_result(self):
        """The second one is refused as long as the first one lasts."""
        message = f'process {os.getpid()} writes .*result.json; wait for it, or choose another'
        with (
            mock.patch.object(Keeper, 'train', lambda *_: self.run_short(Keeper())),
            self.assertRaisesRegex(RuntimeError, message),
        ):
            self.run_short(Keeper())
        self.assertLen(self.run_short(Keeper())['scores'], 3)
        self.assertEqual([path.name for path in self.folder.iterdir()], ['result.json'])

    def test_folders_of_the_user_are_not_removed(self):
        for name in ('result.stage0', 'result.stage2'):
            (self.folder / name / 'own').mkdir(parents=True)
        with self.assertRaisesRegex(FileExistsError, 'result.stage2: exists; remove it, or choose'):
            self.run_short(Keeper())
        self.assertFalse(self.path.exists())
        (self.folder / 'result.stage2').rename(self.folder / 'moved')
        self.assertLen(self.run_short(Keeper())['scores'], 3)
        self.assertTrue((self.folder / 'result.stage0' / 'own').exists())

    def test_what_killed_runs_left_is_removed(self):
        """Also by a process with the same number, as in a container that is started again."""
        with self.assertRaises(KeyboardInterrupt):
            self.run_short(Keeper(1))
        (self.folder / 'result.stage2').mkdir()
        part = self.folder / f'.result.stage2.{os.getpid()}.part'
        part.mkdir()
        (part / 'history.json').write_text('half')
        (self.folder / '.result.json.lock').write_text('1234')
        self.assertLen(self.run_short(Keeper())['scores'], 3)
        self.assertEqual([path.name for path in self.folder.iterdir()], ['result.json'])
        (self.folder / 'result.stage1').mkdir()  # it was killed after its last stage
        self.run_short(Keeper())
        self.assertEqual([path.name for path in self.folder.iterdir()], ['result.json'])

    def test_a_learner_that_exceeds_its_budget_is_refused(self):
        class Greedy(Counter):
            def train(self, stage):
                super().train(stage)
                if stage.number == 1:
                    environments = stage.environments(3, num_threads=1)
                    environments.reset()
                    environments.step(np.zeros((3, len(environments.action_map))))

        with self.assertRaisesRegex(sequences.BudgetExceededError, '3 more samples.* at most 2'):
            self.run_short(Greedy())
        self.assertLen(sequences.read(self.path, complete=False)['scores'], 1)

    def test_no_samples_after_a_stage(self):
        class Late(Counter):
            def train(self, stage):
                self.stage = stage

            def policy(self):
                if hasattr(self, 'stage'):
                    self.stage.spend(0, 1)
                return 0

        with self.assertRaisesRegex(sequences.BudgetExceededError, 'steps in train only'):
            self.run_short(Late())

    def test_invalid_arguments_are_rejected(self):
        with self.assertRaises(KeyboardInterrupt):
            self.run_short(Counter(stop_at=1))
        with self.assertRaisesRegex(ValueError, '1 of 3 stages, and a Counter cannot resume'):
            self.run_short(Counter())
        with self.assertRaisesRegex(ValueError, 'another budget: 7; expected 8'):
            self.run_short(Counter(), budget=8)
        with self.assertRaisesRegex(ValueError, 'another learner: .*Counter; expected .*Keeper'):
            self.run_short(Keeper())
        with self.assertRaisesRegex(ValueError, 'budget is 0'):
            self.run_short(Counter(), budget=0)
        with self.assertRaisesRegex(ValueError, "'.txt'"):
            self.run_short(Counter(), path=self.folder / 'result.txt')
        with self.assertRaisesRegex(TypeError, 'expected the methods train and policy'):
            self.run_short(object())
        self.path.write_text('{"scores": 3}')
        with self.assertRaisesRegex(ValueError, 'result.json: format is missing'):
            self.run_short(Counter())


class ExecutorTest(absltest.TestCase):
    def test_scores_do_not_depend_on_the_executor(self):
        def still(observation):
            return np.zeros((len(observation), 20))

        expected = [
            evaluation.evaluate(id_, still, 4, sequences.test_seeds(4, 1))['normalized_return']
            for id_ in SHORT.ids
        ]
        self.assertEqual(sequences.scores(SHORT, still, 4, 1), expected)
        with concurrent.futures.ThreadPoolExecutor(2) as pool:
            self.assertEqual(sequences.scores(SHORT, still, 4, 1, executor=pool), expected)


def put(result, name, value):
    """Changes an entry, such as 'scores[1][2]'."""
    *path, last = (
        int(p) if p.isdigit() else p for p in name.replace('[', '.').replace(']', '').split('.')
    )
    for part in path:
        result = result[part]
    result[last] = value


class ResultTest(parameterized.TestCase):
    def setUp(self):
        super().setUp()
        self.enterContext(contextlib.chdir(self.enterContext(tempfile.TemporaryDirectory())))
        with mock.patch.object(evaluation, 'evaluate_all', made_up):
            self.result = sequences.run(SHORT, Counter(), 7, 'result.json')

    def changed(self, name, value, digest=True):
        result = copy.deepcopy(self.result)
        put(result, name, value)
        if digest:
            result['digest'] = results.digest(result)
        return result

    @parameterized.parameters(
        ('format', 'other', "format is 'other'; expected 'trl_suite sequence 1'"),
        ('sequence', 'plaid_dog', r"ids is \['PD_Dog2D_Flat.*expected \['PD_Dog2D_Flat.*Incline"),
        ('ids', ['PD_Dog2D_Flat_Terrain-v0'], 'expected two or more environments'),
        ('ids', 'flat', "ids is 'flat'; expected a list of strings"),
        ('budget', 14.5, 'budget is 14.5; expected a whole number at least 1'),
        ('budget', 4, r'samples\[0\] is \[5, 0, 0\], in total 5; .* at most 4, the budget'),
        ('seed', -1, 'seed is -1; expected a whole number at least 0'),
        ('initial', [0, 0], 'initial: 2 entries; expected 3 numbers'),
        ('scores', [], 'scores: 0 stages; expected 3'),
        ('scores[1]', [0.1, 0.2], r'scores\[1\]: 2 entries; expected 3 numbers'),
        ('scores[1][2]', 'high', r"scores\[1\]\[2\] is 'high'; expected a number"),
        ('scores[1][2]', float('nan'), r'scores\[1\]\[2\] is nan; expected a number'),
        ('scores[1][2]', 1.01, r'scores\[1\]\[2\] is 1.01; expected a number at most 1'),
        ('scores[2][1]', 0.9, r'metrics.average_performance is 0.31.*; expected 0.50'),
        ('samples[1][1]', 8, r'samples\[1\] is \[0, 8, 0\], in total 8; .* at most 7'),
        ('samples[1][1]', 2.5, r'samples\[1\].*expected whole numbers'),
        ('samples[1][1]', -1, r'samples\[1\]\[1\] is -1; .* at least 0'),
        ('curves[0]', [], r'curves\[0\]: 0 entries; expected 20 numbers'),
        ('seconds', [1], 'seconds: 1 stages; expected 3'),
        ('metrics', {}, 'metrics: expected average_performance'),
        ('metrics.forgetting', -0.2, 'metrics.forgetting is -0.2; expected -0.1'),
        ('metrcs', 1, "unknown field 'metrcs'; did you mean 'metrics'"),
    )  # fmt: skip
    def test_errors_name_the_field_and_what_was_expected(self, name, value, message):
        with self.assertRaisesRegex(ValueError, message):
            sequences.check(self.changed(name, value))

    @parameterized.parameters(
        'learner', 'trl_suite', 'seed', 'episodes', 'scores[0][2]', 'samples[0][1]', 'seconds[1]'
    )
    def test_every_edit_changes_the_digest(self, name):
        """Also of entries that no metric uses."""
        sequences.check(self.result)
        value = 'other' if name in ('learner', 'trl_suite') else 1
        with self.assertRaisesRegex(ValueError, 'digest is .* changed after the run'):
            sequences.check(self.changed(name, value, digest=False))

    def test_what_it_was_made_with_may_be_missing(self):
        self.assertEqual(
            {name: self.result[name] for name in results.MADE_WITH}, machine.made_with()
        )
        for name in results.MADE_WITH:
            with self.assertRaisesRegex(ValueError, f'{name} is 4; expected a string'):
                sequences.check(self.changed(name, 4))
            del self.result[name]
        sequences.check(self.changed('seed', 0))

    def test_missing_fields(self):
        for name in (*sequences.BENCHMARK.fields, 'metrics'):
            result = {key: value for key, value in self.result.items() if key != name}
            with self.assertRaisesRegex(ValueError, f'^{name} is missing'):
                sequences.check(result)
        for other in (3, [], None):
            with self.assertRaisesRegex(ValueError, 'expected an object with format'):
                sequences.check(other)

    def test_what_is_comparable(self):
        notes = sequences.departures(self.result)
        self.assertLen(notes, 2)
        self.assertStartsWith(notes[0], 'sequence is short, not plaid_biped or')
        self.assertEqual(notes[1], 'budget is 7, not 100000 or 1000000')
        same = {**self.result, 'sequence': 'plaid_dog', 'budget': 100_000}
        self.assertEqual(sequences.departures(same), [])
        self.assertEqual(sequences.departures({**same, 'seed': 3}), ['seed is 3, not 0 or 1 or 2'])


MODULE = """
import numpy as np

class Nothing:
    def __init__(self, sequence, seed):
        self.size = 11

    def train(self, stage):
        environments = stage.environments(4)
        environments.reset()
        environments.step(np.zeros((4, self.size)))

    def policy(self):
        return lambda observation: np.zeros((len(observation), self.size))
"""


class CommandTest(cli_test.CommandTest):
    def test_run_and_check(self):
        pathlib.Path('my_learner.py').write_text(MODULE)
        self.addCleanup(setattr, sys, 'path', list(sys.path))
        arguments = (
            'sequences', 'run', 'plaid_biped', '--learner', 'my_learner:Nothing', '--budget', '1e2',
            '--episodes', '1', '--threads', '1',
        )  # fmt: skip
        out = self.output(*arguments)
        self.assertRegex(out, r'after PD_Biped2D_Gaps_Terrain-v0 +(0\.\d{3} ?){5}')
        self.assertRegex(out, r'forgetting +0.000')
        result = sequences.read('result.json')
        self.assertEqual((result['budget'], result['learner']), (100, 'my_learner:Nothing'))
        self.assertEqual(np.trace(result['samples']), np.sum(result['samples']))
        self.assertEqual(np.sum(result['samples']), 5 * 4)
        out = self.output('sequences', 'check', 'result.json')
        made = f'mujoco {result["mujoco"]}, cpu {result["cpu"]}'
        self.assertRegex(
            out, f'my_learner:Nothing, plaid_biped.*, {made}: not comparable: budget is 100, not'
        )
        result['learner'] = '\x1b]0;title\x07a\nvalid and comparable'
        result['digest'] = results.digest(result)
        pathlib.Path('forged.json').write_text(json.dumps(result))
        out = self.output('sequences', 'check', 'forged.json')
        self.assertStartsWith(out, r'forged.json: \x1b]0;title\x07a\nvalid and comparable, plaid')
        self.assertEqual(out.count('\n'), 1)
        text = pathlib.Path('result.json').read_text()
        pathlib.Path('edited.json').write_text(text.replace('"budget": 100', '"budget": 101'))
        self.assert_refused(
            'edited.json: digest is .* the file was changed', 'sequences', 'check', 'edited.json'
        )
        self.assert_refused(
            "unknown learner of the module my_learner: 'Nothin'; did you mean 'Nothing'",
            'sequences', 'run', 'plaid_biped', '--learner', 'my_learner:Nothin',
        )  # fmt: skip
        for other in ('.a:C', 'a..b:C', 'a b:C'):
            self.assert_refused(
                f"--learner is '{other}'; expected module:Class", 'sequences', 'run', 'plaid_biped',
                '--learner', other,
            )  # fmt: skip
        for other in ('os:path', 'pathlib:Path'):
            self.assert_refused(
                f"--learner is '{other}', which has no train and policy; expected a class",
                'sequences', 'run', 'plaid_biped', '--learner', other,
            )  # fmt: skip
        self.assert_refused(
            "'my_learner'; expected module:Class",
            'sequences', 'run', 'plaid_biped', '--learner', 'my_learner',
        )  # fmt: skip
        self.assert_refused(
            "--budget is 'tiny'; expected small, full or a number",
            *arguments[:5],
            '--budget',
            'tiny',
        )

    def test_list(self):
        out = self.output('sequences', 'list')
        for name in sequences.SEQUENCES:
            self.assertIn(f'{name} ', out)


class BaselinesTest(parameterized.TestCase):
    """With small networks, in which every stage makes some updates."""

    def setUp(self):
        super().setUp()
        self.enterContext(contextlib.chdir(self.enterContext(tempfile.TemporaryDirectory())))
        self.enterContext(mock.patch.object(continual, 'NUM_ENVS', 8))
        settings = continual.settings.settings_for
        small = {'hidden': (16, 16), 'minibatch': 128, 'cloning_epochs': 2}
        self.enterContext(
            mock.patch.object(
                continual.settings, 'settings_for',
                lambda id_, **k: settings(id_, **{**k, **small}),
            )
        )  # fmt: skip
        # Quicker than episodes, and as telling: what the network has become.
        self.enterContext(
            mock.patch.object(
                evaluation, 'evaluate_all',
                lambda cases, *_, executor: [
                    {'normalized_return': float(np.abs(policy.weights[1]).mean())}
                    for _, policy in cases
                ],
            )
        )  # fmt: skip

    def run_short(self, kind, name, **changes):
        learner = kind(SHORT, 0)
        return learner, sequences.run(
            SHORT, learner, **{'budget': 600, 'path': f'{name}.json', 'episodes': 1, **changes}
        )

    @parameterized.parameters(
        (continual.Scratch, np.eye(3)),
        (continual.FineTuning, np.eye(3)),
        (continual.EWC, np.eye(3)),
        (continual.MultiTask, np.ones((3, 3))),
        (continual.Plaid, np.tri(3)),
    )
    @pytest.mark.slow  # .ci/run runs these
    def test_every_stage_trains_in_its_own_environments(self, kind, expected):
        """The samples of a stage are those of its terrain, or of those that the method needs."""
        _, result = self.run_short(kind, 'result')
        found = np.array(result['samples'])
        np.testing.assert_array_equal(found > 0, expected.astype(bool))
        self.assertEqual(found.sum(1).max(), found.sum(1).clip(500, 600).max())
        self.assertEqual(sequences.read('result.json'), result)
        self.assertNotEqual(result['scores'][0], result['initial'])

    @parameterized.parameters(continual.FineTuning, continual.EWC, continual.Plaid)
    @pytest.mark.slow
    def test_a_stopped_run_resumes_exactly(self, kind):
        _, whole = self.run_short(kind, 'whole')
        train = kind.train

        def stopped(learner, stage):
            if stage.number == 2:
                raise KeyboardInterrupt
            train(learner, stage)

        with mock.patch.object(kind, 'train', stopped), self.assertRaises(KeyboardInterrupt):
            self.run_short(kind, 'parts')
        _, parts = self.run_short(kind, 'parts')
        for name in ('initial', 'scores', 'samples', 'curves', 'metrics'):
            self.assertEqual(parts[name], whole[name], name)

    def test_scratch_forgets_everything(self):
        """Trained twice on one environment, it begins with the same weights."""
        learner = continual.Scratch(SHORT, 0)
        first = learner.policy().weights[1]
        learner.train(sequences.Stage(SHORT, 0, 600, 0, 1))
        self.assertFalse(np.array_equal(learner.policy().weights[1], first))
        learner.train(sequences.Stage(SHORT, 1, 10, 0, 1))  # too few samples for an update
        np.testing.assert_array_equal(learner.policy().weights[1], first)

    def test_fisher_information_of_a_linear_policy(self):
        """For a mean W s and deviations sigma it is E[s_j^2] / sigma_i^2 for W[i, j]."""
        learner = continual.EWC(SHORT, 0)
        trainer = learner.trainer
        trainer.policy = torch.nn.Linear(2, len(trainer.log_std), bias=False)
        with torch.no_grad():
            trainer.log_std.copy_(torch.linspace(-1, 0, len(trainer.log_std)))
        observations = torch.tensor([[1.0, 2.0], [3.0, 0.0]]).repeat(5000, 1)
        with mock.patch.object(continual, 'FISHER_SAMPLES', len(observations)):
            learner.consolidate(observations)
        squares = torch.tensor([[5.0, 2.0]])
        expected = squares / trainer.log_std.detach().exp()[:, None] ** 2
        torch.testing.assert_close(learner.fisher['weight'], expected, rtol=0.1, atol=0.0)
        # Half the sum of importance times squared change.
        with torch.no_grad():
            trainer.policy.weight[0, 1] += 0.1
        penalty = continual.STRENGTH * 0.5 * learner.fisher['weight'][0, 1] * 0.01
        torch.testing.assert_close(learner.penalty().detach(), penalty)

    def test_distillation_gives_each_expert_its_terrain(self):
        """Two experts with constant actions, on terrains that the labels tell apart."""
        learner = continual.Plaid(SHORT, 0)
        stage = sequences.Stage(SHORT, 1, 600, 0, 1)
        environments = continual.together(stage, SHORT.ids[:2])
        labels = []
        size = len(environments.action_map)
        experts = [lambda o, a=a: np.full((len(o), size), a) for a in (0.5, -2.0)]
        learner.trainer.fit = lambda seen, actions: labels.append(
            (sum(map(len, seen)), np.concatenate(actions))
        )
        continual.distil(learner.trainer, environments, experts, 600, rounds=3)
        self.assertEqual([count for count, _ in labels], [200, 400, 600])
        each = labels[-1][1].reshape(-1, 2, 4, size)
        np.testing.assert_array_equal(each[:, 0], 0.5)
        np.testing.assert_array_equal(each[:, 1], -1.0)
        self.assertEqual(stage.samples.tolist(), [300, 300, 0])


if __name__ == '__main__':
    absltest.main()
