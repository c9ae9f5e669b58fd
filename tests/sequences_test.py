"""Sequences and the benchmark, which are courses of `trl_suite.runs`: stages, runs and results.

`benchmark_test` has what only the benchmark does.
"""

import contextlib
import copy
import json
import os
import pathlib
import shutil
import sys
from unittest import mock

import numpy as np
import pytest
import torch
from absl.testing import absltest, parameterized
from helpers import FolderTest, assert_refused
from programs import CommandTest, run

from trl_suite import benchmark, evaluation, runs, sequences, suite
from trl_suite.runs import results, running
from trl_suite.util import machine
from trl_suite.vector import VectorEnvironment

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / 'training'))
import continual

SHORT = sequences.Sequence('short', ('plaid/dog_flat', 'plaid/dog_steps', 'plaid/dog_gaps'))
ID = 'PD_Biped2D_Gaps_Terrain-v0'
# Both benchmarks, a course of each, and the samples per environment of a short run.
SEQUENCES = sequences.BENCHMARK, SHORT, 7
BENCHMARK = benchmark.BENCHMARK, benchmark.get(ID), 200


class CatalogueTest(parameterized.TestCase):
    @parameterized.parameters(
        *(n for n in sequences.SEQUENCES if n.startswith(('plaid_long', 'gaits')))
    )
    def test_one_network_serves_all(self, name):
        sequence = sequences.get(name)
        tasks = [suite.build_task(suite.find(id_)) for id_ in sequence.ids]
        shapes = {(repr([*task.blocks.items()]), tuple(task.action_map.names)) for task in tasks}
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

    def test_unknown_names_are_refused(self):
        def mine(*ids):
            return lambda: sequences.Sequence('mine', ids)

        assert_refused(
            self,
            (lambda: sequences.Sequence(3, SHORT.ids), 'name is 3; expected a string'),
            (lambda: sequences.get('plaid_bog'), "'plaid_bog'; did you mean 'plaid_dog'"),
            (lambda: benchmark.get(ID[:-1]), f"of the benchmark '{ID[:-1]}'.*did you mean"),
            (mine('PD_Bog2D_Gaps_Terrain-v0'), "unknown environment 'PD_Bog2D_Gaps_Terrain-v0'"),
            (mine('plaid/dog_flat', 'PD_Dog2D_Flat_Terrain-v0'), 'each once'),
        )


class SeedsTest(absltest.TestCase):
    def test_train_and_test_seeds_are_disjoint(self):
        train, test = runs.train_seeds(2000, (1, 2)), runs.test_seeds(2000, (1, 2))
        self.assertLess(max(train), 2**31)
        self.assertBetween(min(test), 2**31, max(test))
        self.assertLess(max(test), 2**32)
        self.assertGreater(len(set(train)), 1990)
        self.assertEqual(train[:5], runs.train_seeds(5, (1, 2)))
        self.assertNotEqual(train[:5], runs.train_seeds(5, (1, 3)))


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

    def test_learning_transfer_is_the_gain_in_mean_over_what_was_missing(self):
        """The curves have means 0.6 and 0.2 where both are known: (0.6 - 0.2) / (1 - 0.2)."""
        found = sequences.learning_transfer([0.5, 0.7, None, 0.9], [0.1, 0.3, 0.5, np.nan])
        self.assertAlmostEqual(found, 0.5)
        self.assertAlmostEqual(sequences.learning_transfer([0.4, 0.4], [0.5, 0.5]), -0.2)

    def test_values_that_are_not_needed_may_be_missing(self):
        scores = np.array(self.SCORES)
        scores[np.triu_indices(3, 1)] = np.nan
        self.assertAlmostEqual(sequences.backward_transfer(scores), -0.25)
        with self.assertRaisesRegex(ValueError, 'not finite'):
            sequences.forward_transfer(scores, self.INITIAL)

    @parameterized.parameters(
        ('metrics', np.full((3, 3), -1e308), [0.0] * 3,
         r'scores: -1e\+308 at \[0, 0\]; expected .* numbers of at most 1e.100'),
        ('metrics', SCORES, [0.0, 1e308, 0.0], r'initial: 1e\+308 at \[1\]; expected .* of at most 1e.100'),
        ('average_performance', ((1, 2, 3), (4, 5, 6)), r'expected \(T, T\)'),
        ('average_performance', ((1,),), r'expected \(T, T\)'),
        ('average_performance', (1, 2), r'expected \(T, T\)'),
        ('forward_transfer', SCORES, (0, 0), 'initial: shape'),
        ('metrics', SCORES, [0.0, np.nan, 0.0], 'initial: the metric uses an entry'),
        ('learning_transfer', ['a'], [0.1], 'curve: expected an array of numbers'),
        ('learning_transfer', [0.5], [0.1, 0.3], r'shape is \(1,\); expected \(2,\)'),
        ('learning_transfer', [0.5, None], [None, 0.1], 'no point in common'),
        ('learning_transfer', [1.0], [1.0], 'expected less than 1'),
    )  # fmt: skip
    def test_invalid_arguments_are_rejected(self, name, *arguments):
        *arguments, message = arguments
        with self.assertRaisesRegex(ValueError, message):
            getattr(sequences, name)(*arguments)


