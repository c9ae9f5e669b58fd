"""Sequences of environments: contents, seeds, metrics, and resumed runs."""

import concurrent.futures
import importlib.util
import json
import pathlib
import sys
import tempfile
from unittest import mock

import numpy as np
from absl.testing import absltest, parameterized

from trl_suite import evaluation, sequences, suite
from trl_suite.vector import VectorEnvironment

SHORT = sequences.Sequence('short', ('plaid/dog_flat', 'plaid/dog_steps', 'plaid/dog_gaps'))
EXAMPLES = pathlib.Path(__file__).resolve().parents[1] / 'examples'


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

    def test_values_that_are_not_needed_may_be_missing(self):
        scores = np.array(self.SCORES)
        scores[np.triu_indices(3, 1)] = np.nan
        self.assertAlmostEqual(sequences.backward_transfer(scores), -0.25)
        with self.assertRaisesRegex(ValueError, 'not finite'):
            sequences.forward_transfer(scores, self.INITIAL)

    @parameterized.parameters((((1, 2, 3), (4, 5, 6)),), (((1,),),), ((1, 2),))
    def test_a_matrix_that_is_not_square_is_rejected(self, scores):
        with self.assertRaisesRegex(ValueError, r'expected \(T, T\)'):
            sequences.average_performance(scores)
        with self.assertRaisesRegex(ValueError, 'initial: shape'):
            sequences.forward_transfer(self.SCORES, (0, 0))


class Counter:
    """A learner that remembers where it was, and whose scores are made up."""

    def __init__(self, stop_at=None):
        self.history, self.stop_at = [], stop_at

    def learn(self, environment, budget):
        if len(self.history) == self.stop_at:
            raise KeyboardInterrupt
        self.history.append((environment, budget))

    def policy(self, environment):
        return environment, len(self.history)


class Keeper(Counter):
    def save(self, folder):
        (folder / 'history.json').write_text(json.dumps(self.history))

    def load(self, folder):
        self.history = [tuple(row) for row in json.loads((folder / 'history.json').read_text())]


def made_up(cases, episodes, seeds, threads, executor):
    assert min(seeds) >= 2**31 and len(seeds) == episodes
    for id_, (environment, stages) in cases:
        assert environment == id_
        yield {'normalized_return': 0.1 * stages + 0.01 * SHORT.ids.index(id_)}


class RunTest(parameterized.TestCase):
    def setUp(self):
        super().setUp()
        self.folder = pathlib.Path(self.enterContext(tempfile.TemporaryDirectory()))
        self.path = self.folder / 'result.json'
        self.enterContext(mock.patch.object(evaluation, 'evaluate_all', made_up))

    def run_short(self, learner, **changes):
        return sequences.run(SHORT, learner, **{'budget': 7, 'path': self.path, **changes})

    def test_stages(self):
        learner = Counter()
        result = self.run_short(learner)
        self.assertEqual(learner.history, [(id_, 7) for id_ in SHORT.ids])
        np.testing.assert_allclose(result['initial'], [0, 0.01, 0.02])
        np.testing.assert_allclose(result['scores'], np.add.outer([0.1, 0.2, 0.3], [0, 0.01, 0.02]))
        self.assertAlmostEqual(result['metrics']['forgetting'], -0.1)
        self.assertAlmostEqual(result['metrics']['forward_transfer'], 0.15)
        self.assertEqual(json.loads(self.path.read_text()), result)
        self.assertEqual([path.name for path in self.folder.iterdir()], ['result.json'])
        # A finished result needs no learning.
        self.assertEqual(self.run_short(Counter(stop_at=0)), result)

    @parameterized.parameters(0, 1, 2)
    def test_a_stopped_run_resumes(self, stop_at):
        whole = self.run_short(Keeper(), path=self.folder / 'whole.json')
        with self.assertRaises(KeyboardInterrupt):
            self.run_short(Keeper(stop_at))
        names = {path.name for path in self.folder.iterdir()} - {'whole.json', 'result.json'}
        self.assertEqual(names, {f'result.stage{stop_at}'} if stop_at else set())
        learner = Keeper()
        self.assertEqual(self.run_short(learner), whole)
        self.assertLen(learner.history, 3)
        self.assertCountEqual(
            [path.name for path in self.folder.iterdir()], ['whole.json', 'result.json']
        )

    def test_a_failed_save_leaves_the_stage_before(self):
        learner = Keeper()
        with (
            mock.patch.object(Keeper, 'save', side_effect=[None, OSError('full')]),
            self.assertRaisesRegex(OSError, 'full'),
        ):
            self.run_short(learner)
        self.assertLen(json.loads(self.path.read_text())['scores'], 1)
        self.assertCountEqual(
            [path.name for path in self.folder.iterdir()], ['result.json', 'result.stage1']
        )

    def test_invalid_arguments_are_rejected(self):
        with self.assertRaises(KeyboardInterrupt):
            self.run_short(Counter(stop_at=1))
        with self.assertRaisesRegex(ValueError, '1 of 3 stages, and a Counter cannot resume'):
            self.run_short(Counter())
        with self.assertRaisesRegex(ValueError, 'another budget: 7; expected 8'):
            self.run_short(Counter(), budget=8)
        with self.assertRaisesRegex(ValueError, 'budget is 0'):
            self.run_short(Counter(), budget=0)
        with self.assertRaisesRegex(ValueError, "'.txt'"):
            self.run_short(Counter(), path=self.folder / 'result.txt')
        self.path.write_text('{"scores": 3}')
        with self.assertRaisesRegex(ValueError, 'not a result of sequences.run'):
            self.run_short(Counter())


