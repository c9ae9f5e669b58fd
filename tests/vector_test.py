"""Many simulations behave as single environments do, bit for bit, and never disturb each other."""

import multiprocessing
import os
import pickle
import subprocess
import sys

import numpy as np
from absl.testing import parameterized
from helpers import ONE_OF_EACH, assert_refused

from trl_suite import suite, terrain
from trl_suite.vector import VectorEnvironment

GAPS = 'PD_Biped2D_Gaps_Terrain-v0'
FLAT = 'PD_Biped2D_LLC_Imitate_Flat-v0'
IDLE = np.zeros((3, 6))  # actions of FLAT


def actions_for(environments, *steps, scale=0.1):
    shape = *steps, len(environments.seeds), len(environments.action_map)
    return scale * np.random.default_rng(0).uniform(-1, 1, shape)


def assert_same(found, expected, env_ids=slice(None), sources=slice(None)):
    """Compares observations, rewards and ends of simulations of two steps."""
    for ours, theirs in zip(found[:4], expected[:4], strict=True):
        np.testing.assert_array_equal(ours[env_ids], theirs[sources])


class IdentityTest(parameterized.TestCase):
    """A simulation is the single environment with its seed; see environment_test and state_test."""

    def test_results_do_not_depend_on_num_envs_and_threads(self):
        few = VectorEnvironment(GAPS, 2, 1, seed=[7, 8])
        many = VectorEnvironment(GAPS, 9, 2, seed=[7, 8, *range(20, 27)])
        np.testing.assert_array_equal(few.reset(), many.reset()[:2])
        for action in actions_for(many, 40, scale=1.0):
            assert_same(few.step(action[:2]), many.step(action), slice(None), slice(2))

    def test_long_runs_extend_the_ground(self):
        """The window of boxes moves, at another time in every simulation."""
        id_ = 'PD_Dog2D_Slopes_Terrain-v0'
        environments = VectorEnvironment(id_, 3, 2, seed=2, autoreset='disabled')
        alone = [suite.make(id_, {'random': int(seed)}) for seed in environments.seeds]
        environments.reset()
        world, action = environments.task.world, np.zeros((3, 20))
        for one in alone:
            one.reset()
        for push in range(1, 6):
            for env_id, one in enumerate(alone):
                x = push * (2.0 + env_id)
                height = environments.task.arena.grounds[env_id].height(np.array([x]))[0] + 1.0
                for each, i in (world, env_id), (one.task.world, 0):
                    each.qpos[i, :2] = x, height
                    each.forward(np.array([i]))
            for _ in range(3):
                environments.task.step(action, np.arange(3))
                for one, found in zip(alone, environments.task.observation, strict=True):
                    blocks = one.step(action[0]).observation.values()
                    np.testing.assert_array_equal(np.concatenate(list(blocks)), found)
                    one.core.ended[0] = False
        self.assertGreater(float(world.qpos[:, 0].min()), 9.0)