class StageTest(absltest.TestCase):
    def stage(self, budget=40, number=1, seed=0):
        return runs.Stage(SHORT, number, budget, seed, 1)

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
            runs.BudgetExceededError,
            r'stage 1 \(PD_Dog2D_Steps.*4 more samples; expected at most 2, since 8 of 10',
        ):
            environments.step(action)
        np.testing.assert_array_equal(environments.task.world.time, before)
        self.assertEqual(stage.left, 2)
        environments.step(action, [0, 1])  # what is left may be used
        stage.finish()
        with self.assertRaisesRegex(runs.BudgetExceededError, 'has ended'):
            environments.step(action, [0])

    def test_steps_that_are_refused_are_free(self):
        stage = self.stage()
        environments = stage.environments(2, autoreset='disabled', step_limit=1)
        action = np.zeros((2, len(environments.action_map)))
        step = environments.step
        assert_refused(
            self,
            (lambda: step(action), 'before the first reset'),
            (lambda: (environments.reset(), step(action[:1])), 'action'),
            (lambda: step(np.full_like(action, np.nan)), 'action'),
            (lambda: (step(action), step(action)), 'has ended'),
            (lambda: (environments.close(), step(action)), 'closed'),
            error=(ValueError, RuntimeError),
        )
        self.assertEqual(stage.samples.sum(), 2)

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
        self.assertEqual(environments.seeds.tolist(), runs.train_seeds(3, 5))
        foreign = VectorEnvironment(SHORT.ids[1], 3, seed=runs.test_seeds(3))
        foreign.reset()
        make, for_tests = self.stage().environments, 'is for tests; expected training seeds'
        assert_refused(
            self,
            (lambda: environments.seed([1, 2, 2**31]), for_tests),
            (lambda: environments.seed(runs.test_seeds(3)), for_tests),
            (lambda: environments.reset(seed=2**31), for_tests),
            (lambda: environments.set_state(foreign.get_state()), for_tests),
            (lambda: environments.copy_from(foreign, [0], [1]), for_tests),
            (lambda: environments.seed(None), 'seed is None'),
            (lambda: environments.seed(1.5), 'seed is 1.5; expected a whole number'),
            (lambda: environments.seed(-1), 'seed is -1; expected a whole number at least 0'),
            (lambda: make(3, seed=1), 'seed: expected none'),
            (lambda: make(3, 'plaid/dog_walls'), "of the run 'PD_Dog2D_Walls_Terrain-v0'"),
        )
        with self.assertRaisesRegex(TypeError, 'other is Environment; expected VectorEnvironment'):
            environments.copy_from(suite.make(SHORT.ids[0]), [0], [0])

    def test_curve(self):
        """Ten episodes of two steps, their limit, fill the first half of the budget."""
        stage = self.stage(budget=40)
        environments = stage.environments(1, step_limit=2, autoreset='disabled')
        action = np.zeros((1, len(environments.action_map)))
        rewards = []
        for _ in range(10):
            environments.reset()
            rewards.append(sum(environments.step(action).reward[0] for _ in range(2)))
        expected = [float(reward) / 2 for reward in rewards] + [None] * 10
        self.assertEqual(stage.curve(), expected)
        # An episode that is broken off does not count.
        environments.reset()
        environments.step(action)
        environments.reset()
        for _ in range(2):
            environments.step(action)
        self.assertAlmostEqual(stage.curve()[11], expected[0], delta=0.5 * expected[0])
        self.assertIsNone(stage.curve()[10])

    def test_curves_of_episodes_that_are_continued(self):
        """A copy has the rewards of the original; those before a state are not known."""
        stage = self.stage(budget=20)
        environments, others = (stage.environments(1, step_limit=2) for _ in range(2))
        action = np.zeros((1, len(environments.action_map)))
        environments.reset()
        others.reset()
        first = environments.step(action).reward[0]
        state = environments.get_state()
        others.copy_from(environments, [0], [0])
        second = others.step(action).reward[0]
        environments.set_state(state)
        environments.step(action)
        expected = [None] * 20
        expected[1] = float(first + second) / 2
        self.assertEqual(stage.curve(), expected)


