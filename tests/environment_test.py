"""Tests of trl_suite.environments.environment, over every environment of the catalogue."""

import contextlib
import gc
import io
import json
import pathlib
import pickle
import tempfile
import threading
import weakref
from unittest import mock

import dm_env
import golden
import numpy as np
import pytest
from absl.testing import absltest, parameterized
from dm_control import composer, mjcf
from dm_control.composer.observation import observable
from dm_control.suite.wrappers import action_noise, action_scale, mujoco_profiling, pixels
from dm_env import test_utils
from helpers import (
    KINDS,
    advance,
    assert_goes_on,
    assert_rows_are_singles,
    links_on_ground,
)

from trl_suite import characters, describe, motion, policies, rendering, suite, terrain
from trl_suite.arenas import PlanarArena
from trl_suite.environments.environment import Environment
from trl_suite.tasks.imitation.task import PlanarImitation
from trl_suite.vector import VectorEnvironment

# Links and joints of each figure; muscles where it has any.
FIGURES = {'Biped2D': (12, 11, None), 'Dog2D': (21, 20, 44), 'Raptor2D': (19, 18, 40)}
SMALL_BIPED = (7, 6, 16)  # of the Imitation family
GAIT_LINKS = {'Dog2D': 21, 'Goat2D': 21, 'Raptor2D': 19, 'Biped2D': 7, 'Hopper2D': 3}
# Sizes in the original's papers and programs.
SIZES = {
    'PD_Biped2D_Gaps_Terrain-v0': (104, 11), 'PD_Dog2D_Steps_Terrain-v0': (140, 20),
    'PD_Raptor2D_Walls_Terrain-v0': (132, 18), 'PD_Biped2D_Flat-v0': (54, 11),
    'PD_Biped2D_Incline-v0': (54, 11), 'PD_Dog2D_Flat-v0': (90, 20), 'PD_Raptor2D_Flat-v0': (82, 18),
    'PD_Biped2D_LLC_Imitate_Flat-v0': (58, 6), 'Torque_Biped2D_LLC_Imitate_Flat-v0': (58, 6),
    'MTU_Biped2D_LLC_Imitate_Flat-v0': (74, 16), 'PD_Dog2D_LLC_Imitate_Flat-v0': (170, 20),
    'Torque_Dog2D_LLC_Imitate_Flat-v0': (170, 20), 'MTU_Dog2D_LLC_Imitate_Flat-v0': (214, 44),
    'PD_Raptor2D_LLC_Imitate_Flat-v0': (154, 18), 'Torque_Raptor2D_LLC_Imitate_Flat-v0': (154, 18),
    'MTU_Raptor2D_LLC_Imitate_Flat-v0': (194, 40), 'Vel_Dog2D_LLC_Imitate_Flat-v0': (170, 20),
    'FSM_Dog2D_Terrain_Gaps-v0': (283, 29), 'FSM_Goat2D_Terrain_Cliffs-v0': (283, 29),
    'FSM_Raptor2D_Terrain_Steps-v0': (275, 28), 'FSM_Biped2D_Terrain_Walls-v0': (227, 28),
    'FSM_Hopper2D_Terrain_Slopes-v0': (211, 9),
    # Three numbers for the rotation of a ball joint; the original has angle and axis, four.
    'PD_Biped3D_Imitate-v0': (112, 17), 'PD_Biped3D_Imitate-Stairs-v0': (112, 17),
    'PD_Biped3D_Imitate-Track-v0': (156, 17), 'PD_Biped3D_Imitate-Hills_Terrain-v0': (1136, 17),
    'PD_Biped3D_Imitate-Run-v0': (112, 17),
    'PD_Biped2D_LLC_Flat_Step-v0': (69, 11),
    'PD_Biped3D_LLC_General_Step-v0': (125, 17), 'PD_Biped3D_LLC_Symetric_Step-v0': (117, 17),
    'PD_Biped3D_LLC_Run_FootStep-v0': (125, 17), 'PD_Biped3D_FULL_Imitate-Steps-v0': (229, 35),
    'PD_Biped3D_HLC_LargeBlocks-v0': (1131, 5), 'PD_Biped3D_HLC_Forest-v0': (1131, 5),
    'PD_Biped3D_HLC_PathFollowing-v0': (1131, 5), 'PD_Biped3D_HLC_DynamicsObstacles-v0': (2155, 5),
    'PD_Biped3D_HLC_Conveyors-v0': (2155, 5), 'PD_Biped3D_HLC_Conveyors_Wide-v0': (2155, 5),
    'PD_Biped3D_HLC_Soccer-v0': (116, 5),
}  # fmt: skip
GAPS = 'PD_Biped2D_Gaps_Terrain-v0'
EXAMPLES = (
    GAPS, 'PD_Dog2D_Slopes_Mixed_Terrain-v0', 'MTU_Raptor2D_LLC_Imitate_Flat-v0',
    'Torque_Biped2D_LLC_Imitate_Flat-v0', 'Vel_Dog2D_LLC_Imitate_Flat-v0',
    'FSM_Raptor2D_Terrain_Slopes-v0', 'PD_Biped3D_Imitate-Hills-v0',
    'PD_Biped3D_LLC_General_Step-v0', 'PD_Biped3D_HLC_LargeBlocks-v0',
)  # fmt: skip


