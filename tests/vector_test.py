"""Many simulations behave as single environments do, bit for bit, and never disturb each other."""

import multiprocessing
import os
import pickle
import subprocess
import sys

import numpy as np
from absl.testing import parameterized
from helpers import assert_refused

from trl_suite import suite
from trl_suite.registry import catalogue
from trl_suite.vector import VectorEnvironment

GAPS = 'PD_Biped2D_Gaps_Terrain-v0'
FLAT = 'PD_Biped2D_LLC_Imitate_Flat-v0'


class IdentityTest(parameterized.TestCase):
    """A simulation is the single environment with its seed."""

    def test_results_do_not_depend_on_num_envs_and_threads(self):
        few = VectorEnvironment(GAPS, 2, 1, seed=[7, 8])
        many = VectorEnvironment(GAPS, 9, 2, seed=[7, 8, *range(20, 27)])
        np.testing.assert_array_equal(few.reset(), many.reset()[:2])
        random = np.random.default_rng(0)
        for _ in range(60):
            action = random.uniform(-1, 1, (9, 11))
            a, b = few.step(action[:2]), many.step(action)
            np.testing.assert_array_equal(a.observation, b.observation[:2])
            np.testing.assert_array_equal(a.reward, b.reward[:2])

    def test_long_runs_extend_the_ground(self):
        # 14 m at 4 m/s: the window of boxes moves, at another time in every simulation.
        environments = VectorEnvironment(
            'PD_Dog2D_Slopes_Terrain-v0', 3, 2, seed=2, autoreset='disabled'
        )
        alone = [
            suite.make('PD_Dog2D_Slopes_Terrain-v0', {'random': int(seed)})
            for seed in environments.seeds
        ]
        environments.reset()
        world, ids = environments.task.world, np.arange(3)
        for one in alone:
            one.reset()
        for push in range(1, 6):
            for env_id, one in enumerate(alone):
                x = push * (2.0 + env_id)
                height = environments.task.arena.grounds[env_id].height(np.array([x]))[0] + 1.0
                world.qpos[env_id, :2] = x, height
                one.physics.data.qpos[:2] = x, height
                one.task.world.forward(np.zeros(1, int))
            world.forward(np.arange(3))
            action = np.zeros((3, 20))
            for _ in range(3):
                environments.task.step(action, ids)
                steps = [one.step(a) for one, a in zip(alone, action, strict=True)]
                for one, env_id in zip(steps, environments.task.observation, strict=True):
                    np.testing.assert_array_equal(
                        np.concatenate(list(one.observation.values())), env_id
                    )
                if any(one.last() for one in steps):
                    for one in alone:
                        one.core.ended[0] = False
        self.assertGreater(float(world.qpos[:, 0].min()), 9.0)


class LimitTest(parameterized.TestCase):
    """Episodes are truncated as those of a single environment."""

    @parameterized.parameters(
        ({}, 256), ({'step_limit': None, 'time_limit': 8.99}, 270), ({'time_limit': 0.5}, 15),
        ({'time_limit': 0.1}, None), ({'time_limit': 0.7}, None), ({'time_limit': 1e-9}, 1),
        ({'time_limit': 0.5, 'step_limit': 7}, 7), ({'time_limit': 0.2, 'step_limit': 7}, None),
    )  # fmt: skip
    def test_same_step_as_a_single_environment(self, options, expected):
        environments = VectorEnvironment(FLAT, 2, 1, seed=0, task_kwargs=options)
        one = suite.make(FLAT, {'random': int(environments.seeds[0]), **options})
        for environment in environments, one:
            environment.task.finish_step = _never_failing(environment.task)
        environments.reset()
        one.reset()
        idle, ends = np.zeros((2, 6)), []
        for count in range(1, 2 * (expected or 30) + 3):
            step, time_step = environments.step(idle), one.step(idle[0])
            self.assertFalse(step.terminated.any())
            np.testing.assert_array_equal(step.truncated, time_step.last())
            if time_step.last():
                ends.append(count)
        self.assertGreaterEqual(len(ends), 2)
        self.assertEqual(ends[0], expected or ends[0])
        self.assertEqual(ends[1], 2 * ends[0] + 1)

    def test_simulations_are_truncated_independently(self):
        options = {'time_limit': 0.3}
        environments = VectorEnvironment(
            FLAT, 3, 1, seed=0, autoreset='disabled', task_kwargs=options, step_limit=None
        )
        environments.reset()
        idle = np.zeros((3, 6))
        for _ in range(4):
            environments.step(idle)
        environments.reset([1])
        state = environments.get_state()
        other = VectorEnvironment(
            FLAT, 3, 1, seed=9, autoreset='disabled', task_kwargs=options, step_limit=None
        )
        other.set_state(state)
        for each in environments, other:
            for _ in range(5):
                step = each.step(idle)
            np.testing.assert_array_equal(step.truncated, [True, False, True])
            each.reset([0, 2])
            for _ in range(4):
                step = each.step(idle)
            np.testing.assert_array_equal(step.truncated, [False, True, False])