class Counter:
    """A learner that counts its stages, each of which takes 5 samples; it cannot be resumed."""

    def __init__(self, stop_at=None):
        self.history, self.stop_at = [], stop_at

    def train(self, stage):
        if len(self.history) == self.stop_at:
            raise KeyboardInterrupt
        self.history.append([stage.id, stage.budget, stage.seed])
        stage.spend(stage.ids.index(stage.id), 5)

    def policy(self):
        return len(self.history)


class Keeper(Counter):
    def save(self, folder):
        (folder / 'history.json').write_text(json.dumps(self.history))

    def load(self, folder):
        self.history = json.loads((folder / 'history.json').read_text())


def made_up(cases, episodes, seeds, threads, executor):
    """Scores instead of those of `evaluation.evaluate_all`: 0.04 more after every stage."""
    assert min(seeds) >= 2**31 and len(seeds) == episodes
    places = [SHORT.ids.index(spec.id) if spec.id in SHORT.ids else 0 for spec, _ in cases]
    return [
        {'normalized_return': 0.04 * stages + 0.01 * place, 'cpu': 'x86_64 elsewhere'}
        for place, (_, stages) in zip(places, cases, strict=True)
    ]


class RunCase(FolderTest):
    def setUp(self):
        super().setUp()
        self.path = self.folder / 'result.json'
        self.tests = self.enterContext(
            mock.patch.object(evaluation, 'evaluate_all', side_effect=made_up)
        )
        self.enterContext(mock.patch.object(running.time, 'perf_counter', lambda: 0.0))

    def run_short(self, learner, which=SEQUENCES, **changes):
        of, course, budget = which
        return of.run(course, learner, **{'budget': budget, 'path': self.path, **changes})


