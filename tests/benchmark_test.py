"""The benchmark: core set, verification, reports, and standard learners."""

import dataclasses
import functools
import importlib.util
import json
import pathlib
import shutil
import sys
import tempfile
from unittest import mock

import numpy as np
from absl.testing import parameterized
from helpers import FolderTest, assert_refused
from programs import CommandTest, run, run_example

from trl_suite import benchmark, evaluation, policies, runs, suite
from trl_suite.benchmark import core, report
from trl_suite.runs import results, running
from trl_suite.runs.course import Course

ROOT = pathlib.Path(__file__).resolve().parents[1]
ID = 'PD_Biped2D_Gaps_Terrain-v0'


def page():
    """Imports the program that writes docs/benchmark.md."""
    spec = importlib.util.spec_from_file_location('benchmark_page', ROOT / 'docs/benchmark_page.py')
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class CoreTest(parameterized.TestCase):
    def test_three_of_each_family(self):
        families = [suite.find(id_).domain for id_ in benchmark.CORE]
        self.assertEqual(
            {name: families.count(name) for name in families},
            {'plaid': 3, 'imitation': 3, 'terrainrl': 3, 'deeploco': 3},
        )

    def test_scales(self):
        made = json.loads(core.SCALES.read_text())
        self.assertEqual(made['format'], benchmark.BENCHMARK.format)
        self.assertEqual([*made['scores']], [*benchmark.CORE])
        for of in made['scores'].values():
            self.assertLess(max(of['zero'], of['random']) + 0.1, of['shipped'])
            self.assertLessEqual(of['shipped'], 1)
            self.assertGreaterEqual(of['episodes'], 256)
        of = {'zero': 0.1, 'random': 0.2, 'shipped': 0.7}
        with mock.patch.object(core, 'scales', return_value={ID: of}):
            self.assertAlmostEqual(benchmark.normalised(ID, 0.45), 0.5)
            self.assertAlmostEqual(benchmark.normalised(ID, 0.1), -0.2)
        with self.assertRaisesRegex(ValueError, f"'{ID[:-3]}s-v0'.*{ID}"):
            benchmark.normalised(f'{ID[:-3]}s-v0', 0.4)

    def test_step_limits(self):
        self.assertEqual(benchmark.get(ID).spec(ID).step_limit, 256)
        gait = benchmark.get('FSM_Dog2D_Terrain_Mixed-v0')
        stage = runs.Stage(gait, 0, 100, 0, 1)
        self.assertEqual(stage.environments(1).step_limit, core.GAIT_LIMIT)
        answer = [{'normalized_return': 0.0}]
        with mock.patch.object(evaluation, 'evaluate_all', return_value=answer) as tests:
            benchmark.scores('FSM_Dog2D_Terrain_Mixed-v0', np.zeros_like)
        [(spec, _)] = tests.call_args.args[0]
        self.assertEqual(spec.step_limit, core.GAIT_LIMIT)


class Shipped:
    """A learner whose policy is the shipped one."""

    def __init__(self, course, seed):
        self.id = course.ids[0]

    def train(self, stage):
        pass

    def policy(self):
        return policies.reference(self.id)


