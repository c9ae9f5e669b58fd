"""Many rows behave as single environments do, bit for bit, and never disturb each other."""

import multiprocessing
import os
import pickle
import subprocess
import sys

import mujoco
import numpy as np
from absl.testing import parameterized
from helpers import assert_rows_are_singles

from trl_suite import suite
from trl_suite.registry import catalogue
from trl_suite.vector import AUTORESET, VectorEnvironment

GAPS = 'PD_Biped2D_Gaps_Terrain-v0'
FLAT = 'PD_Biped2D_LLC_Imitate_Flat-v0'
LIMIT = 12  # control steps: short episodes, so that rows are reset in the middle


class IdentityTest(parameterized.TestCase):
    """A row is the single environment with its seed."""

    @parameterized.parameters(*suite.ALL_IDS)
    def test_every_row_is_a_single_environment(self, id_):
        # A step of a gait is a whole cycle, one above a controller a footstep; gait_test and
        # high_level_test look closer.
        limit, steps, scale = LIMIT, 2 * LIMIT + 6, 1.0
        if suite.find(id_).rules == 'gait':
            limit, steps, scale = 1, 4, 0.3
        elif suite.find(id_).rules in ('hike', 'soccer'):
            limit, steps = 3, 8
        _, ends = assert_rows_are_singles(id_, 3, steps, limit, scale=scale, seed=5)
        self.assertGreaterEqual(ends, 6)

    @parameterized.parameters(1, 2, 3)
    def test_threads_do_not_matter(self, threads):
        found = []
        for number in (1, threads):
            rows = VectorEnvironment(GAPS, 5, num_threads=number, seed=1)
            rows.reset()
            random = np.random.default_rng(3)
            for _ in range(30):
                step = rows.step(random.uniform(-1, 1, (5, 11)))
            found.append(step.observation)
        np.testing.assert_array_equal(*found)

    @parameterized.parameters('MTU_Biped2D_LLC_Imitate_Flat-v0', 'PD_Dog2D_Slopes_Terrain-v0')
    def test_rows_are_reset_as_the_engine_does(self, id_):
        rows = VectorEnvironment(id_, 4, 1, seed=1)
        rows.reset()
        rows.step(np.ones((4, len(rows.action_map))))
        world, which, found = rows.task.world, np.array([1, 3]), []
        for row in which:
            world.set_state(row, np.ones_like(world.get_state(row)))
        world.reset(which)
        fresh = mujoco.MjData(world.models[0])
        initial = np.empty(len(world.get_state(0)))
        mujoco.mj_getState(world.models[0], fresh, initial, mujoco.mjtState.mjSTATE_INTEGRATION)
        for row in range(4):
            found.append((world.get_state(row) == initial).all())
        self.assertEqual(found, [False, True, False, True])
        np.testing.assert_array_equal(world.qpos[which], [fresh.qpos] * 2)
        self.assertFalse(world.diverged()[which].any())

    def test_the_number_of_rows_does_not_matter(self):
        few = VectorEnvironment(GAPS, 2, 1, seed=[7, 8])
        many = VectorEnvironment(GAPS, 9, 2, seed=[7, 8, *range(20, 27)])
        np.testing.assert_array_equal(few.reset(), many.reset()[:2])
        random = np.random.default_rng(0)
        for _ in range(60):
            action = random.uniform(-1, 1, (9, 11))
            a, b = few.step(action[:2]), many.step(action)
            np.testing.assert_array_equal(a.observation, b.observation[:2])
            np.testing.assert_array_equal(a.reward, b.reward[:2])

    def test_long_runs_go_over_new_ground(self):
        # 14 m at 4 m/s: the window of boxes is laid anew, at another time in every row.
        rows = VectorEnvironment('PD_Dog2D_Slopes_Terrain-v0', 3, 2, seed=2, autoreset='disabled')
        alone = [
            suite.make('PD_Dog2D_Slopes_Terrain-v0', {'random': int(seed)}) for seed in rows.seeds
        ]
        rows.reset()
        world, ids = rows._task.world, np.arange(3)
        for one in alone:
            one.reset()
        for push in range(1, 6):
            for row, one in enumerate(alone):
                x = push * (2.0 + row)
                height = rows._task.arena.strips[row].height(np.array([x]))[0] + 1.0
                world.qpos[row, :2] = x, height
                one.physics.data.qpos[:2] = x, height
                one.task.world.forward(np.zeros(1, int))
            world.forward(np.arange(3))
            action = np.zeros((3, 20))
            for _ in range(3):
                rows._task.step(action, ids)
                steps = [one.step(a) for one, a in zip(alone, action, strict=True)]
                for one, row in zip(steps, rows._task.observation, strict=True):
                    np.testing.assert_array_equal(
                        np.concatenate(list(one.observation.values())), row
                    )
                if any(one.last() for one in steps):
                    for one in alone:
                        one._reset_next_step = False
        self.assertGreater(float(world.qpos[:, 0].min()), 9.0)

    @parameterized.parameters(*AUTORESET)
    def test_terms_sum_to_the_reward(self, autoreset):
        rows = VectorEnvironment(FLAT, 3, 1, seed=3, autoreset=autoreset, step_limit=LIMIT)
        alone = [
            suite.make(FLAT, {'random': int(seed), 'step_limit': LIMIT}) for seed in rows.seeds
        ]

        def check(reward, info):
            total = sum(info['reward_terms'].values())
            np.testing.assert_allclose(total, reward, rtol=0, atol=1e-12)
            np.testing.assert_array_equal(total[reward == 0], 0)

        rows.reset()
        check(np.zeros(3), rows.info)
        for one in alone:
            one.reset()
        random, begun, ended = np.random.default_rng(0), np.zeros(3, bool), np.zeros(3, bool)
        reward = np.zeros(3)
        for _ in range(3 * LIMIT):
            if autoreset == 'disabled' and ended.any():
                rows.reset(ended)
                check(np.where(ended, 0, reward), rows.info)
            action = random.uniform(-1, 1, (3, len(rows.action_map)))
            step = rows.step(action)
            reward = step.reward
            check(reward, step.info)
            if autoreset == 'next_step':
                np.testing.assert_array_equal(step.reward[ended], 0)
                for row, one in enumerate(alone):
                    one.step(action[row])
                    for name, value in one.info['reward_terms'].items():
                        self.assertEqual(step.info['reward_terms'][name][row], value)
            ended = step.terminated | step.truncated
            begun |= ended
            if autoreset == 'same_step':
                check(np.where(ended, 0, reward), rows.info)
        self.assertTrue(begun.all())