class RunTest(RunCase):
    def test_stages_of_a_sequence(self):
        learner, executor = Counter(), object()
        result = self.run_short(learner, seed=3, episodes=2, num_threads=5, executor=executor)
        self.assertEqual(learner.history, [[id_, 7, 3] for id_ in SHORT.ids])
        # Of this process, and where the executor tested.
        self.assertEqual(result['cpu'], f'{machine.cpu_class()}, x86_64 elsewhere')
        tests = [mock.call(mock.ANY, 2, runs.test_seeds(2, 3), 5, executor=executor)] * 4
        self.assertEqual(self.tests.call_args_list, tests)
        np.testing.assert_allclose(result['initial'], [0, 0.01, 0.02])
        np.testing.assert_allclose(
            result['scores'], np.add.outer([0.04, 0.08, 0.12], [0, 0.01, 0.02])
        )
        self.assertEqual(result['samples'], [[5, 0, 0], [0, 5, 0], [0, 0, 5]])
        self.assertAlmostEqual(result['metrics']['forgetting'], -0.04)
        self.assertAlmostEqual(result['metrics']['forward_transfer'], 0.06)
        self.assertRegex(result['learner'], 'sequences_test:Counter$')
        self.assertEqual(sequences.read(self.path), result)
        self.assert_only('result.json')
        # A finished result needs no learning.
        self.assertEqual(self.run_short(Counter(stop_at=0), seed=3, episodes=2), result)

    def test_parts_of_the_benchmark(self):
        """Of 10 samples each; what is left of one is for the next."""
        learner = Counter()
        result = self.run_short(learner, BENCHMARK)
        self.assertEqual(learner.history, [[ID, 10 + 5 * i, 0] for i in range(20)])
        self.assertEqual(result['samples'], [[5]] * 20)
        last, mean = (benchmark.normalised(ID, score) for score in (0.8, 0.04 * 10.5))
        self.assertAlmostEqual(result['metrics']['score'], last)
        self.assertAlmostEqual(result['metrics']['mean_score'], mean)
        self.assertEqual(benchmark.read(self.path), result)
        self.assert_only('result.json')

    @parameterized.parameters(*((SEQUENCES, i) for i in (0, 1, 2)), (BENCHMARK, 0), (BENCHMARK, 13))
    def test_a_stopped_run_resumes(self, which, stop_at):
        whole = self.run_short(Keeper(), which, path=self.folder / 'whole.json')
        with self.assertRaises(KeyboardInterrupt):
            self.run_short(Keeper(stop_at), which)
        with self.assertRaisesRegex(ValueError, 'metrics is missing; the run has not ended'):
            which[0].read(self.path)
        state = [f'result.stage{stop_at}'] if stop_at else []
        self.assert_only('whole.json', 'result.json', *state)
        learner = Keeper()
        self.assertEqual(self.run_short(learner, which), whole)
        self.assertLen(learner.history, len(whole['scores']))
        self.assert_only('whole.json', 'result.json')

    def test_a_run_that_resumes_on_another_machine(self):
        def made(mujoco, cpu):
            return mock.patch.object(machine, 'made_with', lambda: {'mujoco': mujoco, 'cpu': cpu})

        with made('3.17.0', 'x86_64 AVX2'):
            part = self.run_short(Keeper(), stages=1)
        self.assertLen(part['scores'], 1)
        self.assertNotIn('metrics', part)
        self.assertEqual((part['mujoco'], part['cpu']), ('3.17.0', 'x86_64 AVX2'))
        with (
            made('3.18.0', 'x86_64 AVX2'),
            self.assertRaisesRegex(ValueError, 'another run: mujoco is 3.17.0; expected 3.18.0'),
        ):
            self.run_short(Keeper())
        for cpu in ('x86_64 AVX-512', 'x86_64 AVX2'):
            with made('3.17.0', cpu):
                result = self.run_short(Keeper(), stages=2 + (cpu == 'x86_64 AVX2'))
        self.assertEqual(result['cpu'], 'x86_64 AVX2, x86_64 AVX-512')
        with made('3.18.0', 'arm64'):  # a finished result is left alone
            self.assertEqual(self.run_short(Keeper()), result)

    def test_a_failed_save_leaves_the_stage_before(self):
        with (
            mock.patch.object(Keeper, 'save', side_effect=[None, OSError('full')]),
            self.assertRaisesRegex(OSError, 'full'),
        ):
            self.run_short(Keeper())
        self.assertLen(sequences.read(self.path, complete=False)['scores'], 1)
        self.assert_only('result.json', 'result.stage1')
        (self.folder / 'result.stage1').rename(self.folder / 'lost')
        with self.assertRaisesRegex(
            FileNotFoundError, "no such folder, the learner's state after 1"
        ):
            self.run_short(Keeper())

    def test_two_runs_that_write_one_result(self):
        """The second one is refused as long as the first one lasts."""
        message = f'process {os.getpid()} writes .*result.json; wait for it, or choose another'
        with (
            mock.patch.object(Keeper, 'train', lambda *_: self.run_short(Keeper())),
            self.assertRaisesRegex(RuntimeError, message),
        ):
            self.run_short(Keeper())
        self.assertLen(self.run_short(Keeper())['scores'], 3)
        self.assert_only('result.json')

    @parameterized.parameters('result.stage2', 'result.npz')
    def test_files_of_the_user_are_not_removed(self, name):
        for each in ('result.stage0', name):
            (self.folder / each / 'own').mkdir(parents=True)
        with self.assertRaisesRegex(FileExistsError, f'{name}: exists; remove it, or choose'):
            self.run_short(Keeper())
        self.assertFalse(self.path.exists())
        (self.folder / name).rename(self.folder / 'moved')
        self.assertLen(self.run_short(Keeper())['scores'], 3)
        self.assertTrue((self.folder / 'result.stage0' / 'own').exists())

    def test_what_killed_runs_left_is_removed(self):
        with self.assertRaises(KeyboardInterrupt):
            self.run_short(Keeper(1))
        shutil.copytree(self.folder / 'result.stage1', self.folder / 'result.stage2')
        shutil.copytree(self.folder / 'result.stage1', self.folder / 'kept')
        (self.folder / '.result.json.lock').write_text('1234')
        self.assertLen(self.run_short(Keeper())['scores'], 3)
        self.assert_only('result.json', 'kept')
        (self.folder / 'kept').rename(self.folder / 'result.stage1')  # killed after its last stage
        self.run_short(Keeper())
        self.assert_only('result.json')

    @parameterized.parameters(1, 2)
    def test_folders_of_the_user_are_not_removed(self, stage):
        with self.assertRaises(KeyboardInterrupt):
            self.run_short(Keeper(2))
        own = self.folder / f'result.stage{stage}'
        shutil.rmtree(own, ignore_errors=True)
        own.mkdir()
        (own / 'thesis.tex').touch()
        with contextlib.suppress(OSError):  # also of the learner, which does not find its state
            self.run_short(Keeper())
        self.assertTrue((own / 'thesis.tex').exists())

    @parameterized.parameters('link', 'text', 'pipe')
    def test_a_lock_file_that_the_suite_has_not_made(self, kind):
        own, lock = self.folder / 'own', self.folder / '.result.json.lock'
        own.write_text('my notes\n')
        {
            'link': lambda: lock.symlink_to(own),
            'text': lambda: lock.write_text('my notes\n'),
            'pipe': lambda: os.mkfifo(lock),
        }[kind]()
        with self.assertRaisesRegex(OSError, r'\.result\.json\.lock'):
            self.run_short(Keeper())
        self.assertTrue(os.path.lexists(lock))
        for path in (own, *([lock] if kind == 'text' else [])):
            self.assertEqual(path.read_text(), 'my notes\n')

    def test_samples_beyond_the_budget_or_after_a_stage_are_refused(self):
        class Greedy(Counter):
            def train(self, stage):
                super().train(stage)
                stage.spend(0, 3 * stage.number)

        class Late(Counter):
            def train(self, stage):
                super().train(stage)
                self.stage = stage

            def policy(self):
                if len(self.history) == 2:
                    self.stage.spend(0, 1)
                return super().policy()

        for kind, message in (
            (Greedy, '3 more samples.* at most 2'),
            (Late, 'steps in train only'),
        ):
            with self.assertRaisesRegex(runs.BudgetExceededError, message):
                self.run_short(kind())
            self.assertLen(sequences.read(self.path, complete=False)['scores'], 1)
            self.path.unlink()

    def test_invalid_arguments_are_rejected(self):
        with self.assertRaises(KeyboardInterrupt):
            self.run_short(Counter(stop_at=1))

        def run(learner, **changes):
            return lambda: self.run_short(learner, **changes)

        assert_refused(
            self,
            (run(Counter()), '1 of 3 stages, and a Counter cannot resume'),
            (run(Counter(), budget=8), 'another run: budget is 7; expected 8'),
            (run(Keeper()), 'another run: learner is .*Counter; expected .*Keeper'),
            (run(Counter(), budget=0), 'budget is 0'),
            (run(Counter(), stages=4), 'stages is 4; expected a whole number from 1 to 3'),
            (run(Counter(), stages=2), 'stages is 2; expected 3, since a Counter cannot resume'),
            (run(Counter(), path=self.folder / 'result.txt'), "'.txt'"),
            (
                lambda: sequences.run(sequences.Sequence('mine', SHORT.ids, parts=2), Counter()),
                "'mine' has parts=2; expected 1",
            ),
            (
                lambda: sequences.run(sequences.Sequence('plaid_dog', SHORT.ids), Counter()),
                "'plaid_dog' is a sequence of the benchmark with other contents",
            ),
            (
                lambda: sequences.run(
                    sequences.Sequence('mine', (SHORT.ids[0], 'plaid/biped_flat')), Counter()
                ),
                "'mine': PD_Biped2D_Flat_Terrain-v0 has other observations or actions",
            ),
        )
        for wrong in (object(), Counter):
            with self.assertRaisesRegex(
                TypeError, 'expected an object with methods train and policy'
            ):
                self.run_short(wrong)
        self.path.write_text('{"scores": 3}')
        assert_refused(self, (run(Counter()), 'result.json: format is missing'))