class VerifyTest(FolderTest):
    @classmethod
    def setUpClass(cls):
        super().setUpClass()
        # With two parts instead of twenty.
        courses = {ID: dataclasses.replace(benchmark.get(ID), parts=2)}
        cls.benchmark = dataclasses.replace(benchmark.BENCHMARK, courses=courses)
        cls.made = pathlib.Path(cls.enterClassContext(tempfile.TemporaryDirectory()), 'result.json')
        cls.result = cls.benchmark.run(ID, Shipped(courses[ID], 0), 2, cls.made, 2, 3, 1)

    def setUp(self):
        super().setUp()
        self.path, self.stored = (
            pathlib.Path(shutil.copy(self.made.with_suffix(suffix), self.folder))
            for suffix in ('.json', '.npz')
        )

    def write(self, **changes):
        result = {**self.result, **changes}
        self.path.write_text(json.dumps({**result, 'digest': results.digest(result)}))

    def verify(self):
        return self.benchmark.verify(self.path, 1)

    def test_entries(self):
        self.assertEqual(self.verify(), (self.result, 0))
        scores = self.result['scores']
        self.write(scores=[scores[0], [np.nextafter(scores[1][0], 0)]])
        assert_refused(self, (self.verify, r'scores\[-1\] is .*; measured'))

    def test_one_changed_weight(self):
        policy = policies.load(self.stored)
        weight = policy.weights[1].copy()
        weight[3, 5] += 1e-3
        weights = policy.weights[0], weight, *policy.weights[2:]
        policies.save(dataclasses.replace(policy, weights=weights), self.stored)
        assert_refused(self, (self.verify, 'policy is .*one of the two was changed after the run'))
        self.write(policy=running._sha256(self.stored))
        assert_refused(self, (self.verify, r'scores\[-1\] is \[0.*\]; measured \[0'))
        # Made on another class of processor, it is within the tolerance.
        self.write(policy=running._sha256(self.stored), cpu='other')
        self.assertEqual(self.verify()[1], running.TOLERANCE)

    def test_another_cpu_is_tolerated_only_so_far(self):
        scores = [self.result['scores'][0], [self.result['scores'][1][0] - 0.06]]
        course = self.benchmark.courses[ID]
        metrics = self.benchmark.measured(course, scores, self.result['initial'])
        self.write(scores=scores, metrics=metrics, cpu='other')
        assert_refused(self, (self.verify, r'scores\[-1\] is .*; measured'))

    def test_a_policy_of_another_environment_or_none(self):
        policies.save(policies.reference('PD_Dog2D_Gaps_Terrain-v0'), self.stored)
        self.write(policy=running._sha256(self.stored))
        assert_refused(self, (self.verify, 'PD_Dog2D_Gaps_Terrain-v0'))
        self.stored.unlink()
        with self.assertRaisesRegex(FileNotFoundError, 'result.npz: there is no such file'):
            self.verify()


def result_of(learner, id_, seed, score, **changes):
    """A result whose normalised scores rise linearly to `score`."""
    low, high = benchmark.ends(id_)
    curve = [[low + (high - low) * score * (part + 1) / 20] for part in range(20)]
    return {'learner': learner, 'environment': id_, 'seed': seed, 'budget': 200, 'episodes': 32,
            'scores': curve, 'metrics': {}, **changes}  # fmt: skip