class LimitTest(parameterized.TestCase):
    """Episodes are truncated as those of a single environment."""

    @parameterized.parameters(
        ({}, 256), ({'step_limit': None, 'time_limit': 8.99}, 270), ({'time_limit': 0.5}, 15),
        ({'time_limit': 0.1}, 3), ({'time_limit': 0.7}, 21), ({'time_limit': 1e-9}, 1),
        ({'time_limit': 0.5, 'step_limit': 7}, 7), ({'time_limit': 0.2, 'step_limit': 7}, 6),
    )  # fmt: skip
    def test_same_step_as_a_single_environment(self, options, expected):
        environments = VectorEnvironment(FLAT, 2, 1, seed=0, task_kwargs=options)
        one = suite.make(FLAT, {'random': int(environments.seeds[0]), **options})
        for environment in environments, one:
            environment.task.finish_step = _never_failing(environment.task)
            environment.reset()
        ends = []
        for count in range(1, expected + min(expected, 20) + 3):
            step, time_step = environments.step(IDLE[:2]), one.step(IDLE[0])
            self.assertFalse(step.terminated.any())
            np.testing.assert_array_equal(step.truncated, time_step.last())
            ends += [count] * time_step.last()
        self.assertEqual(ends[:2], [expected, 2 * expected + 1][: len(ends)])

    def test_a_fall_in_the_step_of_the_limit_is_no_truncation(self):
        environments, steps = VectorEnvironment(GAPS, 2, 1, seed=0), 1
        environments.reset()
        while not environments.step(np.zeros((2, 11))).terminated[0]:
            steps += 1
        environments = VectorEnvironment(GAPS, 2, 1, seed=0, step_limit=steps)
        environments.reset()
        *_, step = (environments.step(np.zeros((2, 11))) for _ in range(steps))
        self.assertEqual((step.terminated[0], step.truncated[0]), (True, False))
        self.assertTrue(environments.at_limit[0])

    def test_simulations_are_truncated_independently(self):
        options = {'autoreset': 'disabled', 'task_kwargs': {'time_limit': 0.3}, 'step_limit': None}
        environments = VectorEnvironment(FLAT, 3, 1, seed=0, **options)
        environments.reset()
        for _ in range(4):
            environments.step(IDLE)
        environments.reset([1])
        other = VectorEnvironment(FLAT, 3, 1, seed=9, **options)
        other.set_state(environments.get_state())
        np.testing.assert_array_equal(other.seeds, environments.seeds)
        for each in environments, other:
            for _ in range(5):
                step = each.step(IDLE)
            np.testing.assert_array_equal(step.truncated, [True, False, True])
            each.reset([0, 2])
            for _ in range(4):
                step = each.step(IDLE)
            np.testing.assert_array_equal(step.truncated, [False, True, False])


class AutoresetTest(parameterized.TestCase):
    """Gymnasium's three autoreset modes; see also gym_test."""

    def test_modes(self):
        made, last = {}, {}
        for mode in 'next_step', 'same_step', 'disabled':
            made[mode] = VectorEnvironment(FLAT, 3, 1, seed=0, autoreset=mode, step_limit=3)
            made[mode].reset()
            for _ in range(3):
                last[mode] = made[mode].step(IDLE)
            self.assertTrue(last[mode].truncated.all())
        same, ended = last['same_step'], last['next_step']
        np.testing.assert_array_equal(same.info['final_observation'], ended.observation)
        np.testing.assert_array_equal(same.info['ended'], True)
        following = made['next_step'].step(IDLE)
        np.testing.assert_array_equal(same.observation, following.observation)
        np.testing.assert_array_equal(same.reward, ended.reward)
        with self.assertRaisesRegex(RuntimeError, 'simulation 0 has ended'):
            made['disabled'].step(IDLE)
        made['disabled'].reset(np.array([True] * 3))
        for mode in 'same_step', 'disabled':
            self.assertFalse(made[mode].step(IDLE).truncated.any())

    @parameterized.parameters({'env_ids': [1]}, {'env_ids': [False, True, False]})
    def test_a_reset_of_some_simulations_does_not_affect_others(self, env_ids):
        environments, untouched = (
            VectorEnvironment(FLAT, 3, 1, seed=4, autoreset='disabled') for _ in range(2)
        )
        before = environments.reset()
        np.testing.assert_array_equal(untouched.reset(), before)
        after = environments.reset(env_ids)
        np.testing.assert_array_equal(after[[0, 2]], before[[0, 2]])
        self.assertTrue((after[1] != before[1]).any())
        for action in actions_for(environments, 5):
            assert_same(environments.step(action), untouched.step(action), [0, 2], [0, 2])