def changed(result, name, value):
    """Returns a copy with another value of an entry, such as 'scores[1][2]', and its digest."""
    *path, last = (
        int(p) if p.isdigit() else p for p in name.replace('[', '.').replace(']', '').split('.')
    )
    result = copy.deepcopy(result)
    part = result
    for each in path:
        part = part[each]
    part[last] = value
    return {**result, 'digest': results.digest(result)}


class ResultTest(RunCase):
    def setUp(self):
        super().setUp()
        self.result = self.run_short(Counter())

    @parameterized.parameters(
        ('format', 'other', "format is 'other'; expected 'trl_suite sequence 1'"),
        ('sequence', 'plaid_dog', r"ids is \['PD_Dog2D_Flat.*expected \['PD_Dog2D_Flat.*Incline"),
        ('ids', ['PD_Dog2D_Flat_Terrain-v0'], 'expected two or more environments'),
        ('ids', 'flat', "ids is 'flat'; expected a list of strings"),
        ('budget', 14.5, 'budget is 14.5; expected a whole number from 1 to'),
        ('episodes', 10**9, 'episodes is 1000000000; expected a whole number from 1 to 1000000'),
        ('learner', 'a, b', "learner is 'a, b'; expected module:Class"),
        ('trl_suite', None, 'trl_suite is None; expected a string'),
        ('budget', 4, r'samples\[0\] is \[5, 0, 0\], in total 5; .* at most 4, the budget'),
        ('seed', -1, 'seed is -1; expected a whole number from 0 to'),
        ('initial', [0, 0], 'initial: 2 entries; expected 3 numbers'),
        ('scores', [], 'scores: 0 stages; expected 3'),
        ('scores[1]', [0.1, 0.2], r'scores\[1\]: 2 entries; expected 3 numbers'),
        ('scores[1][2]', 'high', r"scores\[1\]\[2\] is 'high'; expected a number"),
        ('scores[1][2]', float('nan'), r'scores\[1\]\[2\] is nan; expected a number'),
        ('scores[1][2]', 1.01, r'scores\[1\]\[2\] is 1.01; expected a number at most 1'),
        ('scores[2][1]', 0.9, r'metrics.average_performance is 0.1[23].*; expected 0.38'),
        ('samples[1][1]', 8, r'samples\[1\] is \[0, 8, 0\], in total 8; .* at most 7'),
        ('samples[1][1]', 2.5, r'samples\[1\].*expected whole numbers'),
        ('samples[1][1]', -1, r'samples\[1\]\[1\] is -1; .* at least 0'),
        ('curves[0]', [], r'curves\[0\]: 0 entries; expected 20 numbers'),
        ('seconds', [1], 'seconds: 1 stages; expected 3'),
        ('metrics', {}, 'metrics: expected average_performance'),
        ('metrics.forgetting', -0.2, 'metrics.forgetting is -0.2; expected -0.0(4|39)'),
        ('metrcs', 1, "unknown field 'metrcs'; did you mean 'metrics'"),
        *((name, 4, f'{name} is 4; expected a string') for name in (*results.MADE_WITH, 'policy')),
        ('format', 'trl_suite benchmark 0',
         "format is 'trl_suite benchmark 0'; expected 'trl_suite benchmark 1'", BENCHMARK),
        ('environment', 'PD_Dog2D_Flat_Terrain-v0',
         "unknown environment of the benchmark 'PD_Dog2D_Flat", BENCHMARK),
        ('ids', ['PD_Dog2D_Mixed_Terrain-v0'], r"ids is \['PD_Dog2D.*expected \['PD_Biped2D_Gaps", BENCHMARK),
        ('samples[19]', [106], r'samples\[19\] is \[106\], in total 106; .* at most 105', BENCHMARK),
        ('scores', [[0.5]] * 21, 'scores: 21 stages; expected 20', BENCHMARK),
        ('metrics', {'score': 0.9, 'mean_score': 0.42}, r'metrics.score is 0.9; expected', BENCHMARK),
    )  # fmt: skip
    def test_errors_name_the_field_and_what_was_expected(
        self, name, value, message, which=SEQUENCES
    ):
        self.path.unlink()
        result = self.run_short(Counter(), which)
        with self.assertRaisesRegex(ValueError, message):
            which[0].check(changed(result, name, value))

    @parameterized.parameters(
        'learner', 'trl_suite', 'seed', 'episodes', 'scores[0][2]', 'samples[0][1]', 'seconds[1]'
    )
    def test_every_edit_changes_the_digest(self, name):
        """Also of entries that no metric uses."""
        sequences.check(self.result)
        value = 'other:Learner' if name in ('learner', 'trl_suite') else 1
        edited = {**changed(self.result, name, value), 'digest': self.result['digest']}
        with self.assertRaisesRegex(ValueError, 'digest is .* changed after the run'):
            sequences.check(edited)

    def test_what_it_was_made_with_may_be_missing(self):
        self.assertEqual(
            {name: self.result[name] for name in results.MADE_WITH}, machine.made_with()
        )
        for name in results.MADE_WITH:
            del self.result[name]
        sequences.check(changed(self.result, 'seed', 0))

    def test_returns_of_training_may_have_other_terms(self):
        sequences.check(changed(self.result, 'curves[0][0]', 1.5))

    def test_missing_fields(self):
        def without(name):
            result = {key: value for key, value in self.result.items() if key != name}
            return lambda: sequences.check(result), f'^{name} is missing'

        assert_refused(self, *map(without, (*sequences.BENCHMARK.fields, 'metrics')))
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
        result = {'environment': ID, 'budget': 200, 'episodes': 4, 'seed': 7}
        self.assertEqual(benchmark.departures(result), [
            'budget is 200, not 1000000 or 10000000', 'episodes is 4, not 32',
            'seed is 7, not 0 or 1 or 2 or 3 or 4',
        ])  # fmt: skip