class LimitTest(parameterized.TestCase):
    """Episodes are cut where those of a single environment are."""

    @parameterized.parameters(
        ({}, 256), ({'step_limit': None, 'time_limit': 8.99}, 270), ({'time_limit': 0.5}, 15),
        ({'time_limit': 0.1}, None), ({'time_limit': 0.7}, None), ({'time_limit': 1e-9}, 1),
        ({'time_limit': 0.5, 'step_limit': 7}, 7), ({'time_limit': 0.2, 'step_limit': 7}, None),
    )  # fmt: skip
    def test_same_step_as_a_single_environment(self, options, expected):
        rows = VectorEnvironment(FLAT, 2, 1, seed=0, task_kwargs=options)
        one = suite.make(FLAT, {'random': int(rows.seeds[0]), **options})
        for environment in rows, one:
            environment.task.finish_step = _never_failing(environment.task)
        rows.reset()
        one.reset()
        idle, ends = np.zeros((2, 6)), []
        for count in range(1, 2 * (expected or 30) + 3):
            step, time_step = rows.step(idle), one.step(idle[0])
            self.assertFalse(step.terminated.any())
            np.testing.assert_array_equal(step.truncated, time_step.last())
            if time_step.last():
                ends.append(count)
        self.assertGreaterEqual(len(ends), 2)
        self.assertEqual(ends[0], expected or ends[0])
        self.assertEqual(ends[1], 2 * ends[0] + 1)

    def test_rows_are_cut_each_in_its_time(self):
        options = {'time_limit': 0.3}
        rows = VectorEnvironment(
            FLAT, 3, 1, seed=0, autoreset='disabled', task_kwargs=options, step_limit=None
        )
        rows.reset()
        idle = np.zeros((3, 6))
        for _ in range(4):
            rows.step(idle)
        rows.reset([1])
        state = rows.get_state()
        other = VectorEnvironment(
            FLAT, 3, 1, seed=9, autoreset='disabled', task_kwargs=options, step_limit=None
        )
        other.set_state(state)
        for environments in rows, other:
            for _ in range(5):
                step = environments.step(idle)
            np.testing.assert_array_equal(step.truncated, [True, False, True])
            environments.reset([0, 2])
            for _ in range(4):
                step = environments.step(idle)
            np.testing.assert_array_equal(step.truncated, [False, True, False])

    @parameterized.parameters(
        ({'time_limit': 0}, 'time_limit is 0; expected a positive number of seconds'),
        ({'time_limit': float('nan')}, 'time_limit is nan'),
        ({'step_limit': 0}, 'step_limit is 0; expected a positive integer or None'),
        ({'step_limit': -1}, 'step_limit is -1'), ({'step_limit': 2.5}, 'step_limit is 2.5'),
        ({'random': 3}, "'random'.*`seed`"), ({'time_limt': 3}, 'time_limt'),
    )  # fmt: skip
    def test_refused(self, options, message):
        with self.assertRaisesRegex(ValueError, message):
            VectorEnvironment(FLAT, 2, 1, task_kwargs=options)