class ReportTest(parameterized.TestCase):
    IDS = [*benchmark.CORE][:2]

    def results(self):
        a = [[0.1, 0.2, 0.3, 0.4], [0.5, 0.6, 0.7, 1.5]]
        for id_, scores in zip(self.IDS, a, strict=True):
            for seed, score in enumerate(scores):
                yield result_of('m:A', id_, seed, score)
                yield result_of('m:B', id_, seed, 0.35)
        yield result_of('m:A', [*benchmark.CORE][3], 0, 0.9)  # not an environment of B

    def test_estimates_are_those_of_rliable(self):
        """Of 5 runs in 12 environments; rliable 1.2.0 computed the values, from 20,000 samples."""
        scores = np.random.default_rng(3).uniform(-0.2, 1.1, (5, 12))
        results = [
            result_of('m:A', id_, seed, scores[seed, i])
            for i, id_ in enumerate(benchmark.CORE)
            for seed in range(5)
        ]
        found = report.report(results)['learners']['m:A']
        for name, value, low, high in (
            ('iqm', 0.46411028, 0.350, 0.575), ('median', 0.46304884, 0.351, 0.570),
            ('mean', 0.45257329, 0.370, 0.533), ('optimality_gap', 0.54941919, 0.469, 0.631),
        ):  # fmt: skip
            self.assertAlmostEqual(found[name][0], value, 7, name)
            np.testing.assert_allclose(found[name][1:], (low, high), atol=0.01, err_msg=name)

    def test_statistics(self):
        """Computed by hand: the interquartile mean leaves out two of eight scores at each end."""
        found = report.report(self.results())
        a, b = found['learners']['m:A'], found['learners']['m:B']
        self.assertEqual(found['environments'], self.IDS)
        self.assertEqual(found['left_out'], [[*benchmark.CORE][3]])
        self.assertEqual(found['left_out_runs'], 0)
        further = result_of('m:A', self.IDS[0], 4, 0.5)  # without a run of seed 4 in the other
        more = report.report([*self.results(), further])
        self.assertEqual((more['learners'], more['left_out_runs']), (found['learners'], 1))
        self.assertIn('lacks the seed in others: 1 runs', report.table(more))
        self.assertEqual(found['samples'], [10 * (part + 1) for part in range(20)])
        self.assertAlmostEqual(a['iqm'][0], (0.3 + 0.4 + 0.5 + 0.6) / 4)
        self.assertAlmostEqual(a['median'][0], (1.0 / 4 + 3.3 / 4) / 2)
        self.assertAlmostEqual(a['mean'][0], 4.3 / 8)
        self.assertAlmostEqual(a['optimality_gap'][0], 1 - 3.8 / 8)
        np.testing.assert_allclose(b['iqm'], 0.35)
        self.assertLess(a['iqm'][1], a['iqm'][0])
        self.assertLess(a['iqm'][0], a['iqm'][2])
        np.testing.assert_allclose(np.array(a['curve'])[:, 0], 0.45 * np.arange(1, 21) / 20)
        shares = dict(zip(report.THRESHOLDS.round(2), np.array(a['profile'])[:, 0], strict=True))
        self.assertEqual((shares[0.0], shares[0.45], shares[1.2]), (1, 0.5, 0.125))
        self.assertAlmostEqual(found['improvement']['m:A, m:B'][0], (0.25 + 1) / 2)
        self.assertEqual([*found['improvement']], ['m:A, m:B'])
        self.assertEqual(found, json.loads(json.dumps(found)))
        text = report.table(found)
        self.assertIn('| m:A | 4 | 0.450 (', text)
        self.assertIn('2 of 12 environments, 200 samples', text)
        self.assertIn(f'left out, since some learners lack them: {[*benchmark.CORE][3]}', text)

    def test_intervals_cover_the_mean(self):
        """Of 200 samples of 5 runs, about 5 % do not; the bootstrap of few runs is a bit narrow."""
        random = np.random.default_rng(0)
        with mock.patch.object(report, 'REPEATS', 300):
            covered = []
            for _ in range(200):
                scores = random.normal(0.5, 0.1, (5, 12, 1))
                _, low, high = report._estimates(scores)['mean']
                covered.append(low <= 0.5 <= high)
        self.assertBetween(np.mean(covered), 0.8, 0.99)

    def test_results_that_cannot_be_compared(self):
        first = result_of('m:A', self.IDS[0], 0, 0.5)
        for others, message in (
            ([first], 'two results of m:A in PD_Biped2D.* with seed 0'),
            ([{**first, 'seed': 1, 'budget': 300}],
             'budget: 200 .m:A in PD_Biped2D.* with seed 0., 300 .*; expected the same in all results'),
            ([{**first, 'seed': 1, 'episodes': 3}],
             'episodes: 3 .*, 32 .*; expected the same in all results'),
            ([result_of('m:B', self.IDS[1], 0, 1)], 'no environment is common to the learners m:A, m:B'),
            ([result_of('m:A', self.IDS[1], 1, 1)], 'm:A: no seed is common to PD_Biped2D'),
        ):  # fmt: skip
            with self.assertRaisesRegex(ValueError, message):
                report.report([first, *others])
        with self.assertRaisesRegex(ValueError, "unknown environment of the benchmark 'mine'"):
            benchmark.run(Course('mine', (ID,)), Shipped(benchmark.get(ID), 0))
        unfinished = {key: value for key, value in first.items() if key != 'metrics'}
        with self.assertRaisesRegex(ValueError, 'm:A in PD_Biped2D.* with seed 0 has not ended'):
            report.report([unfinished])
        with self.assertRaisesRegex(ValueError, 'no results of runs that have ended'):
            report.report([])