MODULE = """
class Nothing:
    def __init__(self, course, seed):
        pass

    def train(self, stage):
        stage.spend(stage.ids.index(stage.id), 2)

    def policy(self):
        return lambda observation: observation

class Greedy(Nothing):
    def train(self, stage):
        while True:
            super().train(stage)
"""


class LearnerTest(CommandTest):
    """The commands `sequences` and `benchmark`."""

    def setUp(self):
        super().setUp()
        pathlib.Path('my_learner.py').write_text(MODULE)
        scores = mock.Mock(
            side_effect=lambda cases, *_, **__: [{'normalized_return': 0.5}] * len(cases)
        )
        self.enterContext(mock.patch.object(evaluation, 'evaluate_all', scores))

    @parameterized.parameters(
        ('sequences', 'plaid_biped', '100', 'result.json', sequences.BENCHMARK, 10, '100 of 100',
         r'after PD_Biped2D_Gaps_Terrain-v0 +(0\.500 ?){5}\n(.*\n)*forgetting +0.000'),
        ('benchmark', ID, '60', f'Nothing/{ID}_s0.json', benchmark.BENCHMARK, 40, '2 of 3',
         rf'^Nothing/{ID}_s0.json: score 0\.\d\d\d\n$'),
    )  # fmt: skip
    def test_run_and_check(self, command, name, budget, path, of, samples, taken, out):
        arguments = (command, 'run', name, '--budget', budget, '--episodes', '1', '--threads', '1',
                     '--learner')  # fmt: skip
        status, printed, warned = run(*arguments, 'my_learner:Nothing')
        self.assertEqual(status, 0)
        self.assertRegex(printed, out)
        self.assertStartsWith(warned, f'trl-suite: not comparable: budget is {budget}, not ')
        result = of.read(path)
        self.assertEqual((result['budget'], result['learner']), (int(budget), 'my_learner:Nothing'))
        self.assertEqual(np.sum(result['samples']), samples)
        made = f'mujoco {result["mujoco"]}, cpu {result["cpu"]}'
        self.assertRegex(
            self.output(command, 'check', path),
            f'{path}: my_learner:Nothing, {name}, .*{made}: not comparable: budget is {budget}, not',
        )
        forged = changed(result, 'cpu', '\x1b]0;title\x07a\nvalid and comparable')
        pathlib.Path('forged.json').write_text(json.dumps(forged))
        told = self.output(command, 'check', 'forged.json')
        self.assertIn(r'cpu \x1b]0;title\x07a\nvalid and comparable: not comparable', told)
        self.assertEqual(told.count('\n'), 1)
        text = pathlib.Path(path).read_text().replace(f'"budget": {budget}', '"budget": 101')
        pathlib.Path('edited.json').write_text(text)
        self.assert_refused(
            'edited.json: digest is .*the file was', command, 'check', 'edited.json'
        )
        pathlib.Path(path).unlink()
        status, _, err = run(*arguments, 'my_learner:Greedy')
        self.assertEqual(status, 2)
        self.assertRegex(err, rf'stage 0 \(.*2 more samples; .* at most .*{taken} are')
        self.assertRegex(err, r'Traceback(.*\n)*.*my_learner.py", line \d+, in train')
        pathlib.Path('edited.json').unlink()
        status, printed, err = run(command, 'check', '.')  # the last run has not ended
        self.assertEqual((status, printed), (0, told))
        self.assertRegex(err, r'_?\w+.json is left out, since its run has not ended\n$')

    def test_list(self):
        out = self.output('sequences', 'list')
        for name in sequences.SEQUENCES:
            self.assertIn(f'{name} ', out)
        out = self.output('benchmark', 'list')
        for id_, course in benchmark.CORE.items():
            self.assertRegex(out, rf'{id_} +0\.\d+ +0\.\d+ +\d+  {course.description}')

    @parameterized.product(
        command=(('sequences', 'run', 'plaid_biped'), ('benchmark', 'run', ID)),
        refused=(
            ("unknown learner of the module my_learner: 'Nothin'; did you mean 'Nothing'", 'my_learner:Nothin'),
            *((f"--learner is '{name}'; expected module:Class", name)
              for name in ('my_learner', '.a:C', 'a..b:C', 'a b:C')),
            *((f"--learner is '{name}', which has no train and policy; expected a class", name)
              for name in ('os:path', 'pathlib:Path')),
            *((f"--budget is '{budget}'; expected .* or a number", 'my_learner:Nothing', '--budget', budget)
              for budget in ('tiny', '20000.7', 'inf')),
            ('--seed is -1; expected a whole number at least 0', 'my_learner:Nothing', '--seed', '-1'),
            ("--learner is 'my_learner_:A'; expected a module of this folder", 'my_learner_:A'),
        ),
    )  # fmt: skip
    def test_bad_learners_are_refused(self, command, refused):
        message, *arguments = refused
        self.assert_refused(message, *command, '--learner', *arguments)