class AutoresetTest(parameterized.TestCase):
    """Gymnasium's three manners of beginning anew."""

    def run_to_the_end(self, autoreset):
        rows = VectorEnvironment(FLAT, 4, 1, seed=0, autoreset=autoreset, step_limit=3)
        rows.reset()
        for _ in range(3):
            step = rows.step(np.zeros((4, 6)))
        self.assertTrue(step.truncated.all())
        return rows, step

    def test_next_step_ignores_the_action(self):
        rows, _ = self.run_to_the_end('next_step')
        step = rows.step(np.ones((4, 6)))
        np.testing.assert_array_equal(step.reward, 0)
        self.assertFalse((step.terminated | step.truncated).any())
        again, _ = self.run_to_the_end('next_step')
        np.testing.assert_array_equal(again.step(-np.ones((4, 6))).observation, step.observation)

    def test_same_step_keeps_the_last_observation(self):
        rows, step = self.run_to_the_end('same_step')
        other, last = self.run_to_the_end('next_step')
        np.testing.assert_array_equal(step.info['final_observation'], last.observation)
        np.testing.assert_array_equal(step.info['ended'], True)
        np.testing.assert_array_equal(step.observation, other.step(np.zeros((4, 6))).observation)
        np.testing.assert_array_equal(step.reward, last.reward)
        self.assertFalse(rows.step(np.zeros((4, 6))).truncated.any())

    def test_disabled_asks_for_a_reset(self):
        rows, step = self.run_to_the_end('disabled')
        with self.assertRaisesRegex(RuntimeError, 'row 0 has ended'):
            rows.step(np.zeros((4, 6)))
        rows.reset(np.array([True] * 4))
        self.assertFalse(rows.step(np.zeros((4, 6))).truncated.any())
        self.assertEqual(step.reward.shape, (4,))

    @parameterized.parameters({'rows': [1, 3]}, {'rows': [False, True, False, True]})
    def test_a_reset_of_some_rows_leaves_the_others(self, rows):
        environments, untouched = (
            VectorEnvironment(FLAT, 4, 1, seed=4, autoreset='disabled') for _ in range(2)
        )
        before = environments.reset()
        np.testing.assert_array_equal(untouched.reset(), before)
        after = environments.reset(rows)
        np.testing.assert_array_equal(after[[0, 2]], before[[0, 2]])
        self.assertTrue((after[[1, 3]] != before[[1, 3]]).any(1).all())
        action = np.random.default_rng(0).uniform(-0.1, 0.1, (4, 6))
        for _ in range(5):
            a, b = environments.step(action), untouched.step(action)
            np.testing.assert_array_equal(a.observation[[0, 2]], b.observation[[0, 2]])

    def test_autoreset_names(self):
        self.assertEqual(AUTORESET, ('next_step', 'same_step', 'disabled'))


KINDS = tuple({row.rules: row.id for row in catalogue.ROWS}.values())  # one id of each task
ALONE = np.array([False, True, False])


