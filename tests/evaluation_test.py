"""Evaluation: the episodes of single environments, summed up, whatever the threads."""

import concurrent.futures
import dataclasses
import functools
import json
import pickle
from unittest import mock

import numpy as np
from absl.testing import parameterized
from helpers import assert_refused
from programs import GAPS, policy_for

from trl_suite import evaluation, suite
from trl_suite.engine import world
from trl_suite.environments import named_policies
from trl_suite.util import machine
from trl_suite.vector import VectorEnvironment

FLAT, RAPTOR = 'PD_Biped2D_Flat_Terrain-v0', 'PD_Raptor2D_LLC_Imitate_Flat-v0'
GAIT = 'FSM_Biped2D_Terrain_Gaps-v0'
LISTS = ('seeds', 'returns', 'lengths', 'distances', 'fell')


def make(id_, seed=0):
    return policy_for(id_, seed, 0.1, (32,))


def alone(id_, seeds, act, **options):
    """Returns, lengths, distances and falls of single environments, one by one."""
    episodes = []
    for seed in seeds:
        environment = suite.make(id_, {'random': seed, **options})
        time_step, total, length = environment.reset(), 0.0, 0
        while not time_step.last():
            time_step = environment.step(act(environment, time_step))
            total, length = total + time_step.reward, length + 1
        info = environment.info
        episodes.append((total, length, info['distance'], info['fell'], time_step.discount))
    return [list(column) for column in zip(*episodes, strict=True)]