def is_gait(id_):
    """Whether a step lasts a whole cycle, some 300 control steps."""
    return suite.find(id_).task_type == 'gait'


def is_high(id_):
    """Whether a step lasts a whole footstep, up to 15 control steps."""
    return suite.find(id_).task_type in ('goal_navigation', 'soccer')


# Numbers of the first steps, for seeds with which they do not depend on the last bits of anything,
# so that they hold on other processors.
ROOT = pathlib.Path(__file__).parents[1]
STORED = json.loads((ROOT / 'tests/golden.json').read_text())

# Steps of 1/30 s.
ONE_BY_ONE = [id_ for id_ in suite.ALL_IDS if not is_gait(id_) and not is_high(id_)]

FALLING = {*ONE_BY_ONE[::3], *filter(is_high, suite.ALL_IDS)}  # whose falls are looked at


def expected_blocks(id_):
    """Blocks and their sizes by the rules: terrain, pose 2n + 1, velocity 2n, extras.

    In three dimensions pose 7n + 1, velocity 6n.
    """
    figure = id_.split('_')[1]
    if is_high(id_):
        ground = id_.split('_', 3)[3].removesuffix('-v0')
        sizes = (
            {'terrain': 1024}
            if ground in ('LargeBlocks', 'Forest', 'PathFollowing', 'PathFollowing_Run')
            else {}
        )
        if ground in ('DynamicsObstacles', 'Conveyors', 'Conveyors_Wide'):
            sizes = {'surface': 2048}
        ball = {'ball': 9} if ground == 'Soccer' else {}
        return sizes | {'pose': 57, 'velocity': 48, 'goal': 2} | ball
    if figure == 'Biped3D':
        links = 16 if 'FULL' in id_ else 8
        sizes = {'terrain': 1024} if '_Terrain-' in id_ else {}
        sizes |= {'pose': 7 * links + 1, 'velocity': 6 * links}
        if '_Hard' in id_:
            return (
                sizes | {'phase': 5, 'goal': 2, 'ball': 9}
                if 'Soccer' in id_
                else {'terrain': 1024} | sizes | {'phase': 5, 'goal': 2}
            )
        if '_Imitate' in id_ and 'FULL' not in id_:
            track = 'Track' in id_
            return sizes | ({'reference': 6 * links + 1} if track else {'phase': 5}) | {'goal': 2}
        mirrored = 'Symetric' in id_
        return sizes | {'phase': 3 if mirrored else 5, 'contact': 2, 'plan': 7 if mirrored else 13}
    if suite.find(id_).task_type == 'planar_footsteps':
        return {'pose': 25, 'velocity': 24, 'phase': 5, 'contact': 2, 'plan': 13}
    if is_gait(id_):
        links = GAIT_LINKS[figure]
        return {'terrain': 200, 'pose': 2 * links - 1, 'velocity': 2 * links}
    links, _, units = SMALL_BIPED if 'LLC' in id_ and figure == 'Biped2D' else FIGURES[figure]
    sizes = {'terrain': 50} if '_Terrain-' in id_ else {}
    sizes |= {'pose': 2 * links + 1, 'velocity': 2 * links}
    if id_.startswith('MTU'):
        sizes['strain'] = units
    return sizes | ({'reference': 4 * links + 1} if 'LLC' in id_ else {'phase': 5})


def random_actions(environment, steps, seed=0):
    spec = environment.action_spec()
    # Many cycles of random gaits last until truncation, which takes long.
    scale = 0.3 if hasattr(environment.task, 'gait') else 1.0
    return scale * np.random.default_rng(seed).uniform(
        spec.minimum, spec.maximum, (steps, *spec.shape)
    )


def rollout(environment, actions):
    """Flat arrays of what an environment returns: observations, rewards, discounts, types."""
    steps = [environment.reset(), *(environment.step(action) for action in actions)]
    observations = [np.concatenate([np.ravel(v) for v in s.observation.values()]) for s in steps]
    return (
        np.array(observations),
        np.array([np.nan if s.reward is None else s.reward for s in steps]),
        np.array([np.nan if s.discount is None else s.discount for s in steps]),
        [s.step_type for s in steps],
    )