class SomeRowsTest(parameterized.TestCase):
    """Stepping some rows, and going on where another environment is: what a search needs."""

    @parameterized.parameters(*KINDS)
    def test_rows_that_rest_stay_as_they_are(self, id_):
        """Row 1 rests every other step, and is no other for it than the row that never rests."""
        rows, other = (VectorEnvironment(id_, 3, 1, seed=4) for _ in range(2))
        random = np.random.default_rng(0)
        actions = random.uniform(-0.1, 0.1, (3, 3, len(rows.action_map)))
        for each in (rows, other):
            each.reset()
        for t, action in enumerate(actions):
            expected = other.step(action)
            before = rows.task.world.qpos[1].copy(), rows.task.world.qvel[1].copy()
            waiting = rows.step(np.ones_like(action), [0, 2] if t == 1 else [2])
            np.testing.assert_array_equal(rows.task.world.qpos[1], before[0])
            np.testing.assert_array_equal(rows.task.world.qvel[1], before[1])
            self.assertEqual(waiting.reward[1], 0)
            self.assertFalse(waiting.terminated[1] or waiting.truncated[1])
            step = rows.step(action, ALONE)
            np.testing.assert_array_equal(step.observation[1], expected.observation[1])
            self.assertEqual(step.reward[1], expected.reward[1])
            self.assertEqual(step.terminated[1], expected.terminated[1])

    def test_a_row_that_has_ended_rests_until_it_is_asked(self):
        rows = VectorEnvironment(GAPS, 3, 1, 0, step_limit=2)
        rows.reset()
        action = np.zeros((3, len(rows.action_map)))
        rows.step(action, [0, 1])
        step = rows.step(action, [0])
        np.testing.assert_array_equal(step.truncated, [True, False, False])
        for _ in range(2):
            step = rows.step(action, [2])
        np.testing.assert_array_equal(step.truncated, [False, False, True])
        step = rows.step(action)  # the first and the last begin anew, the other ends
        np.testing.assert_array_equal(step.truncated, [False, True, False])
        np.testing.assert_array_equal(step.reward > 0, [False, True, False])
        with self.assertRaisesRegex(ValueError, 'rows .3. of an environment of 3 rows'):
            rows.step(action, [3])

    @parameterized.parameters(*KINDS)
    def test_copies_go_on_where_the_other_is(self, id_):
        rows = VectorEnvironment(id_, 2, 1, seed=4)
        copies = VectorEnvironment(id_, 3, 1, seed=9)
        action = np.random.default_rng(0).uniform(-0.1, 0.1, (2, len(rows.action_map)))
        for each in (rows, copies):
            each.reset()
        rows.step(action)
        copies.copy_from(rows, [1, 0, 1], [0, 1, 2])
        expected, step = rows.step(action), copies.step(action[[1, 0, 1]])
        np.testing.assert_array_equal(step.observation, expected.observation[[1, 0, 1]])
        np.testing.assert_array_equal(step.reward, expected.reward[[1, 0, 1]])

    @parameterized.parameters(*KINDS)
    def test_single_rows_go_back(self, id_):
        rows, twin = (VectorEnvironment(id_, 3, 1, seed=4) for _ in range(2))
        action = np.random.default_rng(0).uniform(-0.1, 0.1, (3, len(rows.action_map)))
        for each in (rows, twin):
            each.reset()
            each.step(action)
        state = rows.get_state([2, 0])
        rows.step(action)
        rows.step(-action)
        rows.set_state(state, [2, 0])
        twin.step(action, [1])
        twin.step(-action, [1])
        for each in (action, -action):
            step, expected = rows.step(each), twin.step(each)
            np.testing.assert_array_equal(step.observation, expected.observation)
            np.testing.assert_array_equal(step.reward, expected.reward)
        np.testing.assert_array_equal(rows.reset(), twin.reset())

    def test_what_rows_cannot_go_back_to(self):
        rows = VectorEnvironment(GAPS, 3, 1, 0)
        state = rows.get_state([1])
        with self.assertRaisesRegex(RuntimeError, 'some rows before the first reset'):
            rows.set_state(state, [1])
        rows.reset()
        for numbers in ([0, 1], None, []):
            with self.assertRaisesRegex(ValueError, 'the state has 1 rows; expected'):
                rows.set_state(state, numbers)
        with self.assertRaisesRegex(ValueError, 'each of 2 rows once'):
            rows.set_state(rows.get_state([1, 2]), [1, 1])
        for call in (rows.get_state, lambda numbers: rows.set_state(state, numbers)):
            with self.assertRaisesRegex(ValueError, 'rows .3. of an environment of 3 rows'):
                call([3])

    def test_what_cannot_be_copied(self):
        rows, other = VectorEnvironment(GAPS, 2, 1, 0), VectorEnvironment(FLAT, 2, 1, 0)
        with self.assertRaisesRegex(RuntimeError, 'before the first reset'):
            rows.copy_from(rows, [0], [1])
        rows.reset()
        other.reset()
        with self.assertRaisesRegex(ValueError, f'rows of {FLAT} cannot go on in {GAPS}'):
            rows.copy_from(other, [0], [1])
        with self.assertRaisesRegex(ValueError, '2 rows to put into rows .1.'):
            rows.copy_from(rows, [0, 1], [1])
        with self.assertRaisesRegex(ValueError, 'rows .2. of an environment of 2 rows'):
            rows.copy_from(rows, [2], [1])