class EvaluateTest(parameterized.TestCase):
    @parameterized.parameters(
        (GAPS, make), (RAPTOR, make), (RAPTOR, named_policies.clip), (GAIT, named_policies.zero),
    )  # fmt: skip
    def test_episodes_are_those_of_single_environments(self, id_, policy):
        """Also of the clip's actions, and where steps differ in duration."""
        factory, limit = policy is not make, {'step_limit': 12} if id_ == GAIT else {}
        policy = policy if factory else policy(id_)

        def act(environment, time_step):
            if policy is named_policies.clip:
                return np.clip(environment.task.clip_action(0), -1, 1)
            return np.zeros(28) if factory else policy(time_step.observation)

        spec = dataclasses.replace(suite.find(id_), **limit)
        found = evaluation.evaluate(spec, policy, 6, 4, num_threads=2, factory=factory)
        self.assertEqual(found['seeds'], VectorEnvironment(id_, 6, 1, seed=4).seeds.tolist())
        *expected, _ = alone(id_, found['seeds'], act, **limit)
        self.assertEqual([found[name] for name in LISTS[1:]], expected)
        if not factory:  # some simulations continued after others had ended
            self.assertGreater(len(set(found['lengths'])), 1)

    def test_seeds_may_be_given(self):
        seeds = [2**31 + 1, 7, 2**32 - 1]
        found = evaluation.evaluate(GAPS, named_policies.zero, 3, seeds, factory=True)
        self.assertEqual((found['seeds'], found['seed']), (seeds, None))
        expected = alone(GAPS, seeds, lambda *_: np.zeros(11))
        self.assertEqual(found['returns'], expected[0])

    def test_results_do_not_depend_on_threads_and_chunks(self):
        self.enterContext(mock.patch.object(world, 'LEAST', 1))  # each simulation on a thread
        policy = make(GAPS)
        expected = evaluation.evaluate(GAPS, policy, 4, 2, num_threads=1)
        self.assertLessEqual(machine.made_with().items(), expected.items())
        self.assertEqual(evaluation.evaluate(GAPS, policy, 4, 2, num_threads=2), expected)
        with mock.patch.object(evaluation, 'CHUNK', 3):
            self.assertEqual(evaluation.evaluate(GAPS, policy, 4, 2), expected)
        fewer = evaluation.evaluate(GAPS, policy, 3, 2)
        for name in LISTS:
            self.assertEqual(fewer[name], expected[name][:3])
        other = evaluation.evaluate(GAPS, policy, 3, 5)
        self.assertNotEqual(other['returns'], fewer['returns'])

    def test_results_do_not_depend_on_the_executor(self):
        class Pickling:
            """Runs here what was sent and received."""

            sent = ()

            def map(self, fn, *iterables):
                for arguments in zip(*iterables, strict=True):
                    data = pickle.dumps((fn, arguments))
                    self.sent += (len(data),)
                    fn_, arguments_ = pickle.loads(data)
                    yield pickle.loads(pickle.dumps(fn_(*arguments_)))

        self.enterContext(mock.patch.object(evaluation, 'PART', 3))
        pickling = Pickling()
        with concurrent.futures.ThreadPoolExecutor(2) as pool:
            for policy, factory in ((make(GAPS), False), (named_policies.random, True)):
                expected = evaluation.evaluate(GAPS, policy, 4, 2, factory=factory)
                for executor in (pickling, pool):
                    options = {'factory': factory, 'executor': executor}
                    found = evaluation.evaluate(GAPS, policy, 4, 2, **options)
                    self.assertEqual(found, expected)
        self.assertLen(pickling.sent, 2 * 2)
        self.assertLess(max(pickling.sent), 1e5)  # a policy, and no environment

    def test_several_policies(self):
        cases = [(GAPS, make(GAPS)), (FLAT, make(FLAT, 1))]
        expected = [evaluation.evaluate(*case, 3, 2) for case in cases]
        self.assertEqual(evaluation.evaluate_all(cases, 3, 2), expected)
        with concurrent.futures.ThreadPoolExecutor(2) as pool:
            self.assertEqual(evaluation.evaluate_all(cases, 3, 2, executor=pool), expected)

    def test_baselines_of_one_environment(self):
        one, other = (suite.make(FLAT, {'random': seed}) for seed in (5, 6))
        idle, first, second = named_policies.zero(one), *map(named_policies.random, (one, other))
        action = idle(None)
        action += 0.5
        np.testing.assert_array_equal(idle(None), 0)
        self.assertNotEqual(first(None).tolist(), second(None).tolist())
        again = named_policies.random(suite.make(FLAT, {'random': 5}))
        np.testing.assert_array_equal(named_policies.random(one)(None), again(None))

    def test_speed_is_over_simulated_time(self):
        spec = dataclasses.replace(suite.find(GAIT), step_limit=3)
        found, time = evaluation.evaluate(spec, named_policies.zero, 2, factory=True), 0.0
        for seed in found['seeds']:
            one = suite.make(GAIT, {'random': seed, 'step_limit': 3})
            time_step = one.reset()
            while not time_step.last():
                time_step = one.step(np.zeros(len(one.action_map)))
            time += one.physics.data.time
        self.assertAlmostEqual(found['speed'], sum(found['distances']) / time)

    def test_divergence_is_counted(self):
        def breaking(environments):
            def act(observation):
                environments.task.world.qvel[0] = np.nan
                return np.zeros((2, 11))

            return act

        found = evaluation.evaluate(GAPS, breaking, 2, factory=True)
        self.assertEqual((found['diverged'], found['fell']), (0.5, [False, True]))

    def test_zero_actions_fall_early(self):
        found = evaluation.evaluate(FLAT, named_policies.zero, 10, factory=True)
        self.assertEqual((found['falls'], found['completion_rate'], found['diverged']), (1, 0, 0))
        self.assertEqual(found['fell'], [True] * 10)
        self.assertLess(max(found['lengths']), 128)
        self.assertLess(found['normalized_return'], 0.3)
        self.assertGreater(found['normalized_return'], 0)

    def test_truncated_episodes(self):
        # A step limit that all reach: the rewards of three steps and no fall.
        spec = dataclasses.replace(suite.find(GAPS), step_limit=3)
        found = evaluation.evaluate(spec, make(GAPS), 4)
        self.assertEqual((found['completion_rate'], found['falls']), (1, 0))
        self.assertEqual(found['lengths'], [3] * 4)
        self.assertEqual(found['step_limit'], 3)
        self.assertEqual(found['normalized_return'], found['return'] / 3)
        self.assertGreater(found['normalized_return'], 0.3)

    def test_a_time_limit_counts_as_its_steps(self):
        short = evaluation.evaluate(GAPS, make(GAPS), 1, task_kwargs={'time_limit': 1e-9})
        self.assertEqual(short['step_limit'], 1)
        found = evaluation.evaluate(GAPS, make(GAPS), 4, task_kwargs={'time_limit': 0.1})
        self.assertEqual((found['step_limit'], found['lengths']), (3, [3] * 4))
        self.assertEqual(found['normalized_return'], found['return'] / 3)
        # Rounded up by less than a physics step, within which episodes end.
        found = evaluation.evaluate(GAPS, make(GAPS), 1, task_kwargs={'time_limit': 0.1 + 5e-7})
        self.assertEqual((found['step_limit'], found['lengths']), (3, [3]))
        with self.assertRaisesRegex(
            ValueError, 'expected a step_limit.* since steps of FSM_.* differ'
        ):
            options = {'time_limit': 3.0}
            evaluation.evaluate(
                'FSM_Hopper2D_Terrain_Gaps-v0',
                named_policies.zero,
                1,
                task_kwargs=options,
                factory=True,
            )

    def test_a_fall_in_the_last_step_is_not_full_length(self):
        found = evaluation.evaluate(FLAT, named_policies.zero, 3, factory=True)
        spec = dataclasses.replace(suite.find(FLAT), step_limit=found['lengths'][0])
        again = evaluation.evaluate(spec, named_policies.zero, 1, factory=True)
        self.assertEqual((again['lengths'], again['fell']), (found['lengths'][:1], [True]))
        self.assertEqual(again['completion_rate'], 0)

    def test_means_and_intervals(self):
        found = evaluation.evaluate('plaid/biped_gaps', make(GAPS), 5, 3)
        self.assertEqual((found['id'], found['episodes'], found['seed']), (GAPS, 5, 3))
        self.assertEqual(json.loads(json.dumps(found, allow_nan=False)), found)
        returns = np.array(found['returns'])
        self.assertAlmostEqual(found['return'], returns.mean())
        deviation = np.sqrt(((returns - returns.mean()) ** 2).sum() / 4)
        self.assertAlmostEqual(found['return_interval'], 1.96 * deviation / np.sqrt(5))
        self.assertAlmostEqual(found['normalized_return'], returns.mean() / 256)
        for one, many in (('length', 'lengths'), ('distance', 'distances'), ('falls', 'fell')):
            self.assertAlmostEqual(found[one], np.mean(found[many]))
        for name in LISTS:
            self.assertLen(found[name], 5)
        distances = np.array(found['distances'])
        self.assertEqual(found['median_distance'], np.median(distances))
        low, high = found['distance_interval']
        error = distances.std() / np.sqrt(5)
        self.assertAlmostEqual(low, distances.mean() - 1.96 * error, delta=0.5 * error)
        self.assertAlmostEqual(high, distances.mean() + 1.96 * error, delta=0.5 * error)
        self.assertAlmostEqual(found['speed'], 30 * distances.sum() / np.sum(found['lengths']))
        single = evaluation.evaluate(GAPS, make(GAPS), 1)
        self.assertIsNone(single['return_interval'])
        self.assertIsNone(single['distance_interval'])

    def test_options_of_the_task(self):
        blind = 'PD_Biped2D_Flat-v0'
        expected = evaluation.evaluate(blind, make(blind), 2)
        found = evaluation.evaluate(FLAT, make(blind), 2, task_kwargs={'terrain_observation': 0})
        self.assertEqual(found['returns'], expected['returns'])

    def test_seeds_may_be_an_array(self):
        policy, options = make(GAPS), {'step_limit': 3}
        found = [
            evaluation.evaluate(GAPS, policy, 2, s, 1, options) for s in ([3, 5], np.array([3, 5]))
        ]
        self.assertEqual(found[0], found[1])
        self.assertIsNone(found[1]['seed'])

    def test_invalid_arguments_are_rejected(self):
        policy = make(GAPS)
        for message, *arguments in (
            ('episodes is 0', GAPS, policy, 0),
            ('episodes is 1.5', GAPS, policy, 1.5),
            ("episodes is 'x'; expected a whole number", GAPS, policy, 'x'),
            ('episodes is 1000000000; expected .* to 1000000', GAPS, policy, 10**9),
            ('seed is -1', GAPS, policy, 1, -1),
            ("seed is 'x'; expected a whole number at least 0", GAPS, policy, 1, 'x'),
            ("seed is 'x'; expected a whole number from 0 to 4294967295", GAPS, policy, 1, ['x']),
            ('seed is 4294967296; expected a whole number', GAPS, policy, 1, [2**32]),
            ('num_threads is -1', GAPS, policy, 1, 0, -1),
            ('2 seeds for 3 episodes', GAPS, policy, 3, [1, 2]),
            ('did you mean', GAPS[:-1], policy),
            ('unknown option', GAPS, policy, 1, 0, 0, {'x': 1}),
            ('observes terrain 50, .*gives pose', 'PD_Biped2D_Flat-v0', policy, 1),
            (r'actions have shape \(2, 3\)', GAPS, lambda o: np.zeros((len(o), 3)), 2),
        ):
            assert_refused(self, (functools.partial(evaluation.evaluate, *arguments), message))
        with self.assertRaisesRegex(
            TypeError, 'policy is None; expected a function of observations'
        ):
            evaluation.evaluate(GAPS, None, 1)
        with self.assertRaisesRegex(ValueError, 'torque control cannot follow a clip'):
            evaluation.evaluate('imitation/torque_dog', named_policies.clip, 1, factory=True)