def every_environment(id_):
    """Tests of one environment that apply to all, including those of dm_env.

    It is built once for all tests, as building takes most of the time; seeding restores the state
    of a new one.
    """
    gait, high = is_gait(id_), is_high(id_)

    class EveryEnvironment(test_utils.EnvironmentTestMixin, absltest.TestCase):
        @classmethod
        def setUpClass(cls):
            super().setUpClass()
            cls.kept = {}

        @classmethod
        def tearDownClass(cls):
            super().tearDownClass()
            cls.let_go()

        @classmethod
        def let_go(cls):
            while cls.kept:
                cls.kept.popitem()[1].close()

        def made(self, seed, flat=False, step_limit=256):
            """The environment, newly seeded, before its first reset."""
            if flat not in self.kept:
                self.kept[flat] = suite.make(id_, {'random': seed}, {'flat_observation': flat})
            environment = self.kept[flat]
            environment.random_state.seed(seed)
            environment.step_limit = step_limit
            return environment

        # Renamed so that it runs first: then the environment is fresh.
        test_a_step_on_fresh_environment = (
            test_utils.EnvironmentTestMixin.test_step_on_fresh_environment
        )
        test_step_on_fresh_environment = None

        def make_object_under_test(self):
            if self._testMethodName == 'test_a_step_on_fresh_environment':
                self.let_go()
            return self.made(0, step_limit=2 if gait or high else 12)  # so that episodes end

        def tearDown(self):
            absltest.TestCase.tearDown(self)  # the mixin's closes the environment

        def make_action(self):
            # dm_env uses the minimum: with such an action, a cycle of a gait lasts until truncation.
            return np.zeros(self.environment.action_spec().shape) if gait else super().make_action()

        def make_action_sequence(self):
            return random_actions(self.environment, 3 if gait or high else 30)

        def test_action_spec_is_minus_1_to_1(self):
            spec = self.environment.action_spec()
            self.assertEqual(len(spec.name.split('\t')), spec.shape[0])
            self.assertEqual((spec.minimum.shape, spec.maximum.shape), (spec.shape,) * 2)
            self.assertTrue((spec.minimum == -1).all() and (spec.maximum == 1).all())

        def test_observation_blocks_have_the_expected_sizes(self):
            environment, blocks = self.environment, expected_blocks(id_)
            spec = environment.observation_spec()
            self.assertEqual(list(spec), list(blocks))  # terrain first
            self.assertEqual({name: each.shape[0] for name, each in spec.items()}, blocks)
            stop = 0
            for name, part in environment.blocks.items():
                self.assertEqual(part, slice(stop, stop + blocks[name]))
                stop = part.stop
            for each in spec.values():
                self.assertEqual(each.dtype, np.float64)

        if id_ in SIZES:

            def test_sizes_are_those_of_the_original(self):
                environment, (observation, action) = self.made(0, flat=True), SIZES[id_]
                spec = environment.observation_spec()
                self.assertEqual(spec['observations'].shape, (observation,))
                self.assertEqual(environment.action_spec().shape, (action,))

        def test_random_rollout_is_finite_with_rewards_in_0_to_1(self):
            # A walker with random plans may not fall: its episode is truncated.
            self.wander(*((6, 4) if gait else (16, 12) if high else (200, 256)))

        @pytest.mark.slow
        def test_long_random_rollout_is_finite_with_rewards_in_0_to_1(self):
            self.wander(300 if gait or high else 5000, 256)

        def wander(self, steps, step_limit):
            environment = self.made(1, step_limit=step_limit)
            observations, rewards, discounts, types = rollout(
                environment, random_actions(environment, steps)
            )
            self.assertTrue(np.isfinite(observations).all())
            self.assertLess(np.abs(observations).max(), 1e4)
            first = np.array([each is dm_env.StepType.FIRST for each in types])
            self.assertTrue(np.isfinite(rewards[~first]).all())
            self.assertTrue(((rewards[~first] >= 0) & (rewards[~first] <= 1)).all())
            self.assertTrue(np.isin(discounts[~first], (0, 1)).all())
            last = np.array([each is dm_env.StepType.LAST for each in types])
            self.assertTrue(
                last.any()
            )  # random actions lead to a fall, or the episode is truncated
            np.testing.assert_array_equal(rewards[discounts == 0], 0)
            np.testing.assert_array_equal(last[discounts == 0], True)

        if id_ in FALLING:

            def test_a_fall_is_a_failure(self):
                environment = self.made(5)
                environment.reset()
                for action in random_actions(environment, 250, seed=1):
                    step = environment.step(action)
                    if step.last():
                        break
                self.assertTrue(step.last())
                self.assertEqual((step.discount, step.reward), (0.0, 0.0))
                self.assertTrue(environment.info['fell'])
                self.assertFalse(environment.info['diverged'])
                self.assertEqual(set(environment.info['reward_terms'].values()), {0.0})
                fall_links = environment.task.character.spec.fall_links
                self.assertNotEmpty(links_on_ground(environment) & set(fall_links))
                step = environment.step(action)
                self.assertTrue(step.first())
                self.assertFalse(environment.info['fell'])

        def test_flat_observation_is_the_concatenated_blocks(self):
            blocks, flat = self.made(2), self.made(2, flat=True)
            actions = random_actions(blocks, 1 if gait else 3 if high else 20)
            for ours, theirs in zip(rollout(blocks, actions), rollout(flat, actions), strict=True):
                np.testing.assert_array_equal(ours, theirs)

        def test_simulations_of_a_vector_environment_equal_single_ones(self):
            # gait_test and high_level_test look closer.
            limit, steps = (1, 4) if gait else (3, 8) if high else (12, 30)
            scale, one = 0.3 if gait else 1.0, self.made(0, flat=True, step_limit=limit)
            _, ends = assert_rows_are_singles(id_, 3, steps, limit, scale=scale, seed=5, one=one)
            self.assertGreaterEqual(ends, 6)

        def test_first_steps_equal_the_stored_ones(self):
            stored = dict(STORED[id_])
            made = None if high else self.made(0)  # planners of the record have another controller
            found = golden.summary(id_, stored.pop('seed'), environment=made)
            self.assertCountEqual(found, stored)
            for name, expected in stored.items():
                tolerance = golden.TOLERANCE
                np.testing.assert_allclose(
                    found[name][: len(expected)], expected, tolerance, tolerance, err_msg=name
                )

        def test_the_description_is_complete(self):
            sections = describe.sections(suite.find(id_), self.environment)
            found = ''.join(f'\n{title}\n{text}' for title, text in sections)
            self.assertNotRegex(found, r'\bnan\b|\binf\b|None|<')
            for title in ('Character', 'Links', 'Observation', 'Action', 'Terrain', 'Reward',
                          'Termination', 'Time', 'Differences'):  # fmt: skip
                self.assertIn(f'\n{title}', found)
            rules = suite.find(id_).task_type
            steps = rules == 'spatial_footsteps'
            for title, shown in (
                ('Clip:', not gait and not steps and not high), ('Gait:', gait),
                ('Parameters:', gait), ('Steps:', steps), ('Footstep controller\n', high),
                ('Plans:', steps or rules == 'planar_footsteps'),
            ):  # fmt: skip
                self.assertEqual(f'\n{title}' in found, shown, title)
            self.assertEqual('reward weight' in found, not gait and not high)

        if id_ in policies.available():

            def test_the_shipped_policy_fits(self):
                environment, policy = self.made(0), policies.reference(id_)
                policy.check(environment)
                action = policy(environment.reset().observation)
                self.assertEqual(action.shape, environment.action_spec().shape)
                self.assertTrue(np.isfinite(action).all())

        if id_ in KINDS:  # with other options: in the test of each task

            def test_a_restored_state_continues_exactly(self):
                steps = 1 if gait else 2 if high else 5

                def go(environment, seed):
                    return advance(environment, seed, steps, 0.3)

                environment, other = self.made(6), suite.make(id_, {'random': 9})
                for each in (environment, other):
                    each.reset()
                    go(each, 0)
                assert_goes_on(environment, other, go)

        # Gaits and planners step their physics in the task: see gait_test, and below.
        if not gait and not high and id_ in KINDS:

            def test_plain_composer_environment_agrees(self):
                ours = self.made(3)
                theirs = composer.Environment(
                    suite.build_task(suite.find(id_)), random_state=3,
                    strip_singleton_obs_buffer_dim=True,
                )  # fmt: skip
                np.testing.assert_array_equal(theirs.action_spec().minimum, -1)
                np.testing.assert_array_equal(theirs.action_spec().maximum, 1)
                actions = random_actions(ours, 40)
                for mine, composers in zip(
                    rollout(ours, actions), rollout(theirs, actions), strict=True
                ):
                    np.testing.assert_array_equal(mine, composers)

        if high:

            def test_plain_composer_environment_is_rejected(self):
                idle = {'idle': (0.1, lambda task: np.zeros(task.world.n))}
                for options in ({}, {'interface': 'frame'}, {'rewards': idle}):
                    task = suite.build_task(suite.find(id_), options)
                    environment = composer.Environment(task, random_state=3)
                    environment.reset()
                    with (
                        self.subTest(str(options)),
                        self.assertRaisesRegex(
                            RuntimeError,
                            'trl_suite.environments.environment.Environment, not.*composer',
                        ),
                    ):
                        environment.step(np.zeros(len(task.action_map)))

    EveryEnvironment.__name__ = EveryEnvironment.__qualname__ = f'EveryEnvironment_{id_}'.replace(
        '-', '_'
    )
    return EveryEnvironment