class RobustnessTest(parameterized.TestCase):
    """What goes wrong says so, and stays in its row."""

    def setUp(self):
        super().setUp()
        self.rows = VectorEnvironment(FLAT, 3, 1, seed=0)
        self.rows.reset()

    def test_divergence_stays_in_its_row(self):
        other = VectorEnvironment(FLAT, 3, 1, seed=0)
        other.reset()
        self.rows._task.world.qvel[1, 5] = 1e12
        action = np.zeros((3, 6))
        step, calm = self.rows.step(action), other.step(action)
        np.testing.assert_array_equal(step.info['diverged'], [False, True, False])
        np.testing.assert_array_equal(step.terminated, [False, True, False])
        self.assertEqual(step.reward[1], 0.0)
        self.assertTrue(np.isfinite(step.observation).all())
        np.testing.assert_array_equal(step.observation[[0, 2]], calm.observation[[0, 2]])
        for _ in range(5):
            step, calm = self.rows.step(action), other.step(action)
            np.testing.assert_array_equal(step.observation[[0, 2]], calm.observation[[0, 2]])
            self.assertTrue(np.isfinite(step.observation).all())

    @parameterized.parameters(
        (np.zeros((3, 5)), 'shape'),
        (np.zeros(6), 'shape'),
        (np.full((3, 6), 'a'), 'array of numbers'),
    )
    def test_wrong_actions(self, action, message):
        with self.assertRaisesRegex(ValueError, message):
            self.rows.step(action)

    @parameterized.parameters(np.nan, np.inf, -np.inf)
    def test_non_finite_actions_name_the_row(self, value):
        action = np.zeros((3, 6))
        action[2, 4] = value
        with self.assertRaisesRegex(ValueError, r'row 2, number 4 \(left_knee\)'):
            self.rows.step(action)

    def test_huge_finite_actions_are_clipped(self):
        self.assertTrue(np.isfinite(self.rows.step(np.full((3, 6), 1e200)).observation).all())

    @parameterized.parameters(
        ({'num_envs': 0}, 'num_envs'),
        ({'num_threads': -1}, 'num_threads'),
        ({'autoreset': 'next'}, "did you mean 'next_step'"),
        ({'dtype': np.int32}, 'float64 or float32'),
        ({'seed': [1, 2]}, '2 seeds for 3 rows'),
        ({'environment': 'PD_Biped2D_Gap_Terrain-v0'}, 'PD_Biped2D_Gaps_Terrain-v0'),
        ({'task_kwargs': {'sub_steps': 3}}, "did you mean 'substeps'"),
    )
    def test_wrong_arguments(self, arguments, message):
        with self.assertRaisesRegex(ValueError, message):
            VectorEnvironment(**{'environment': FLAT, 'num_envs': 3, 'num_threads': 1, **arguments})

    def test_closed(self):
        self.rows.close()
        self.rows.close()
        with self.assertRaisesRegex(RuntimeError, 'closed'):
            self.rows.step(np.zeros((3, 6)))

    def test_step_before_reset(self):
        with self.assertRaisesRegex(RuntimeError, 'before the first reset'):
            VectorEnvironment(FLAT, 2, 1).step(np.zeros((2, 6)))

    def test_a_live_batch_is_not_pickled(self):
        with self.assertRaisesRegex(TypeError, 'get_state'):
            pickle.dumps(self.rows)

    def test_saved_and_restored_elsewhere(self):
        random = np.random.default_rng(0)
        actions = random.uniform(-1, 1, (40, 3, 6))
        for action in actions[:15]:
            self.rows.step(action)
        state = pickle.loads(pickle.dumps(self.rows.get_state()))
        expected = [self.rows.step(action).observation for action in actions[15:]]
        other = VectorEnvironment(FLAT, 3, 2, seed=99)
        other.set_state(state)
        found = [other.step(action).observation for action in actions[15:]]
        np.testing.assert_array_equal(found, expected)

    def test_float32_and_blocks(self):
        rows = VectorEnvironment(GAPS, 2, 1, seed=0, dtype=np.float32, flat_observation=False)
        observation = rows.reset()
        self.assertEqual(list(observation), ['terrain', 'pose', 'velocity', 'phase'])
        self.assertEqual({value.dtype for value in observation.values()}, {np.dtype(np.float32)})
        self.assertEqual(observation['terrain'].shape, (2, 50))
        self.assertEqual(rows.step(np.zeros((2, 11))).reward.dtype, np.float32)

    def test_a_forked_child_is_refused_not_hung(self):
        rows = VectorEnvironment(FLAT, 2, 2, seed=0)
        rows.reset()
        context = multiprocessing.get_context('fork')
        answers = context.Queue()
        child = context.Process(target=_step_in_child, args=(rows, answers))
        child.start()
        self.assertIn('fork', answers.get(timeout=30))
        child.join(timeout=30)
        self.assertEqual(child.exitcode, 0)
        rows.step(np.zeros((2, 6)))

    def test_spawned_workers_go_on_where_the_parent_is(self):
        context = multiprocessing.get_context('spawn')
        spec = {'environment': FLAT, 'num_envs': 3, 'num_threads': 1, 'seed': 0}
        random = np.random.default_rng(0)
        actions = random.uniform(-1, 1, (25, 3, 6))  # falls and resets are among the steps
        for action in actions[:10]:
            self.rows.step(action)
        arguments = pickle.dumps((spec, self.rows.get_state(), actions[10:]))
        answers, workers = context.Queue(), []
        for _ in range(2):
            workers.append(context.Process(target=_go_on, args=(arguments, answers)))
            workers[-1].start()
        steps = [self.rows.step(action) for action in actions[10:]]
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
        self.assertIn('does not survive a fork', done.stdout)
        self.assertEndsWith(done.stdout, 'True\nchild 0\n')