class PartialBatchTest(parameterized.TestCase):
    """Stepping some simulations, and going on where another environment is: what a search needs."""

    @parameterized.parameters(*ONE_OF_EACH)
    def test_some_simulations(self, id_):
        """Simulation 1 rests every other step, and is no other for it than one that never rests.

        Then states of some are copied, also from another environment, and restored.
        """
        ours, theirs = (VectorEnvironment(id_, 3, 1, seed=4) for _ in range(2))
        actions, world = actions_for(ours, 3), ours.task.world
        for each in ours, theirs:
            each.reset()
        for t, action in enumerate(actions):
            expected = theirs.step(action)
            before = world.qpos[1].copy(), world.qvel[1].copy()
            waiting = ours.step(np.ones_like(action), [0, 2] if t == 1 else [2])
            np.testing.assert_array_equal(world.qpos[1], before[0])
            np.testing.assert_array_equal(world.qvel[1], before[1])
            self.assertEqual(waiting.reward[1], 0)
            for term in waiting.info['reward_terms'].values():
                self.assertEqual(term[1], 0)
            self.assertFalse(waiting.terminated[1] or waiting.truncated[1])
            assert_same(ours.step(action, np.array([False, True, False])), expected, 1, 1)

        # A swap, a cyclic shift, a fan-out: of the states before the call.
        ours.reset(), theirs.reset(seed=11)
        ours.step(actions[0])
        state, same = ours.get_state(), np.zeros_like(actions[0])
        expected = ours.step(same)
        for sources in ([1, 0], [1, 2, 0], [2, 2, 2]):
            ours.set_state(state)
            ours.copy_from(ours, sources, np.arange(len(sources)))
            assert_same(ours.step(same), expected, slice(len(sources)), sources)
        ours.set_state(state)
        theirs.copy_from(ours, [1, 1], [0, 2])
        assert_same(theirs.step(same), expected, [0, 2], [1, 1])

        # Simulations 0 and 2 go back by two steps; 1 does not notice.
        kept = ours.get_state([2, 0])
        ours.step(actions[0]), ours.step(actions[1])
        ours.set_state(kept, [2, 0])
        theirs.set_state(state)
        theirs.step(actions[0], [1]), theirs.step(actions[1], [1])
        for action in actions:
            assert_same(ours.step(action), theirs.step(action))
        np.testing.assert_array_equal(ours.reset(), theirs.reset())

    def test_copies_have_random_streams_of_their_own(self):
        one, other = (VectorEnvironment(GAPS, 2, 1, seed=4) for _ in range(2))
        one.reset(), other.reset()
        one.copy_from(one, [0], [1])
        np.testing.assert_array_equal(one.reset(), other.reset())

    def test_an_ended_simulation_waits_for_its_reset(self):
        environments = VectorEnvironment(GAPS, 3, 1, 0, step_limit=2)
        environments.reset()
        action = np.zeros((3, len(environments.action_map)))
        environments.step(action, [0, 1])
        step = environments.step(action, [0])
        np.testing.assert_array_equal(step.truncated, [True, False, False])
        for _ in range(2):
            step = environments.step(action, [2])
        np.testing.assert_array_equal(step.truncated, [False, False, True])
        step = environments.step(action)  # the first and the last are reset, the other ends
        np.testing.assert_array_equal(step.truncated, [False, True, False])
        np.testing.assert_array_equal(step.reward > 0, [False, True, False])

    def test_a_restored_end_waits_for_its_step(self):
        ended = VectorEnvironment(FLAT, 3, 1, 0, autoreset='disabled', step_limit=1)
        environments = VectorEnvironment(FLAT, 3, 1, 0, autoreset='same_step')
        for each in ended, environments:
            each.reset()
            each.step(IDLE)
        environments.set_state(ended.get_state([1]), [1])
        step = environments.step(IDLE, [0])
        np.testing.assert_array_equal(step.info['ended'], [False, False, False])
        self.assertEqual(environments.core.steps.tolist(), [2, 1, 1])

    @parameterized.parameters('next_step', 'disabled')
    def test_actions_that_are_ignored_may_be_anything(self, autoreset):
        """Those of simulations that begin again or do not take a step; the limit is left by a reset."""
        environments = VectorEnvironment(FLAT, 3, 1, 0, autoreset=autoreset, step_limit=2)
        environments.reset()
        action = np.array(IDLE)
        action[1] = np.nan
        environments.step(action, [0, 2])
        environments.step(action, [0, 2])
        np.testing.assert_array_equal(environments.at_limit, [True, False, True])
        if autoreset == 'next_step':
            environments.step(np.where([[True], [False], [True]], np.nan, IDLE))
            environments.step(IDLE, [1])
        seeds = environments.seeds
        environments.reset(seed=4)
        self.assertNoCommonElements(seeds.tolist(), environments.seeds.tolist())
        self.assertFalse(environments.at_limit.any())
        with self.assertRaisesRegex(ValueError, 'simulation 1, number 0 .* is nan'):
            environments.step(action)

    def test_none_of_them(self):
        """Loops that reset or step those that a mask names need not ask whether it names any."""
        environments = VectorEnvironment(FLAT, 3, 1, 0, autoreset='disabled')
        before = environments.reset()
        state = pickle.dumps(environments.get_state())
        for none in ([], (), np.zeros(3, bool), np.zeros(0, int), np.zeros(0)):
            np.testing.assert_array_equal(environments.reset(none), before)
            np.testing.assert_array_equal(environments.reset(none, seed=4), before)
            step = environments.step(IDLE, none)
            np.testing.assert_array_equal(step.observation, before)
            np.testing.assert_array_equal(step.reward, 0)
            environments.set_state(environments.get_state(none), none)
            environments.copy_from(environments, [], none)
        self.assertEqual(pickle.dumps(environments.get_state()), state)