class PlainComposerTest(parameterized.TestCase):
    """A plain composer.Environment does not check actions; tasks do."""

    @parameterized.product(
        id_=('PD_Biped2D_Flat_Terrain-v0', 'FSM_Hopper2D_Terrain_Gaps-v0', 'PD_Biped3D_HLC_Soccer-v0'),
        size=(0, 1, 10**6),
    )  # fmt: skip
    def test_actions_of_other_shapes_are_rejected(self, id_, size):
        environment = composer.Environment(suite.build_task(suite.find(id_)), random_state=0)
        environment.reset()
        with self.assertRaisesRegex(ValueError, rf'action has shape \({size},\); expected'):
            environment.step(np.zeros(size))


class GoldenTest(absltest.TestCase):
    def test_all_environments_are_stored(self):
        self.assertCountEqual(STORED, suite.ALL_IDS)

    def test_a_check_tells_what_differs(self):
        id_ = 'PD_Dog2D_Flat-v0'
        path = pathlib.Path(self.enterContext(tempfile.TemporaryDirectory()), 'stored.json')
        for reward, differs in ((0.0, ''), (0.5, f'{id_}\n    reward: by 5.0e-01 in step 0\n')):
            stored = {**STORED[id_], 'reward': [reward, *STORED[id_]['reward'][1:]]}
            path.write_text(json.dumps({id_: stored}))
            with contextlib.redirect_stdout(io.StringIO()) as printed:
                self.assertEqual(golden.check(path, ''), not differs)
            self.assertIn(f'MuJoCo lacks: nothing\n{differs}', printed.getvalue())


for _id in suite.ALL_IDS:
    _class = every_environment(_id)
    globals()[_class.__name__] = _class
del _class  # else it would be collected twice