class BaselinesTest(CommandTest):
    """With small networks, in which every stage makes some updates."""

    def setUp(self):
        super().setUp()
        made, small = continual.settings.settings_for, {'hidden': (16, 16), 'minibatch': 128}
        small['cloning_epochs'] = 2

        def settings(id_, **changes):
            return made(id_, **{**changes, **small})

        # Quicker than episodes, and as telling: what the network has become.
        def scores(cases, *_, executor):
            means = [float(np.abs(policy.weights[1]).mean()) for _, policy in cases]
            return [{'normalized_return': mean} for mean in means]

        for owner, name, value in (
            (continual, 'NUM_ENVS', 8), (continual.settings, 'settings_for', settings),
            (evaluation, 'evaluate_all', scores),
        ):  # fmt: skip
            self.enterContext(mock.patch.object(owner, name, value))

    def run_short(self, kind, name, **changes):
        options = {'budget': 600, 'path': f'{name}.json', 'episodes': 1, **changes}
        return sequences.run(SHORT, kind(SHORT, 0), **options)

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
        result = self.run_short(kind, 'result')
        found = np.array(result['samples'])
        np.testing.assert_array_equal(found > 0, expected.astype(bool))
        # PPO takes whole batches of at most 256 samples.
        np.testing.assert_array_equal(found.sum(1), found.sum(1).clip(600 - 256, 600))
        self.assertEqual(sequences.read('result.json'), result)
        self.assertNotEqual(result['scores'][0], result['initial'])

    @parameterized.parameters(continual.FineTuning, continual.EWC, continual.Plaid)
    @pytest.mark.slow
    def test_a_stopped_run_resumes_exactly(self, kind):
        whole = self.run_short(kind, 'whole')
        train = kind.train

        def stopped(learner, stage):
            if stage.number == 2:
                raise KeyboardInterrupt
            train(learner, stage)

        with mock.patch.object(kind, 'train', stopped), self.assertRaises(KeyboardInterrupt):
            self.run_short(kind, 'parts')
        parts = self.run_short(kind, 'parts')
        for name in ('initial', 'scores', 'samples', 'curves', 'metrics'):
            self.assertEqual(parts[name], whole[name], name)

    def test_scratch_forgets_everything(self):
        """Trained twice on one environment, it begins with the same weights."""
        learner = continual.Scratch(SHORT, 0)
        first = learner.policy().weights[1]
        learner.train(runs.Stage(SHORT, 0, 600, 0, 1))
        self.assertFalse(np.array_equal(learner.policy().weights[1], first))
        learner.train(runs.Stage(SHORT, 1, 10, 0, 1))  # too few samples for an update
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
        stage = runs.Stage(SHORT, 1, 600, 0, 1)
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