class PageTest(FolderTest):
    """docs/benchmark_page.py: an entry is a folder, whose learner may have any name."""

    def entries(self, **results):
        """Returns the report of entries, lists of results by folder."""
        program = page()
        for name, each in results.items():
            (self.folder / name).mkdir()
            for i, result in enumerate(each):
                (self.folder / name / f'{i}.json').write_text(json.dumps(result))
        with (
            mock.patch.object(program, 'ENTRIES', self.folder),
            mock.patch.object(benchmark, 'read', lambda path: json.loads(path.read_text())),
        ):
            return program, program.entries()

    def result(self, i, score, **changes):
        id_ = [*benchmark.CORE][i]
        return {**result_of('mine:Search', id_, 0, score), 'budget': 1_000_000, **changes}

    def runs(self, numbers, score):
        return [self.result(i, score, seed=seed) for i in numbers for seed in benchmark.SEEDS]

    def test_entries_that_break_the_rules(self):
        own = self.runs([0], 0.7)
        for entry, message in (
            (own[3:4], r'mine: .* has the seeds \[3\]; expected each of \(0, 1, 2, 3, 4\) once'),
            ([*own, own[0]], r'has the seeds \[0, 0, 1, 2, 3, 4\]'),
            ([{**own[0], 'learner': 'mine:Other'}, *own[1:]], 'mine: several learners'),
        ):
            with self.assertRaisesRegex(ValueError, message):
                self.entries(PPO=[self.result(0, 0.2)], SuitePPO=[self.result(0, 0.4)], mine=entry)
            shutil.rmtree(self.folder)
            self.folder.mkdir()

    def test_who_is_ranked(self):
        """Learners with the environments of both baselines, in these, also if their class has one name."""
        program, found = self.entries(
            PPO=[self.result(0, 0.2), self.result(1, 0.3), self.result(3, 0.1)],
            SuitePPO=[self.result(0, 0.4), self.result(1, 0.5)], SAC=[self.result(0, 0.6)],
            two=self.runs(range(3), 0.7), three=self.runs([2], 0.9),
        )  # fmt: skip
        ids, ranked = [*benchmark.CORE], ['PPO (baseline)', 'SuitePPO (baseline)', 'two']
        self.assertEqual(([*found['learners']], found['environments']), (ranked, ids[:2]))
        further = {name: [*of] for name, of in found['further'].items()}
        expected = {'PPO (baseline)': ids[3:4], 'SAC (baseline)': ids[:1], 'three': ids[2:3]}
        self.assertEqual(further, {**expected, 'two': ids[2:3]})
        self.assertAlmostEqual(found['further']['three'][ids[2]][0][-1], 0.9)
        text = program.leaderboard(found)
        self.assertIn('| SAC (baseline) | 1 | 0.600 |', text)
        self.assertLess(text.index('| two | 5 |'), text.index('| SuitePPO (baseline) | 1 |'))
        best = [line.split(' | ')[-1] for line in program.core(found).splitlines()[2:7]]
        self.assertEqual(best, ['0.70 |', '0.70 |', '0.90 |', '0.10 |', '– |'])

    @parameterized.parameters(
        ({'budget': 10_000_000}, '0.json: budget is 10000000, not 1000000'),
        ({'episodes': 1}, '0.json: episodes is 1, not 32'),
        ({'seed': 9}, '0.json: seed is 9, not 0 or 1'),
    )
    def test_other_settings_are_refused(self, changes, message):
        with self.assertRaisesRegex(ValueError, message):
            self.entries(PPO=[self.result(0, 0.2, **changes)])