class ActionTest(parameterized.TestCase):
    """Bad actions are refused with a sentence; far ones are clipped."""

    @parameterized.parameters(
        (np.nan, 'action\\[2\\] \\(right_ankle\\) is nan'),
        (np.inf, 'action\\[2\\] \\(right_ankle\\) is inf'),
        (-np.inf, 'action\\[2\\] \\(right_ankle\\) is -inf'),
    )
    def test_actions_that_are_not_finite_are_rejected(self, value, message):
        environment = suite.make(GAPS, {'random': 0})
        environment.reset()
        action = np.zeros(11)
        action[2] = value
        before = environment.physics.data.time
        with self.assertRaisesRegex(ValueError, message):
            environment.step(action)
        self.assertEqual(environment.physics.data.time, before)
        self.assertTrue(environment.step(np.zeros(11)).mid())

    @parameterized.parameters(((),), ((1, 11),), ((10,),), ((12,),))
    def test_actions_of_wrong_shape_are_rejected(self, shape):
        environment = suite.make(GAPS, {'random': 0})
        environment.reset()
        with self.assertRaisesRegex(ValueError, r'shape .*; expected \(11,\)'):
            environment.step(np.zeros(shape))

    def test_actions_that_are_not_numbers_are_rejected(self):
        environment = suite.make(GAPS, {'random': 0})
        environment.reset()
        with self.assertRaisesRegex(ValueError, 'not an array of numbers'):
            environment.step(['left'] * 11)
        with self.assertRaisesRegex(ValueError, 'not an array of numbers'):
            environment.step([10**400] * 11)

    @parameterized.parameters(*EXAMPLES)
    def test_far_actions_are_clipped(self, id_):
        environment, poses = suite.make(id_), []
        for size in (1.0, 5.0, 1e200):
            environment.random_state.seed(4)
            environment.reset()
            action = size * np.sign(random_actions(environment, 1)[0])
            poses.append(environment.step(action).observation['pose'])
        np.testing.assert_array_equal(poses[0], poses[1])
        np.testing.assert_array_equal(poses[0], poses[2])

    def test_the_given_action_is_not_changed(self):
        environment = suite.make(GAPS, {'random': 0})
        environment.reset()
        action = np.full(11, 2.0)
        environment.step(action)
        np.testing.assert_array_equal(action, 2.0)
        environment.step(list(action))

    def test_control_is_thirty_hertz(self):
        for substeps in (4, 10, 20):
            environment = suite.make(GAPS, {'random': 0, 'substeps': substeps})
            environment.reset()
            self.assertAlmostEqual(environment.control_timestep(), 1 / 30)
            self.assertAlmostEqual(environment.physics.timestep(), 1 / (30 * substeps))
            for _ in range(3):
                environment.step(np.zeros(11))
            self.assertAlmostEqual(environment.physics.data.time, 0.1, delta=1e-9)


def held(**options):
    """A biped held in the air so that it never falls."""
    environment = suite.make('PD_Biped2D_LLC_Imitate_Flat-v0', {'random': 0, **options})
    environment.reset()
    return environment


def lift(environment):
    data = environment.physics.named.data
    data.qpos['biped2d/root_z/'] = 5.0
    data.qvel['biped2d/root_z/'] = 0.0
    data.qpos['biped2d/root_pitch/'] = 0.0
    environment.physics.forward()


class EpisodeTest(parameterized.TestCase):
    """How episodes end and begin."""

    def length(self, environment):
        for i in range(1, 1000):
            lift(environment)
            step = environment.step(np.zeros(6))
            if step.last():
                return i, step
        return None

    @parameterized.parameters(*suite.ALL_IDS)
    def test_the_default_step_limit(self, id_):
        """256 steps; gaits 5000 cycles, so that kilometres can be measured; plans for 200 s."""
        limit = 256
        if id_.startswith('FSM_'):
            limit = 5000
        elif is_high(id_):  # plans of half a second, of a run 0.3 s
            limit = 667 if id_.endswith('PathFollowing_Run-v0') else 400
        self.assertEqual(suite.find(id_).step_limit, limit)

    def test_the_environment_has_the_limit_of_its_id(self):
        self.assertEqual(suite.make(GAPS).step_limit, 256)

    @parameterized.parameters(
        ({}, 256), ({'step_limit': 7}, 7), ({'time_limit': 0.1}, 3), ({'time_limit': 0.5}, 15),
        ({'time_limit': 1}, 30), ({'time_limit': 4.0}, 120), ({'time_limit': 0.11}, 4),
    )  # fmt: skip
    def test_truncation_is_not_a_failure(self, options, steps):
        environment = held(**options)
        count, step = self.length(environment)
        self.assertEqual(count, steps)
        self.assertEqual(step.discount, 1.0)
        self.assertGreater(step.reward, 0)
        self.assertFalse(environment.info['fell'])
        self.assertTrue(environment.step(np.zeros(6)).first())
        self.assertEqual(self.length(environment)[0], steps)

    def test_no_limit(self):
        environment = held(step_limit=None)
        for _ in range(300):
            lift(environment)
            self.assertTrue(environment.step(np.zeros(6)).mid())

    def test_contact_of_other_links_is_not_a_fall(self):
        environment = held()
        with environment.physics.reset_context():
            qpos = environment.physics.named.data.qpos
            qpos['biped2d/root_z/'] = 0.6  # sitting on its shanks, the trunk up
            for side in ('left', 'right'):
                qpos[f'biped2d/{side}_hip'] = 1.2
                qpos[f'biped2d/{side}_knee'] = -2.4
        environment.physics.data.qvel[:] = 0
        touched = False
        for _ in range(30):
            step = environment.step(np.zeros(6))
            data, model = environment.physics.data.ptr, environment.physics.model.ptr
            links = {model.body(b).name for b in model.geom_bodyid[data.contact.geom].ravel()}
            if 'biped2d/root' in links:
                break
            touched |= bool(links & {'biped2d/left_ankle', 'biped2d/left_knee'})
            self.assertTrue(step.mid())
        self.assertTrue(touched)

    def test_terms_sum_to_the_reward(self):
        environment = suite.make(GAPS, {'random': 0, 'step_limit': 5})
        for end in 1, 2:  # of an episode: the reset after it is a step's
            begin = environment.reset() if end == 1 else environment.step(np.zeros(11))
            self.assertTrue(begin.first())
            terms = environment.info['reward_terms']
            self.assertCountEqual(terms, ('pose', 'velocity', 'end_effector', 'com', 'root'))
            self.assertEqual(set(terms.values()), {0.0})
            step = begin
            while not step.last():
                step = environment.step(np.zeros(11))
                terms = environment.info['reward_terms']
                self.assertAlmostEqual(sum(terms.values()), step.reward, delta=1e-12)
                self.assertGreater(step.reward, 0)

    def test_distance(self):
        environment = held()
        for _ in range(5):
            environment.step(np.zeros(6))
        x = environment.physics.named.data.qpos['biped2d/root_x/'][0]
        self.assertEqual(environment.info['distance'], x)
        self.assertNotEqual(x, 0)