FORKED = f"""
import os, signal, sys
import numpy as np
from trl_suite.vector import VectorEnvironment

make = lambda: VectorEnvironment({FLAT!r}, 2, 2, seed=0)
roll = lambda rows: [rows.reset(), rows.step(np.ones((2, 6))).observation]
rows, other = make(), make()
expected = roll(rows)
child = os.fork()
if child == 0:
    signal.alarm(30)
    try:
        rows.step(np.ones((2, 6)))
    except RuntimeError as error:
        print(error)
    other.close()
    rows = make()  # lets the inherited one go, which must not wait for its threads
    print(np.array_equal(roll(rows), expected), flush=True)
    LEAVE
status = os.waitpid(child, 0)[1]
rows.step(np.ones((2, 6)))  # unharmed
print('child', status)
"""


def _step_in_child(rows, answers):
    try:
        rows.step(np.zeros((2, 6)))
    except RuntimeError as error:
        answers.put(str(error))


def _never_failing(task):
    finish_step = task.finish_step

    def finish(*arguments):
        finish_step(*arguments)
        task.failed[:] = False

    return finish


def _go_on(arguments, answers):
    spec, state, actions = pickle.loads(arguments)
    rows = VectorEnvironment(**spec)
    first = rows.reset()
    rows.set_state(state)
    answers.put((first, [np.column_stack([*rows.step(action)[:4]]) for action in actions]))