class ReportCommandTest(CommandTest):
    def test_results_of_a_folder(self):
        learner = type('Nothing', (Shipped,), {'policy': lambda self: np.zeros_like})
        folder = pathlib.Path('Nothing')
        for each in (folder, pathlib.Path('empty')):
            each.mkdir()
        low, high = benchmark.ends(ID)
        scores = mock.Mock(return_value=[{'normalized_return': (low + high) / 2}])
        with mock.patch.object(evaluation, 'evaluate_all', scores):
            benchmark.run(ID, learner(benchmark.get(ID), 0), 60, folder / 'a.json')
        out = self.output('benchmark', 'report', 'Nothing', '--json', 'report.json')
        self.assertRegex(out, r'\n1 of 1 results: not comparable: budget is 60')
        self.assertRegex(out, r'Nothing \| 1 \| 0\.500 \| 0\.500 \|')
        found = json.loads(pathlib.Path('report.json').read_text())
        self.assertEqual(found['environments'], [ID])
        self.assert_refused('a.json: has no policy', 'benchmark', 'verify', 'Nothing')
        self.assert_refused(
            'Nothin: there is no such file; did you mean', 'benchmark', 'check', 'Nothin'
        )
        state = folder / 'b.stage3'
        state.mkdir()
        for path in (state / 'own.json', folder / '.a.json.1-2.part.json'):
            path.write_text('{')  # of the learner, and of a killed process
        self.assertIn('a.json: ', self.output('benchmark', 'check', 'Nothing'))
        self.assert_refused('empty: has no results', 'benchmark', 'report', 'empty')
        unfinished = json.loads((folder / 'a.json').read_text())
        del unfinished['metrics']
        unfinished['digest'] = results.digest(unfinished)
        pathlib.Path('empty/b.json').write_text(json.dumps(unfinished))
        nothing = {**unfinished, 'scores': None}
        pathlib.Path('nothing.json').write_text(json.dumps(nothing))
        with self.assertRaisesRegex(ValueError, 'scores: None stages; expected 20'):
            benchmark.BENCHMARK.read('nothing.json', complete=False)
        hollow = {**unfinished, 'metrics': {}, **{name: [] for name in results.ROWS}}
        pathlib.Path('nothing.json').write_text(json.dumps(hollow))
        with self.assertRaisesRegex(ValueError, 'scores: 0 stages; expected 20'):
            benchmark.BENCHMARK.read('nothing.json', complete=False)
        self.assert_refused(
            'among the results',
            'benchmark',
            'report',
            'Nothing',
            '--json',
            'Nothing/report.json',
        )
        for action in 'check', 'report', 'verify':
            status, _, told = run('benchmark', action, 'empty')
            self.assertEqual(status, 2)
            self.assertIn('error: empty: no results of runs that have ended', told)
        self.assert_refused(
            "report.json: format is 'trl_suite report 1'", 'benchmark', 'check', 'report.json'
        )
        self.assert_refused(
            "unknown environment of the benchmark 'PD_Gap'",
            'benchmark',
            'run',
            'PD_Gap',
            '--learner',
            'a:B',
        )