class DivergenceTest(parameterized.TestCase):
    """Physics that breaks down ends the episode and nothing else."""

    @parameterized.parameters(*EXAMPLES)
    def test_a_huge_velocity_is_divergence(self, id_):
        environment = suite.make(id_, {'random': 6})
        environment.reset()
        actions = random_actions(environment, 4)
        kept = environment.step(actions[0]).observation
        environment.physics.data.qvel[:] = 1e12
        step = environment.step(actions[1])
        self.assertTrue(step.last())
        self.assertEqual((step.reward, step.discount), (0.0, 0.0))
        self.assertTrue(environment.info['diverged'])
        self.assertFalse(environment.info['fell'])
        for name, value in step.observation.items():  # the last that was sound
            np.testing.assert_array_equal(value, kept[name])
        self.recovers(environment, actions)

    @parameterized.parameters(*EXAMPLES)
    def test_a_position_outside_the_world_is_divergence(self, id_):
        environment = suite.make(id_, {'random': 6})
        environment.reset()
        actions = random_actions(environment, 4)
        environment.physics.data.qpos[:2] = 2e18
        environment.physics.forward()
        step = environment.step(actions[0])
        self.assertEqual((step.reward, step.discount), (0.0, 0.0))
        self.assertTrue(environment.info['diverged'])
        for value in step.observation.values():
            self.assertTrue(np.isfinite(value).all())
        self.recovers(environment, actions)

    def test_nan_is_divergence(self):
        environment = suite.make(GAPS, {'random': 6})
        environment.reset()
        actions = random_actions(environment, 4)
        environment.step(actions[0])
        environment.physics.data.qpos[3] = np.nan
        step = environment.step(actions[1])
        self.assertTrue(step.last())
        self.assertEqual((step.reward, step.discount), (0.0, 0.0))
        self.assertTrue(environment.info['diverged'])
        for value in step.observation.values():
            self.assertTrue(np.isfinite(value).all())
        self.recovers(environment, actions)

    def test_a_joint_that_spins_too_fast_is_divergence(self):
        environment = suite.make('Torque_Dog2D_LLC_Imitate_Flat-v0', {'random': 6})
        environment.reset()
        environment.physics.model.dof_damping[:] = 0
        environment.physics.named.data.qvel['dog/tail3'] = 500.0
        environment.physics.forward()
        step = environment.step(np.zeros(20))
        self.assertGreater(np.abs(environment.physics.data.qvel).max(), 200)
        self.assertTrue(step.last())
        self.assertEqual((step.reward, step.discount), (0.0, 0.0))
        self.assertTrue(environment.info['diverged'])

    def recovers(self, environment, actions):
        step = environment.step(actions[2])
        self.assertTrue(step.first())
        self.assertFalse(environment.info['diverged'])
        self.assertTrue(np.isfinite(environment.physics.data.qpos).all())
        step = environment.step(actions[3])
        self.assertGreater(step.reward, 0.2)
        self.assertEqual(step.discount, 1.0)