class RefusalTest(parameterized.TestCase):
    """Errors are reported, and change nothing."""

    def setUp(self):
        super().setUp()
        self.environments = VectorEnvironment(FLAT, 3, 1, seed=0)

    def test_before_the_first_reset(self):
        environments = self.environments
        state = environments.get_state([1])
        assert_refused(
            self,
            (lambda: environments.step(IDLE), 'before the first reset'),
            (lambda: environments.set_state(state, [1]), 'some simulations before the first reset'),
            (lambda: environments.copy_from(environments, [0], [1]), 'before the first reset'),
            error=RuntimeError,
        )

    def test_calls(self):
        environments, other = self.environments, VectorEnvironment(GAPS, 2, 1, 0)
        single = suite.make(FLAT)
        for each in environments, other, single:
            each.reset()
        one, two = environments.get_state([1]), environments.get_state([1, 2])
        before, copy, step = (
            pickle.dumps(environments.get_state()),
            environments.copy_from,
            environments.step,
        )
        none = r'env_ids are \[3\]; expected numbers in \[0, 3\)'
        few, belongs = (
            'the state has 1 simulations; expected',
            'the state belongs to another environment: ',
        )
        partial = {
            name: value for name, value in environments.get_state().items() if name != 'ended'
        }
        far, values = np.zeros((3, 6)), (np.nan, np.inf, -np.inf)
        assert_refused(
            self,
            *((lambda n=n: environments.set_state(one, n), few) for n in ([0, 1], None, [])),
            (lambda: environments.set_state(two, [1, 1]), 'each of 2 simulations once'),
            (lambda: environments.set_state(one, [3]), none), (lambda: environments.get_state([3]), none),
            (lambda: step(IDLE, [3]), none), (lambda: copy(environments, [3], [1]), none),
            (lambda: copy(other, [0], [1]), f'cannot copy simulations of {GAPS} to {FLAT}'),
            (lambda: copy(environments, [0, 1], [1]), 'cannot copy 2 simulations to simulations .1.'),
            *((lambda s=s: environments.set_state(s), belongs) for s in (other.get_state(), {}, single.get_state())),
            (lambda: single.set_state(environments.get_state()), 'another environment: environment vector'),
            (lambda: environments.set_state(partial), 'its checksum differs'),
            *((lambda a=a: step(a), 'shape') for a in (np.zeros((3, 5)), np.zeros(6))),
            *((lambda v=v: step(np.where(np.arange(18).reshape(3, 6) == 16, v, far)),
               r'simulation 2, number 4 \(left_knee\)') for v in values),
            (lambda: step(np.full((3, 6), 'a')), 'array of numbers'),
            *((lambda d=d: step(np.zeros((3, 6), int).astype(d)), 'not an array of numbers: the type is')
              for d in ('datetime64[D]', 'timedelta64[s]', complex, 'U1')),
        )  # fmt: skip
        strange, calls = ([0.7], ['a'], [[0, 1]], [None]), (
            environments.reset, environments.get_state, lambda ids: environments.seed(3, ids),
            lambda ids: step(IDLE, ids), lambda ids: environments.set_state(one, ids),
            lambda ids: copy(environments, [0], ids), lambda ids: environments.render(ids[0]),
        )  # fmt: skip
        assert_refused(
            self,
            (lambda: copy(single, [0], [1]), 'other is Environment; expected VectorEnvironment'),
            *((lambda e=e, s=s: e.set_state(s), 'a state is a dict from get_state, not ')
              for e in (environments, single) for s in (None, [], 3)),
            *((lambda c=c, i=i: c(i), 'env_ids is .* expected integers') for i in strange for c in calls),
            error=TypeError,
        )  # fmt: skip
        self.assertEqual(pickle.dumps(environments.get_state()), before)

    def test_a_reset_that_fails(self):
        """Seeds stay, and what is half made is not stepped."""
        broken = []

        def hill(x):
            if broken:
                raise RuntimeError('broken')
            return 0.1 * np.maximum(x, 0)

        ground = terrain.from_function(hill, 'hill', replace=True)
        spec = suite.combine('biped2d', terrain=ground)
        environments, single = (
            VectorEnvironment(spec, 3, 1, 0),
            suite.build_environment(spec, {}, {}),
        )
        seeds = environments.seeds.copy()
        with self.assertRaisesRegex(ValueError, 'levels'):
            environments.reset(seed=5, level=3)
        np.testing.assert_array_equal(environments.seeds, seeds)
        for each in environments, single:
            each.reset()
            broken.append(True)
            with self.assertRaisesRegex(RuntimeError, 'broken'):
                each.reset()
            self.assertTrue(each.core.ended.all())
            broken.clear()
        self.assertTrue(single.step(IDLE[0]).first())
        step = environments.step(np.zeros((3, len(environments.action_map))))
        self.assertFalse(step.terminated.any())

    def test_arguments(self):
        many = 'num_envs is .*; expected a whole number from 1'
        threads = 'num_threads is .*; expected a whole number from 0'
        limit = 'step_limit is .*; expected None or a whole number at least 1'
        seconds = 'time_limit is .*; expected a positive number of seconds'
        seeds = r'seed is \[.*; expected an integer in'
        values = (
            *(({'num_envs': n}, many) for n in (0, 'abc', None, np.inf, np.nan, [2], True, 2**32)),
            *(({'num_threads': n}, threads) for n in (-1, 'abc', None, np.inf, 1.5, 2**40)),
            *(({'step_limit': n}, limit) for n in ('abc', np.inf, [1, 2], -2)),
            *(({'task_kwargs': {'step_limit': n}}, limit) for n in (0, -1, 2.5)),
            *(({'task_kwargs': {'time_limit': t}}, seconds) for t in (0, np.nan)),
            *(({'seed': s}, seeds) for s in ([1.5, 2, 3], [True, False, True], [[1], [2, 3], 4], [1, -2, 3])),
            *(({'dtype': d}, 'dtype is .*; expected float64 or float32') for d in ('x', 3, np.int32)),
            ({'seed': -1}, 'seed is -1; expected 0 or a positive integer'),
            ({'seed': [1, 2]}, '2 seeds for 3 simulations'), ({'autoreset': 'next'}, "did you mean 'next_step'"),
            ({'flat_observation': 'x'}, "flat_observation is 'x'; expected True or False"),
            ({'environment': 'PD_Biped2D_Gap_Terrain-v0'}, 'PD_Biped2D_Gaps_Terrain-v0'),
            ({'task_kwargs': {'sub_steps': 3}}, "did you mean 'substeps'"),
            ({'task_kwargs': {'random': 3}}, "'random'.*`seed`"), ({'task_kwargs': {'time_limt': 3}}, 'time_limt'),
        )  # fmt: skip
        types = (
            ({'environment': 3}, 'an environment is an id, an alias or an EnvSpec, not 3'),
            ({'environment': None}, 'an environment is an id'), ({'seed': 2.5}, 'seed is 2.5; expected'),
            ({'seed': 'abc'}, "seed is 'abc'; expected an integer"),
            ({'task_kwargs': 3}, 'task_kwargs is 3; expected a dict of options'),
        )  # fmt: skip
        usual = {'environment': FLAT, 'num_envs': 3, 'num_threads': 1}
        for cases, error in ((values, ValueError), (types, TypeError)):
            calls = ((lambda o=o: VectorEnvironment(**usual | o), message) for o, message in cases)
            assert_refused(self, *calls, error=error)

    def test_a_closed_environment(self):
        environments, other = self.environments, VectorEnvironment(FLAT, 3, 1, seed=0)
        environments.reset(), other.reset()
        state = environments.get_state()
        environments.close()
        environments.close()
        calls = (
            lambda: environments.step(IDLE), environments.reset, environments.render,
            environments.get_state, lambda: environments.set_state(state),
            lambda: environments.seed(1), lambda: environments.info, lambda: environments.task,
            lambda: environments.copy_from(other, [0], [0]),
            lambda: other.copy_from(environments, [0], [0]),
        )  # fmt: skip
        cases = ((call, 'the environment is closed') for call in calls)
        assert_refused(self, *cases, error=RuntimeError)
        with self.assertRaisesRegex(TypeError, 'get_state'):
            pickle.dumps(other)