class AutoresetTest(parameterized.TestCase):
    """Gymnasium's three autoreset modes."""

    def run_to_the_end(self, autoreset):
        environments = VectorEnvironment(FLAT, 4, 1, seed=0, autoreset=autoreset, step_limit=3)
        environments.reset()
        for _ in range(3):
            step = environments.step(np.zeros((4, 6)))
        self.assertTrue(step.truncated.all())
        return environments, step

    def test_same_step_keeps_the_last_observation(self):
        environments, step = self.run_to_the_end('same_step')
        other, last = self.run_to_the_end('next_step')
        np.testing.assert_array_equal(step.info['final_observation'], last.observation)
        np.testing.assert_array_equal(step.info['ended'], True)
        np.testing.assert_array_equal(step.observation, other.step(np.zeros((4, 6))).observation)
        np.testing.assert_array_equal(step.reward, last.reward)
        self.assertFalse(environments.step(np.zeros((4, 6))).truncated.any())

    def test_disabled_asks_for_a_reset(self):
        environments, step = self.run_to_the_end('disabled')
        with self.assertRaisesRegex(RuntimeError, 'simulation 0 has ended'):
            environments.step(np.zeros((4, 6)))
        environments.reset(np.array([True] * 4))
        self.assertFalse(environments.step(np.zeros((4, 6))).truncated.any())
        self.assertEqual(step.reward.shape, (4,))

    @parameterized.parameters({'env_ids': [1, 3]}, {'env_ids': [False, True, False, True]})
    def test_a_reset_of_some_simulations_does_not_affect_others(self, env_ids):
        environments, untouched = (
            VectorEnvironment(FLAT, 4, 1, seed=4, autoreset='disabled') for _ in range(2)
        )
        before = environments.reset()
        np.testing.assert_array_equal(untouched.reset(), before)
        after = environments.reset(env_ids)
        np.testing.assert_array_equal(after[[0, 2]], before[[0, 2]])
        self.assertTrue((after[[1, 3]] != before[[1, 3]]).any(1).all())
        action = np.random.default_rng(0).uniform(-0.1, 0.1, (4, 6))
        for _ in range(5):
            a, b = environments.step(action), untouched.step(action)
            np.testing.assert_array_equal(a.observation[[0, 2]], b.observation[[0, 2]])


KINDS = tuple({spec.task_type: spec.id for spec in catalogue.SPECS}.values())  # one id of each task
ALONE = np.array([False, True, False])