if importlib.util.find_spec('sb3_contrib'):
    sys.path.insert(0, str(ROOT / 'examples'))
    import stable_baselines3
    import stable_baselines_export
    import stable_baselines_learners
    import td3_learner
    import torch
    import tqc_learner
    from stable_baselines3.common.vec_env import VecNormalize

    from trl_suite.adapters.stable_baselines import SuiteVecEnv

    class ShortPPO(stable_baselines_learners.PPO):
        """An update after 5 steps of 8 simulations."""

        kind = functools.partial(stable_baselines3.PPO, n_steps=5, batch_size=8)

    class StableBaselinesTest(FolderTest):
        @parameterized.parameters(
            stable_baselines_learners.PPO, stable_baselines_learners.SAC, td3_learner.TD3,
            tqc_learner.TQC,
        )  # fmt: skip
        def test_exported_policies_are_those_of_the_library(self, kind):
            learner = kind(benchmark.get(ID), 0)
            policy = learner.policy()
            observations = np.random.default_rng(0).normal(size=(5, policy.observation_size))
            expected, _ = learner.model.predict(observations.astype(np.float32), deterministic=True)
            np.testing.assert_allclose(policy(observations), expected, atol=1e-5)
            self.assertGreater(np.abs(expected).max(), 1e-3)
            path = self.folder / 'policy.npz'
            policies.save(policy, path)
            np.testing.assert_array_equal(policies.load(path)(observations), policy(observations))

        def test_other_activations(self):
            envs = SuiteVecEnv(ID, 1, seed=0)

            def exported(kind, activation, **options):
                keywords = {'activation_fn': activation}
                model = kind('MlpPolicy', envs, policy_kwargs=keywords, seed=0, **options)
                return model, stable_baselines_export.exported(model, envs.environment)

            for kind, activation in (
                (stable_baselines3.PPO, torch.nn.ReLU), (stable_baselines3.PPO, torch.nn.ELU),
                (stable_baselines3.SAC, torch.nn.Tanh),
            ):  # fmt: skip
                model, policy = exported(kind, activation)
                observations = np.random.default_rng(0).normal(size=(5, policy.observation_size))
                expected, _ = model.predict(observations.astype(np.float32), deterministic=True)
                np.testing.assert_allclose(policy(observations), expected, atol=1e-5)
            for kind, activation, options in (
                (stable_baselines3.PPO, torch.nn.SiLU, {}),
                (stable_baselines3.SAC, torch.nn.ReLU, {'use_sde': True}),
            ):
                with self.assertRaisesRegex(ValueError, 'expected activations tanh, relu or elu'):
                    exported(kind, activation, **options)

        def test_an_exported_policy_scales_observations_as_the_library_does(self):
            scaled = VecNormalize(SuiteVecEnv(ID, 2, seed=0))
            model = stable_baselines3.PPO('MlpPolicy', scaled, n_steps=16, batch_size=8, seed=0)
            model.learn(32)
            policy = stable_baselines_export.exported(model, scaled.venv.environment)
            observations = np.random.default_rng(0).normal(0, 30, (5, policy.observation_size))
            expected, _ = model.predict(scaled.normalize_obs(observations), deterministic=True)
            np.testing.assert_allclose(policy(observations), expected, atol=1e-5)

        @parameterized.parameters(
            ShortPPO, stable_baselines_learners.SAC, td3_learner.TD3, tqc_learner.TQC
        )
        def test_a_stopped_run_resumes_exactly(self, kind):
            def measured(cases, *_, executor):
                for _, policy in cases:
                    score = float(np.abs(policy.weights[1]).mean())
                    yield {'normalized_return': min(score, 1.0)}

            # Four parts instead of twenty, for each of which everything is written.
            course = dataclasses.replace(benchmark.get(ID), parts=4)
            short = dataclasses.replace(benchmark.BENCHMARK, courses={ID: course})

            def run(name, stages=None):
                path = self.folder / name
                return short.run(course, kind(course, 0), 160, path, 1, 0, 1, stages=stages)

            with mock.patch.object(evaluation, 'evaluate_all', measured):
                whole = run('whole.json')
                run('parts.json', 3)
                parts = run('parts.json')
            for name in ('scores', 'samples', 'curves', 'policy'):
                self.assertEqual(parts[name], whole[name], name)
            self.assertNotEqual(whole['scores'][-1], whole['scores'][0])

    class ExampleTest(CommandTest):
        def test_levels_are_replayed(self):
            out = run_example('level_replay', '--levels', '40', '--steps', '4096')
            hardest = [int(level) for level in out.splitlines()[-1].split(':')[1].split()]
            self.assertLen(set(hardest), 10)
            self.assertContainsSubset(hardest, range(40))