class ExecutorTest(absltest.TestCase):
    def test_scores_do_not_depend_on_the_executor(self):
        class Still:
            def policy(self, environment):
                return lambda observation: np.zeros((len(observation), 20))

        expected = [
            evaluation.evaluate(id_, Still().policy(id_), 4, sequences.test_seeds(4, 1))[
                sequences.SCORE
            ]
            for id_ in SHORT.ids
        ]
        self.assertEqual(sequences.scores(SHORT, Still(), 4, 1), expected)
        with concurrent.futures.ThreadPoolExecutor(2) as pool:
            self.assertEqual(sequences.scores(SHORT, Still(), 4, 1, executor=pool), expected)


class ExampleTest(absltest.TestCase):
    def test_example_runs_with_a_small_learner(self):
        """A run that was stopped after the first stage resumes exactly."""
        self.enterContext(mock.patch.object(sys, 'path', [str(EXAMPLES), *sys.path]))
        spec = importlib.util.spec_from_file_location(
            'continual_learning', EXAMPLES / 'continual_learning.py'
        )
        example = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(example)
        pair = sequences.Sequence('pair', ('plaid/biped_flat', 'plaid/biped_gaps'))
        self.enterContext(mock.patch.dict(sequences.SEQUENCES, pair=pair))
        small = {'num_envs': 16, 'hidden': (32, 32), 'minibatch': 128}
        settings = example.ppo_settings.settings_for
        self.enterContext(
            mock.patch.object(
                example.ppo_settings, 'settings_for', lambda id_, **k: settings(id_, **k, **small)
            )
        )
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
        folder = self.enterContext(tempfile.TemporaryDirectory())
        arguments = ['pair', '--budget', '1024', '--episodes', '2', '--threads', '1']
        learn, trained_in = example.FineTuning.learn, []

        def stopped(learner, environment, budget):
            if environment == pair.ids[1]:
                raise KeyboardInterrupt
            learn(learner, environment, budget)

        def recorded(learner, environment, budget):
            learn(learner, environment, budget)
            trained_in.append(learner.trainer.environments.spec.id)

        with (
            mock.patch.object(example.FineTuning, 'learn', stopped),
            self.assertRaises(KeyboardInterrupt),
        ):
            example.main([*arguments, '--output', f'{folder}/parts'])
        with mock.patch.object(example.FineTuning, 'learn', recorded):
            for name in ('parts', 'whole'):
                example.main([*arguments, '--output', f'{folder}/{name}'])
        self.assertEqual(trained_in, [pair.ids[1], *pair.ids])
        parts, whole = (
            json.loads(pathlib.Path(folder, name, 'pair_s0.json').read_text())
            for name in ('parts', 'whole')
        )
        self.assertEqual(parts, whole)
        self.assertNotEqual(whole['scores'][0], whole['initial'])
        self.assertEqual(whole['metrics'], sequences.metrics(whole['scores'], whole['initial']))


if __name__ == '__main__':
    absltest.main()