class PartialBatchTest(parameterized.TestCase):
    """Stepping some simulations, and going on where another environment is: what a search needs."""

    @parameterized.parameters(*KINDS)
    def test_simulations_that_are_not_stepped_do_not_change(self, id_):
        """Simulation 1 rests every other step, and is no other for it than the simulation that never rests."""
        specs, other = (VectorEnvironment(id_, 3, 1, seed=4) for _ in range(2))
        random = np.random.default_rng(0)
        actions = random.uniform(-0.1, 0.1, (3, 3, len(specs.action_map)))
        for each in (specs, other):
            each.reset()
        for t, action in enumerate(actions):
            expected = other.step(action)
            before = specs.task.world.qpos[1].copy(), specs.task.world.qvel[1].copy()
            waiting = specs.step(np.ones_like(action), [0, 2] if t == 1 else [2])
            np.testing.assert_array_equal(specs.task.world.qpos[1], before[0])
            np.testing.assert_array_equal(specs.task.world.qvel[1], before[1])
            self.assertEqual(waiting.reward[1], 0)
            self.assertFalse(waiting.terminated[1] or waiting.truncated[1])
            step = specs.step(action, ALONE)
            np.testing.assert_array_equal(step.observation[1], expected.observation[1])
            self.assertEqual(step.reward[1], expected.reward[1])
            self.assertEqual(step.terminated[1], expected.terminated[1])

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
        with self.assertRaisesRegex(ValueError, r'env_ids are \[3\]; expected numbers in \[0, 3\)'):
            environments.step(action, [3])

    @parameterized.parameters(*KINDS)
    def test_copies(self, id_):
        """A swap, a cyclic shift, a fan-out, and from another environment, in its state before the call."""
        environments, copies = (VectorEnvironment(id_, 3, 1, seed=4) for _ in range(2))
        action = np.random.default_rng(0).uniform(-0.1, 0.1, (3, len(environments.action_map)))
        same = np.zeros((3, action.shape[1]))
        for each in environments, copies:
            each.reset()
            each.step(action)
        state, expected = copies.get_state(), environments.step(same)
        for sources in ([1, 0], [1, 2, 0], [2, 2, 2]):
            copies.set_state(state)
            copies.copy_from(copies, sources, np.arange(len(sources)))
            step = copies.step(same)
            for found, wanted in zip(step[:2], expected[:2], strict=True):
                np.testing.assert_array_equal(found[: len(sources)], wanted[sources])
        other, expected = VectorEnvironment(id_, 4, 1, seed=9), None
        other.reset()
        other.copy_from(environments, [1, 0, 1], [0, 1, 3])
        expected, step = environments.step(action), other.step(action[[1, 0, 2, 1]])
        np.testing.assert_array_equal(step.observation[[0, 1, 3]], expected.observation[[1, 0, 1]])
        np.testing.assert_array_equal(step.reward[[0, 1, 3]], expected.reward[[1, 0, 1]])

    @parameterized.parameters(*KINDS)
    def test_single_simulations_can_be_restored(self, id_):
        env_ids, twin = (VectorEnvironment(id_, 3, 1, seed=4) for _ in range(2))
        action = np.random.default_rng(0).uniform(-0.1, 0.1, (3, len(env_ids.action_map)))
        for each in (env_ids, twin):
            each.reset()
            each.step(action)
        state = env_ids.get_state([2, 0])
        env_ids.step(action)
        env_ids.step(-action)
        env_ids.set_state(state, [2, 0])
        twin.step(action, [1])
        twin.step(-action, [1])
        for each in (action, -action):
            step, expected = env_ids.step(each), twin.step(each)
            np.testing.assert_array_equal(step.observation, expected.observation)
            np.testing.assert_array_equal(step.reward, expected.reward)
        np.testing.assert_array_equal(env_ids.reset(), twin.reset())

    def test_invalid_states_are_rejected(self):
        environments = VectorEnvironment(GAPS, 3, 1, 0)
        state = environments.get_state([1])
        with self.assertRaisesRegex(RuntimeError, 'some simulations before the first reset'):
            environments.set_state(state, [1])
        environments.reset()
        many, few = environments.get_state([1, 2]), 'the state has 1 simulations; expected'
        none = r'env_ids are \[3\]; expected numbers in \[0, 3\)'
        assert_refused(
            self,
            *((lambda n=n: environments.set_state(state, n), few) for n in ([0, 1], None, [])),
            (lambda: environments.set_state(many, [1, 1]), 'each of 2 simulations once'),
            (lambda: environments.set_state(state, [3]), none),
            (lambda: environments.get_state([3]), none),
        )

    @parameterized.parameters(1, 2)
    def test_none_of_them(self, num_threads):
        """Loops that reset or step those that a mask names need not ask whether it names any."""
        environments = VectorEnvironment(FLAT, 3, num_threads, 0, autoreset='disabled')
        before, idle = environments.reset(), np.zeros((3, 6))
        state = pickle.dumps(environments.get_state())
        for none in ([], (), np.zeros(3, bool), np.zeros(0, int), np.zeros(0)):
            np.testing.assert_array_equal(environments.reset(none), before)
            np.testing.assert_array_equal(environments.reset(none, seed=4), before)
            step = environments.step(idle, none)
            np.testing.assert_array_equal(step.observation, before)
            np.testing.assert_array_equal(step.reward, 0)
            environments.set_state(environments.get_state(none), none)
            environments.copy_from(environments, [], none)
        self.assertEqual(pickle.dumps(environments.get_state()), state)

    @parameterized.parameters(
        'Torque_Biped2D_LLC_Imitate_Flat-v0', 'Vel_Biped2D_LLC_Imitate_Flat-v0', GAPS,
        'PD_Biped2D_LLC_Imitate_Run_Flat-v0',
    )  # fmt: skip
    def test_a_state_of_another_environment(self, id_):
        environments, other = (VectorEnvironment(each, 2, 1, 0) for each in (FLAT, id_))
        for each in environments, other:
            each.reset()
        before = pickle.dumps(environments.get_state())
        single = suite.make(FLAT)
        single.reset()
        for state in (other.get_state(), {}, single.get_state()):
            with self.assertRaisesRegex(ValueError, 'the state belongs to another environment: '):
                environments.set_state(state)
        with self.assertRaisesRegex(ValueError, 'another environment: environment vector'):
            single.set_state(environments.get_state())
        for state in (None, [], 3):
            for each in environments, single:
                with self.assertRaisesRegex(TypeError, 'a state is a dict from get_state, not '):
                    each.set_state(state)
        self.assertEqual([*single.get_state()], [*environments.get_state()])
        partial = environments.get_state()
        del partial['ended']
        with self.assertRaisesRegex(ValueError, 'its checksum differs'):
            environments.set_state(partial)
        self.assertEqual(pickle.dumps(environments.get_state()), before)

    def test_invalid_copies_are_rejected(self):
        environments, other = VectorEnvironment(GAPS, 2, 1, 0), VectorEnvironment(FLAT, 2, 1, 0)
        with self.assertRaisesRegex(RuntimeError, 'before the first reset'):
            environments.copy_from(environments, [0], [1])
        environments.reset(), other.reset()
        copy = environments.copy_from
        with self.assertRaisesRegex(TypeError, 'other is Environment; expected VectorEnvironment'):
            copy(suite.make(FLAT), [0], [1])
        assert_refused(
            self,
            (lambda: copy(other, [0], [1]), f'cannot copy simulations of {FLAT} to {GAPS}'),
            (lambda: copy(environments, [0, 1], [1]), 'cannot copy 2 simulations to simulations .1.'),
            (lambda: copy(environments, [2], [1]), r'env_ids are \[2\]; expected numbers in \[0, 2\)'),
        )  # fmt: skip