class ProcessTest(parameterized.TestCase):
    """Single precision, blocks, and other processes."""

    def test_float32_and_blocks(self):
        options = {'dtype': np.float32, 'flat_observation': False}
        environments = VectorEnvironment(GAPS, 2, 1, seed=0, **options)
        observation = environments.reset()
        self.assertEqual(list(observation), ['terrain', 'pose', 'velocity', 'phase'])
        self.assertEqual({value.dtype for value in observation.values()}, {np.dtype(np.float32)})
        self.assertEqual(observation['terrain'].shape, (2, 50))
        self.assertEqual(environments.step(np.zeros((2, 11))).reward.dtype, np.float32)

    def test_a_spawned_worker_continues_from_the_parents_state(self):
        context = multiprocessing.get_context('spawn')
        spec = {'environment': FLAT, 'num_envs': 3, 'num_threads': 1, 'seed': 0}
        environments = VectorEnvironment(**spec)
        first = environments.reset()
        actions = actions_for(environments, 25, scale=1.0)  # with falls and resets
        for action in actions[:10]:
            environments.step(action)
        arguments = pickle.dumps((spec, environments.get_state(), actions[10:]))
        answers = context.Queue()
        worker = context.Process(target=_go_on, args=(arguments, answers))
        worker.start()
        steps = [environments.step(action) for action in actions[10:]]
        self.assertTrue(any(step.terminated.any() for step in steps))
        theirs, found = answers.get(timeout=100)
        np.testing.assert_array_equal(theirs, first)
        np.testing.assert_array_equal(found, [np.column_stack([*step[:4]]) for step in steps])
        worker.join(timeout=60)
        self.assertEqual(worker.exitcode, 0)

    @parameterized.parameters('os._exit(0)', 'sys.exit(0)')
    def test_a_forked_worker_makes_its_own(self, leave):
        if not hasattr(os, 'fork'):
            self.skipTest('no fork here')
        done = subprocess.run(
            [sys.executable, '-c', FORKED.replace('LEAVE', leave)],
            capture_output=True, text=True, timeout=100,
        )  # fmt: skip
        self.assertEqual(done.returncode, 0, done.stderr)
        self.assertIn('cannot be used after a fork', done.stdout)
        self.assertEndsWith(done.stdout, 'True\nchild 0\n')


FORKED = f"""
import os, signal, sys
import numpy as np
from trl_suite.vector import VectorEnvironment

make = lambda: VectorEnvironment({FLAT!r}, 8, 2, seed=0)  # enough for two threads
roll = lambda simulations: [simulations.reset(), simulations.step(np.ones((8, 6))).observation]
simulations, other = make(), make()
expected = roll(simulations)
child = os.fork()
if child == 0:
    signal.alarm(30)
    try:
        simulations.step(np.ones((8, 6)))
    except RuntimeError as error:
        print(error)
    other.close()
    simulations = make()  # lets the inherited one go, which must not wait for its threads
    print(np.array_equal(roll(simulations), expected), flush=True)
    LEAVE
status = os.waitpid(child, 0)[1]
simulations.step(np.ones((8, 6)))  # unharmed
print('child', status)
"""


def _never_failing(task):
    finish_step = task.finish_step

    def finish(*arguments):
        finish_step(*arguments)
        task.failed[:] = False

    return finish


def _go_on(arguments, answers):
    spec, state, actions = pickle.loads(arguments)
    environments = VectorEnvironment(**spec)
    first = environments.reset()
    environments.set_state(state)
    answers.put((first, [np.column_stack([*environments.step(action)[:4]]) for action in actions]))