class ObservableTest(parameterized.TestCase):
    """A user's own observables in addition to the blocks."""

    def build(self, **options):
        spec = suite.find('PD_Dog2D_Gaps_Terrain-v0')
        task = suite.build_task(spec)
        character = task.character
        for name, each in (
            ('joints_pos', observable.MJCFFeature('qpos', character.joints)),
            (
                'bodies_pos',
                observable.Generic(lambda physics: physics.bind(character.bodies).xipos),
            ),
            ('root_pos', observable.MJCFFeature('xpos', character.root_body)),
        ):
            character.observables.add_observable(name, each)
        return Environment(task, random=7, **options)

    def test_observables_are_current(self):
        environment = self.build()
        spec = environment.observation_spec()
        self.assertEqual(list(spec)[:4], ['terrain', 'pose', 'velocity', 'phase'])
        self.assertEqual(spec['dog/joints_pos'].shape, (20,))
        self.assertEqual(spec['dog/bodies_pos'].shape, (21, 3))
        names = [f'dog/{name}' for name in characters.CHARACTERS['dog'].joints]
        step = environment.reset()
        for action in random_actions(environment, 60):
            qpos = environment.physics.named.data.qpos
            found = np.array([qpos[name][0] for name in names])
            np.testing.assert_array_equal(step.observation['dog/joints_pos'], found)
            root = environment.physics.named.data.xpos['dog/root']
            np.testing.assert_array_equal(step.observation['dog/root_pos'], root)
            for name, each in spec.items():
                each.validate(step.observation[name])
            step = environment.step(action)

    def test_blocks_and_rewards_stay_the_same(self):
        mine = self.build()
        plain = suite.make('PD_Dog2D_Gaps_Terrain-v0', {'random': 7, 'step_limit': None})
        actions = random_actions(plain, 40)
        ours, theirs = rollout(mine, actions), rollout(plain, actions)
        np.testing.assert_array_equal(ours[0][:, : theirs[0].shape[1]], theirs[0])
        np.testing.assert_array_equal(ours[1], theirs[1])

    def test_flat_observation(self):
        environment = self.build(flat_observation=True)
        observation = environment.reset().observation
        self.assertEqual(list(observation), ['observations'])
        self.assertEqual(observation['observations'].shape, (140 + 20 + 63 + 3,))

    def test_returned_observations_are_not_overwritten(self):
        environment = suite.make(GAPS, {'random': 0})
        first = environment.reset().observation
        copies = {name: value.copy() for name, value in first.items()}
        for action in random_actions(environment, 5):
            environment.step(action)
        for name, value in first.items():
            np.testing.assert_array_equal(value, copies[name])
            value[:] = 77.0  # must not reach into the environment
        self.assertTrue((np.abs(environment.step(np.zeros(11)).observation['pose']) < 50).all())


class HookTest(parameterized.TestCase):
    """Substeps run in C: hooks between them are refused, not forgotten."""

    def task(self, cls=PlanarImitation):
        return cls(
            characters.make('biped2d'), PlanarArena(terrain.load('flat')),
            motion.load('biped2d_walk'),
        )  # fmt: skip

    @parameterized.parameters('before_substep', 'after_substep')
    def test_invalid_arguments_are_rejected(self, hook):
        hooked = type('Hooked', (PlanarImitation,), {hook: lambda self, *_: None})
        with self.assertRaisesRegex(ValueError, f'{hook} hook.*composer.Environment'):
            Environment(self.task(hooked))
        environment = Environment(self.task())
        with self.assertRaisesRegex(ValueError, f'{hook} hook'):
            environment.add_extra_hook(hook, lambda *_: None)

    def test_other_hooks_run(self):
        environment, calls = Environment(self.task(), random=0), []
        environment.add_extra_hook('after_step', lambda *_: calls.append('after_step'))
        environment.add_extra_hook('initialize_episode', lambda *_: calls.append('reset'))
        environment.reset()
        environment.step(np.zeros(6))
        self.assertEqual(calls, ['reset', 'after_step'])

    def test_an_entity_with_substep_hooks_is_rejected(self):
        class Prop(composer.Entity):
            def _build(self):
                self._root = mjcf.RootElement('prop')

            @property
            def mjcf_model(self):
                return self._root

            def after_substep(self, physics, random_state):
                physics.step()

        task = self.task()
        task.arena.attach(Prop())
        with self.assertRaisesRegex(ValueError, 'after_substep hook'):
            Environment(task)