class RobustnessTest(parameterized.TestCase):
    """Errors are reported, and do not affect other simulations."""

    def setUp(self):
        super().setUp()
        self.environments = VectorEnvironment(FLAT, 3, 1, seed=0)
        self.environments.reset()

    def test_invalid_actions_are_rejected(self):
        environments = self.environments
        bad = [
            (np.zeros((3, 5)), 'shape'),
            (np.zeros(6), 'shape'),
            (np.full((3, 6), 'a'), 'array of numbers'),
        ]
        for value in (np.nan, np.inf, -np.inf):
            action = np.zeros((3, 6))
            action[2, 4] = value
            bad.append((action, r'simulation 2, number 4 \(left_knee\)'))
        for dtype in ('datetime64[D]', 'timedelta64[s]', complex, 'U1'):
            bad.append(
                (np.zeros((3, 6), int).astype(dtype), 'not an array of numbers: the type is')
            )
        before = pickle.dumps(environments.get_state())
        assert_refused(self, *((lambda a=a: environments.step(a), message) for a, message in bad))
        self.assertEqual(pickle.dumps(environments.get_state()), before)

    def test_invalid_arguments_are_rejected(self):
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

    @parameterized.parameters([[0.7]], [['a']], [[[0, 1]]], [[None]])
    def test_numbers_of_simulations_that_are_none(self, env_ids):
        environments, before = self.environments, pickle.dumps(self.environments.get_state())
        for call in (
            environments.reset, environments.get_state, lambda ids: environments.seed(3, ids),
            lambda ids: environments.step(np.zeros((3, 6)), ids),
            lambda ids: environments.set_state(environments.get_state([0]), ids),
            lambda ids: environments.copy_from(environments, [0], ids),
            lambda ids: environments.render(ids[0]),
        ):  # fmt: skip
            with self.assertRaisesRegex(TypeError, 'env_ids is .* expected integers'):
                call(env_ids)
        self.assertEqual(pickle.dumps(environments.get_state()), before)

    def test_a_closed_environment_raises_errors(self):
        environments, other = self.environments, VectorEnvironment(FLAT, 3, 1, seed=0)
        other.reset()
        state = environments.get_state()
        environments.close()
        environments.close()
        for call in (
            lambda: environments.step(np.zeros((3, 6))), environments.reset, environments.render,
            environments.get_state, lambda: environments.set_state(state),
            lambda: environments.seed(1), lambda: environments.info, lambda: environments.task,
            lambda: environments.copy_from(other, [0], [0]),
            lambda: other.copy_from(environments, [0], [0]),
        ):  # fmt: skip
            with self.assertRaisesRegex(RuntimeError, 'the environment is closed'):
                call()
        with self.assertRaisesRegex(RuntimeError, 'before the first reset'):
            VectorEnvironment(FLAT, 2, 1).step(np.zeros((2, 6)))
        with self.assertRaisesRegex(TypeError, 'get_state'):
            pickle.dumps(other)

    def test_float32_and_blocks(self):
        environments = VectorEnvironment(
            GAPS, 2, 1, seed=0, dtype=np.float32, flat_observation=False
        )
        observation = environments.reset()
        self.assertEqual(list(observation), ['terrain', 'pose', 'velocity', 'phase'])
        self.assertEqual({value.dtype for value in observation.values()}, {np.dtype(np.float32)})
        self.assertEqual(observation['terrain'].shape, (2, 50))
        self.assertEqual(environments.step(np.zeros((2, 11))).reward.dtype, np.float32)

    def test_spawned_workers_continue_from_the_parents_state(self):
        context = multiprocessing.get_context('spawn')
        spec = {'environment': FLAT, 'num_envs': 3, 'num_threads': 1, 'seed': 0}
        random = np.random.default_rng(0)
        actions = random.uniform(-1, 1, (25, 3, 6))  # falls and resets are among the steps
        for action in actions[:10]:
            self.environments.step(action)
        arguments = pickle.dumps((spec, self.environments.get_state(), actions[10:]))
        answers, workers = context.Queue(), []
        for _ in range(2):
            workers.append(context.Process(target=_go_on, args=(arguments, answers)))
            workers[-1].start()
        steps = [self.environments.step(action) for action in actions[10:]]
        self.assertTrue(any(step.terminated.any() for step in steps))
        expected = [np.column_stack([*step[:4]]) for step in steps]
        first = VectorEnvironment(**spec).reset()
        for _ in workers:
            theirs, found = answers.get(timeout=100)
            np.testing.assert_array_equal(theirs, first)
            np.testing.assert_array_equal(found, expected)
        for worker in workers:
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

make = lambda: VectorEnvironment({FLAT!r}, 2, 2, seed=0)
roll = lambda simulations: [simulations.reset(), simulations.step(np.ones((2, 6))).observation]
simulations, other = make(), make()
expected = roll(simulations)
child = os.fork()
if child == 0:
    signal.alarm(30)
    try:
        simulations.step(np.ones((2, 6)))
    except RuntimeError as error:
        print(error)
    other.close()
    simulations = make()  # lets the inherited one go, which must not wait for its threads
    print(np.array_equal(roll(simulations), expected), flush=True)
    LEAVE
status = os.waitpid(child, 0)[1]
simulations.step(np.ones((2, 6)))  # unharmed
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