class ConstructionTest(parameterized.TestCase):
    """Options of an environment."""

    @parameterized.parameters(
        ({'step_limit': 0}, 'step_limit is 0'), ({'step_limit': 2.5}, 'step_limit is 2.5'),
        ({'time_limit': 0}, 'time_limit is 0'), ({'time_limit': np.nan}, 'time_limit is nan'),
        ({'random': -1}, 'random is -1'), ({'random': 2**32}, 'random is 4294967296'),
        *(({'step_limit': value}, 'step_limit is .*; expected None or a whole number at least 1')
          for value in (np.inf, np.nan, 'abc', True, [2], np.arange(2), -1)),
        *(({'time_limit': value}, 'time_limit is .*; expected a positive number of seconds')
          for value in (None, 'abc', True, [2], np.arange(2), -1)),
    )  # fmt: skip
    def test_invalid_arguments_are_rejected(self, options, message):
        with self.assertRaisesRegex(ValueError, message):
            suite.make(GAPS, options)

    @parameterized.parameters(True, 1.0, '1', b'1', np.random.default_rng(1))
    def test_other_types_of_seeds_are_rejected(self, seed):
        with self.assertRaisesRegex(TypeError, r'random is .*; expected a seed, an integer'):
            suite.make(GAPS, {'random': seed})

    def test_wrappers_of_dm_control(self):
        environment = suite.load('plaid', 'biped_gaps', {'random': 1})
        for wrapper, options in (
            (action_noise, {}), (action_scale, {'minimum': -2.0, 'maximum': 2.0}),
            (mujoco_profiling, {}), (pixels, {'render_kwargs': {'height': 32, 'width': 32}}),
        ):  # fmt: skip
            environment = wrapper.Wrapper(environment, **options)
            environment.reset()
            time_step = environment.step(np.zeros(environment.action_spec().shape))
            self.assertTrue(0 < time_step.reward <= 1, wrapper.__name__)

    def test_images_show_the_reward(self):
        """The body turns green with the fourth power of the reward; the ground does not."""
        environment = suite.load('plaid', 'biped_gaps', {'random': 1}, visualize_reward=True)
        environment = pickle.loads(pickle.dumps(environment))
        environment.reset()
        model = environment.physics.model
        begun = model.geom_rgba.copy()
        share = environment.step(environment.task.clip_action(0)).reward ** 4
        moving = model.body_weldid[model.geom_bodyid] > 0
        expected = (1 - share) * begun[moving, :3] + share * np.array([0, 0.5, 0.3])
        np.testing.assert_allclose(model.geom_rgba[moving, :3], expected, rtol=1e-6)
        np.testing.assert_array_equal(model.geom_rgba[~moving], begun[~moving])
        self.assertGreater(share, 0.05)

    def test_no_compilation_after_construction(self):
        environment = suite.make(GAPS, {'random': 0})
        before = environment.physics.model.ptr
        for _ in range(3):
            environment.reset()
            environment.step(np.zeros(11))
        self.assertIs(environment.physics.model.ptr, before)

    def test_seeds(self):
        def heights(seed):
            environment = suite.make('PD_Dog2D_Slopes_Terrain-v0', {'random': seed})
            return environment.reset().observation['terrain']

        np.testing.assert_array_equal(heights(5), heights(5))
        np.testing.assert_array_equal(heights(5), heights(np.random.RandomState(5)))
        self.assertTrue((heights(5) != heights(6)).any())

    def test_a_closed_environment_raises_errors(self):
        environment = suite.make('PD_Biped2D_Flat-v0', {'random': 0})
        environment.reset()
        state = environment.get_state()
        environment.close()
        environment.close()
        for call in (
            lambda: environment.step(np.zeros(11)), environment.reset, environment.get_state,
            lambda: environment.set_state(state), environment.observation,
            environment.observation_spec, lambda: environment.info, lambda: environment.physics,
            lambda: environment.add_extra_hook('before_step', print),
            lambda: rendering.frame(environment), lambda: pickle.dumps(environment),
        ):  # fmt: skip
            with self.assertRaisesRegex(RuntimeError, 'the environment is closed'):
                call()

    @parameterized.parameters(*EXAMPLES)
    def test_close_frees_the_simulation(self, id_):
        environment = suite.make(id_, {'random': 0})
        environment.reset()
        environment.step(random_actions(environment, 1)[0])
        physics = environment.physics
        freed = [weakref.ref(each) for each in (physics.model.ptr, physics.data.ptr)]
        environment.close()
        mjcf.Physics.from_xml_string('<mujoco/>')  # dm_control keeps the last model it parsed
        gc.collect()
        self.assertEqual([each() for each in freed], [None, None])
        for look in (lambda: environment.task, lambda: environment.info, environment.action_spec):
            with self.assertRaisesRegex(RuntimeError, 'closed'):
                look()


class ThreadsTest(parameterized.TestCase):
    """A second thread is refused by name, for as long as the first one is inside."""

    def check(self, environment, calls):
        inside, leave, found = threading.Event(), threading.Event(), []
        step = environment.task.step

        def wait(*arguments):
            inside.set()
            leave.wait(60)
            return step(*arguments)

        def first():
            with mock.patch.object(environment.task, 'step', wait):
                found.append(calls[0]())

        thread = threading.Thread(target=first)
        thread.start()
        self.assertTrue(inside.wait(60))
        for call in calls:
            with self.assertRaisesRegex(RuntimeError, 'another thread.*one environment for each'):
                call()
        leave.set()
        thread.join()
        self.assertLen(found, 1)
        calls[0]()  # one after the other is fine

    def test_methods_of_a_single_environment(self):
        environment = suite.make(GAPS, {'random': 0})
        environment.reset()
        state = environment.get_state()
        self.check(environment, (
            lambda: environment.step(np.zeros(11)), environment.reset, environment.get_state,
            lambda: environment.set_state(state), environment.close,
            lambda: rendering.frame(environment),
        ))  # fmt: skip

    def test_methods_of_a_vector_environment(self):
        environments = VectorEnvironment(GAPS, 2, 1, seed=0)
        environments.reset()
        state = environments.get_state()
        self.check(environments, (
            lambda: environments.step(np.zeros((2, 11))), environments.reset, environments.render,
            environments.get_state, lambda: environments.set_state(state), environments.close,
            lambda: environments.copy_from(environments, [0], [1]), lambda: environments.seed(3),
        ))  # fmt: skip

    def test_threads_that_race(self):
        environment, found = suite.make(GAPS, {'random': 0}), []
        environment.reset()

        def work():
            for _ in range(30):
                try:
                    environment.step(np.zeros(11))
                    found.append(None)
                except RuntimeError as error:
                    found.append(str(error))

        threads = [threading.Thread(target=work) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        self.assertLen(found, 120)
        self.assertIn(None, found)
        self.assertLessEqual(len(set(found)), 2)


if __name__ == '__main__':
    absltest.main()
