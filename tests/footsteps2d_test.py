"""Tests of footsteps in the plane: plans, clock, observation, reward, landings, ends."""

import helpers
import numpy as np
from absl.testing import absltest, parameterized
from helpers import LEFT, RIGHT, advance, assert_goes_on, assert_rows_are_singles, body, made, put
from helpers import STEP_WEIGHTS as WEIGHTS

from trl_suite import motion, rendering, suite
from trl_suite.tasks.common.plans import StraightPlans
from trl_suite.vector import VectorEnvironment

ID = 'PD_Biped2D_LLC_Flat_Step-v0'
VARIED = {'length': (0.25, 0.6), 'change': 1.0}
ZERO = np.zeros(11)


def started(**options):
    environment = made(ID, seed=8, step_limit=None, **options)
    return environment, environment.reset()


def ankles(environment):
    """x and z of right and left, (2, 2) m."""
    return helpers.ankles(environment)[:, ::2]


def held(environment):
    """Takes a step high in the air, where nothing falls."""
    pose = np.zeros(14)
    pose[1] = 8.0
    put(environment, pose, np.zeros(14))
    return environment.step(ZERO)


def walked(n, switches, **options):
    """Landing places of n walkers whose clocks run, before and after each switch of stance."""
    environments = VectorEnvironment(ID, n, 1, seed=0, task_kwargs={'start_phase': 0.0, **options})
    environments.reset()
    task, found = environments.task, []
    while len(found) < switches:
        before = task.plan.landing.copy()
        task.finish_step(np.arange(n))  # the physics stands still
        if task.plan.landed.any():
            assert task.plan.landed.all()
            found.append((before, task.plan.landing.copy()))
    return found


class ClockTest(parameterized.TestCase):
    """Clock and clip agree on the stance foot."""

    @parameterized.parameters(
        (0.0, [15, 30, 45, 60, 75, 90]), (0.1, [12, 27, 42]), (0.6, [12, 27, 42])
    )
    def test_stance_switches(self, phase, expected):
        environment, _ = started(start_phase=phase)
        task, found = environment.task, []
        for i in range(1, expected[-1] + 1):
            before = task.plan.stance[0]
            step = held(environment)
            if task.plan.stance[0] != before:
                found.append(i)
            self.assertEqual(environment.info['landed'], task.plan.stance[0] != before)
            right = (phase + i / 30 + 1e-9) % 1 < 0.5
            self.assertEqual(task.plan.stance[0], RIGHT if right else LEFT)
            # The observation agrees.
            self.assertEqual(step.observation['phase'][0] < 0.5, right)
            self.assertEqual(step.observation['phase'][1:3].any(), right)
        self.assertEqual(found, expected)

    @parameterized.parameters('biped2d', 'biped2d_full', 'raptor')
    def test_the_stance_foot_is_planted(self, character):
        # In the middle of its half it carries the clip, and the other foot swings ahead.
        environment = suite.build(character, task='footsteps', task_kwargs={'random': 0})
        environment.reset()
        task = environment.task
        for phase, stance in ((0.25, RIGHT), (0.75, LEFT)):
            found = []
            for time in (phase - 0.04, phase, phase + 0.04):
                pose = task.clip.pose(time * task.clip.duration)
                put(environment, pose, np.zeros(len(pose)))
                found.append(task.world.xpos[0, task.figure.effectors, ::2])
            x, z = np.moveaxis(found, -1, 0)
            self.assertLess(z[:, stance].max() + 0.02, z[:, 1 - stance].min())
            self.assertLess(np.ptp(x[:, stance]), 0.25 * np.ptp(x[:, 1 - stance]))

    def test_a_clip_that_starts_in_left_stance(self):
        mirrored = motion.load('biped2d_full_walk').mirrored()
        with self.assertRaisesRegex(
            ValueError, r'expected the right foot on the ground.*clip\.mirrored'
        ):
            suite.build('biped2d_full', task='footsteps', clip=mirrored)
        again = suite.build('biped2d_full', task='footsteps', clip=mirrored.mirrored())
        self.assertTrue(again.reset().first())


class PlanTest(parameterized.TestCase):
    """How plans are drawn and observed."""

    @parameterized.parameters(0.0, 0.2, 0.5, 0.8)
    def test_the_first_plan(self, phase):
        environment, _ = started(start_phase=phase)
        foot = ankles(environment)[RIGHT if phase < 0.5 else LEFT, 0]
        expected = [[foot + 0.4, 0, 0], [foot + 0.8, 0, 0]]
        np.testing.assert_allclose(environment.task.plan.landing[0], expected, atol=1e-12)

    def test_each_step_is_laid_from_the_one_before(self):
        for before, after in walked(3, 8):
            np.testing.assert_array_equal(after[:, 0], before[:, 1])
            np.testing.assert_allclose(after[:, 1, 0] - after[:, 0, 0], 0.4, atol=1e-12)
            np.testing.assert_array_equal(after[..., 1:], 0)

    def test_lengths_are_uniform(self):
        found = walked(60, 12, plans=VARIED)
        lengths = np.sort(np.ravel([after[:, 1, 0] - after[:, 0, 0] for _, after in found]))
        self.assertBetween(lengths[0], 0.25, 0.26)
        self.assertBetween(lengths[-1], 0.59, 0.6)
        even = 0.25 + 0.35 * (np.arange(len(lengths)) + 0.5) / len(lengths)
        self.assertLess(np.abs(lengths - even).max(), 0.35 * 1.95 / np.sqrt(len(lengths)))

    @parameterized.parameters(0.0, 0.1, 0.6)
    def test_lengths_change_occasionally(self, change):
        found = walked(60, 15, plans={**VARIED, 'change': change})
        lengths = np.array([after[:, 1, 0] - after[:, 0, 0] for _, after in found])
        changed = np.abs(np.diff(lengths, axis=0)) > 1e-9
        deviation = np.sqrt(change * (1 - change) / changed.size)
        self.assertAlmostEqual(changed.mean(), change, delta=4 * deviation)
        self.assertGreater(np.ptp(lengths[0]), 0.2)  # redrawn at every start

    @parameterized.parameters(0.0, 0.3, 0.5, 0.9)
    def test_plan_slots(self, phase):
        environment, step = started(start_phase=phase, plans=VARIED)
        task = environment.task
        self.assertEqual(environment.blocks, {
            'pose': slice(0, 25), 'velocity': slice(25, 49), 'phase': slice(49, 54),
            'contact': slice(54, 56), 'plan': slice(56, 69),
        })  # fmt: skip
        for _ in range(15):
            right = step.observation['phase'][0] < 0.5
            slots, expected = step.observation['plan'][:12].reshape(2, 2, 3), np.zeros((2, 2, 3))
            for which, foot in ((0, LEFT if right else RIGHT), (1, RIGHT if right else LEFT)):
                expected[which, foot, 0] = (
                    task.plan.landing[0, which, 0] - ankles(environment)[foot, 0]
                )
            np.testing.assert_allclose(slots, expected, atol=1e-12)
            self.assertEqual(step.observation['plan'][12], 0)
            step = environment.step(task.clip_action(0))

    def test_plan_is_relative_to_the_heading(self):
        environment, step = started(start_phase=0.1)
        ahead = step.observation['plan'][3]  # of the left foot
        environment.physics.data.qpos[environment.task.figure.pose_qpos[2]] = np.pi
        environment.physics.forward()
        environment.task.observe()
        way = environment.task.plan.landing[0, 0, 0] - ankles(environment)[LEFT, 0]
        self.assertGreater(ahead, 0)
        self.assertAlmostEqual(environment.observation()['plan'][3], -way, delta=1e-12)
        self.assertEqual(environment.task.reward_terms[0, -1], 0)  # the heading

    def test_contacts(self):
        environment, _ = started(start_phase=0.0)
        seen = set()
        for _ in range(25):
            step = environment.step(environment.task.clip_action(0))
            links = helpers.links_on_ground(environment)
            expected = [float(f'{side}_ankle' in links) for side in ('right', 'left')]
            np.testing.assert_array_equal(step.observation['contact'], expected)
            seen.add(tuple(expected))
        self.assertGreater(len(seen), 2)

    @parameterized.parameters('slopes_humanoid', 'steps_humanoid', 'gaps_humanoid')
    def test_places_lie_on_the_ground(self, preset):
        environment = suite.build(
            'biped2d_full', terrain=preset, task='footsteps',
            task_kwargs={'random': 3, 'plans': {'length': (0.6, 0.7)}, 'terrain_observation': 50},
        )  # fmt: skip
        task = environment.task
        self.assertEqual(environment.observation_spec()['terrain'].shape, (50,))
        for _ in range(3):
            environment.reset()
            while not environment.step(task.clip_action(0)).last():
                x, _, z = task.plan.landing[0].T
                np.testing.assert_array_equal(z, task.figure.ground_heights(0, x))
                slots = environment.observation()['plan'][:12].reshape(2, 2, 3)
                used = slots[[0, 1], [1 - task.plan.stance[0], task.plan.stance[0]], 2]
                root = body(environment, 'xpos', 'root')[:1]
                np.testing.assert_allclose(
                    used, z - task.figure.ground_heights(0, root), atol=1e-12
                )


class RewardTest(parameterized.TestCase):
    """The reward of the specification."""

    def placed(self, phase, **options):
        """The body in the clip's pose and the plan where the clip lands, and that place."""
        environment, _ = started(start_phase=phase, **options)
        task, clip = environment.task, environment.task.clip
        swing = LEFT if phase < 0.5 else RIGHT
        put(environment, clip.pose(np.ceil(2 * phase + 1e-9) / 2), np.zeros(14))
        landing = ankles(environment)[swing, 0]
        put(environment, clip.pose(phase), clip.velocity(phase))
        task.plan.landing[0, 0] = landing, 0, 0
        task.observe()
        return environment, landing

    def test_weights_and_scales(self):
        task = started()[0].task
        self.assertEqual([term.name for term in task.terms], list(WEIGHTS))
        for term in task.terms:
            self.assertAlmostEqual(term.weight, WEIGHTS[term.name], delta=1e-12)

    @parameterized.parameters(0.02, 0.11, 0.24, 0.49999, 0.53, 0.7, 0.99999)
    def test_the_clip_has_full_reward(self, phase):
        # In the second half of a step the swing foot is only there when it lands.
        environment, _ = self.placed(phase)
        for found, (name, weight) in zip(
            environment.task.reward_terms[0], WEIGHTS.items(), strict=True
        ):
            self.assertAlmostEqual(found, weight, delta=2e-3 * weight, msg=name)

    @parameterized.parameters(
        *((phase, scale) for phase in (0.3, 0.4, 0.77, 0.95) for scale in (1.0, 4.0))
    )
    def test_second_half_of_a_step(self, phase, scale):
        environment, landing = self.placed(phase, footstep_scale=scale)
        task = environment.task
        away = landing - ankles(environment)[LEFT if phase < 0.5 else RIGHT, 0]
        for height in (0.0, 0.1):  # of the place; the reference's foot is as high above it
            task.plan.landing[0, 0, 2] = height
            task.observe()
            error = 5 * scale * (away**2 + height**2)
            expected = WEIGHTS['end_effector'] * np.exp(-error)
            self.assertAlmostEqual(task.reward_terms[0, 2], expected, delta=1e-3)

    @parameterized.parameters(0.1, 0.24, 0.6)
    def test_first_half_of_a_step_ignores_the_plan(self, phase):
        environment, _ = self.placed(phase)
        environment.task.plan.landing[0] += 1.0
        environment.task.observe()
        found = environment.task.reward_terms[0, 2]
        self.assertAlmostEqual(found, WEIGHTS['end_effector'], delta=1e-3)

    def test_a_displaced_foot_lowers_the_reward(self):
        environment, _ = self.placed(0.1)  # in the first half of a step
        before = ankles(environment)
        environment.physics.named.data.qpos['biped2d_full/left_knee'] -= 0.25
        environment.physics.forward()
        environment.task.observe()
        moved = ankles(environment) - before
        expected = WEIGHTS['end_effector'] * np.exp(-5 * moved[LEFT] @ moved[LEFT])
        self.assertAlmostEqual(environment.task.reward_terms[0, 2], expected, delta=1e-3)
        self.assertLess(expected, 0.98 * WEIGHTS['end_effector'])

    def test_the_root_and_the_centre_of_mass(self):
        environment, _ = self.placed(0.1)
        task, data = environment.task, environment.physics.data
        data.qpos[task.figure.pose_qpos[1]] += 0.1
        data.qvel[task.figure.pose_dof[:2]] += (0.6, -0.8)
        environment.physics.forward()
        task.observe()
        terms = task.reward_terms[0]
        self.assertAlmostEqual(terms[4], WEIGHTS['root'] * np.exp(-0.1), delta=1e-3)
        self.assertAlmostEqual(terms[3], WEIGHTS['com'] * np.exp(-1.0), delta=1e-3)
        # Both feet are higher by 0.1 m.
        self.assertAlmostEqual(terms[2], WEIGHTS['end_effector'] * np.exp(-0.1), delta=1e-3)

    def test_terms_sum_to_the_reward(self):
        environment, _ = started(start_phase=0.1)
        self.assertEqual(set(environment.info['reward_terms'].values()), {0.0})
        for _ in range(60):
            step = environment.step(environment.task.clip_action(0))
            terms = environment.info['reward_terms']
            self.assertAlmostEqual(sum(terms.values()), step.reward, delta=1e-12)
            if step.last():
                break
        self.assertEqual((step.reward, environment.info['fell']), (0, True))


class LandingTest(parameterized.TestCase):
    """The landing error, and the end of an episode by a miss."""

    @parameterized.parameters(0.3, 0.8)
    def test_landing_error(self, phase):
        environment, _ = started(start_phase=phase)
        task = environment.task
        place = task.plan.landing[0, 0, 0]
        for _ in range(6):  # 0.2 s
            self.assertEqual(
                (environment.info['landed'], environment.info['landing_error']), (0, 0)
            )
            self.assertTrue(environment.step(task.clip_action(0)).mid())
        foot = ankles(environment)[LEFT if phase < 0.5 else RIGHT, 0]
        error = environment.info['landing_error']
        self.assertTrue(environment.info['landed'])
        self.assertAlmostEqual(error, abs(foot - place), delta=1e-12)
        self.assertBetween(error, 0.2, 0.5)  # the clip's steps are 0.75 m long
        self.assertEqual(environment.info['heading_error'], 0)
        environment.step(task.clip_action(0))
        self.assertFalse(environment.info['landed'])
        self.assertEqual(environment.info['landing_error'], error)  # stays until the next one

    @parameterized.parameters((0.01, True), (50.0, False), (None, False))
    def test_max_landing_error_ends_the_episode(self, max_landing_error, ends):
        environment, _ = started(start_phase=0.3, max_landing_error=max_landing_error)
        for i in range(1, 7):
            step = environment.step(environment.task.clip_action(0))
            self.assertEqual(step.last(), ends and i == 6)
        self.assertEqual(step.discount, 0.0 if ends else 1.0)
        self.assertEqual(step.reward == 0, ends)
        self.assertEqual(set(environment.info['reward_terms'].values()) == {0.0}, ends)
        self.assertFalse(environment.info['diverged'])
        if ends:
            self.assertTrue(environment.step(ZERO).first())
            self.assertFalse(environment.info['landed'])
            self.assertEqual(environment.info['landing_error'], 0)

    def test_a_diverged_simulation_has_no_landing(self):
        environment, _ = started(start_phase=0.4, max_landing_error=5.0)
        for _ in range(2):
            kept = environment.step(ZERO).observation
        environment.physics.data.qpos[environment.task.figure.pose_qpos[0]] = np.nan
        step = environment.step(ZERO)  # at the switch of stance
        info = environment.info
        self.assertTrue(step.last())
        self.assertTrue(info['diverged'])
        self.assertFalse(info['fell'] or info['landed'])
        for name, value in step.observation.items():
            np.testing.assert_array_equal(value, kept[name])
        self.assertTrue(environment.step(ZERO).first())
        self.assertGreater(environment.step(environment.task.clip_action(0)).reward, 0.2)


class SaveTest(parameterized.TestCase):
    """Seeds, saved states and pickles are exact; simulations equal single environments."""

    def advance(self, environment, seed):
        task = environment.task
        return advance(
            environment, seed, 40, 0.3,
            lambda _: (task.plan.landing_error, task.plan.landing[0].ravel(), task.reference_pose(0)),
        )  # fmt: skip

    @parameterized.parameters({}, {'plans': VARIED, 'max_landing_error': 0.5})
    def test_a_state_within_a_step_continues_exactly(self, **options):
        environment, other = (suite.make(ID, {'random': seed, **options}) for seed in (6, 9))
        for each in (environment, other):
            each.reset()
        for _ in range(4):
            environment.step(ZERO)
        self.advance(other, 4)
        assert_goes_on(environment, other, self.advance)

    def test_a_seed_determines_the_episode(self):
        first, again, another = (
            self.advance(suite.make(ID, {'random': seed, 'plans': VARIED}), 0) for seed in (3, 3, 4)
        )
        np.testing.assert_array_equal(first, again)
        self.assertTrue((first != another).any())

    @parameterized.product(n=(1, 2, 5), options=({}, {'plans': VARIED, 'max_landing_error': 0.5}))
    def test_simulations_equal_single_environments(self, n, options):
        assert_rows_are_singles(ID, n, 45, 19, options, scale=0.2)


class HelperTest(parameterized.TestCase):
    """What is built, drawn and refused."""

    @parameterized.parameters(('biped2d', 6), ('biped2d_full', 11), ('raptor', 18))
    def test_planar_characters_with_two_feet(self, character, actions):
        environment = suite.build(character, task='footsteps', task_kwargs={'random': 0})
        self.assertEqual(environment.reset().observation['plan'].shape, (13,))
        self.assertEqual(environment.action_spec().shape, (actions,))
        self.assertTrue(environment.step(np.zeros(actions)).mid())

    def test_markers(self):
        environment, _ = started(start_phase=0.1)
        task = environment.task
        first, second = task.markers(0)
        for marker, place in zip((first, second), task.plan.landing[0], strict=True):
            self.assertEqual(marker.shape, 'box')
            # The sole under an ankle, just above the ground.
            self.assertBetween(marker.position[0] - place[0], 0.02, 0.08)
            self.assertBetween(marker.position[2] - place[2], 0, 0.01)
        self.assertNotEqual(first.colour, second.colour)
        before = environment.physics.data.qpos.copy()
        colours = rendering.frame(environment, 120, 160).reshape(-1, 3).astype(int)
        self.assertGreater((colours[:, 0] - colours[:, 2] > 80).sum(), 5)  # orange
        self.assertGreater((colours[:, 2] - colours[:, 0] > 80).sum(), 5)  # blue
        np.testing.assert_array_equal(environment.physics.data.qpos, before)
        self.assertEqual(rendering.frame(environment, 120, 160, ghost=True).shape, (120, 160, 3))

    def test_the_reference_begins_where_the_body_is(self):
        environment, _ = started(start_phase=0.3)
        task = environment.task
        for _ in range(6):
            self.assertTrue(environment.step(task.clip_action(0)).mid())
        self.assertTrue(environment.info['landed'])
        pose, root = task.reference_pose(0), body(environment, 'xpos', 'root')
        self.assertAlmostEqual(pose[0], root[0], delta=1e-9)
        np.testing.assert_allclose(pose[2:], task.clip.pose(0.5)[2:], atol=1e-6)

    @parameterized.parameters(
        ({'plans': {'length': (0.6, 0.5)}}, r'length is \(0.6, 0.5\)'),
        ({'plans': {'length': -0.5}}, 'length is -0.5'),
        ({'plans': {'change': 1.5}}, 'change is 1.5'),
        ({'plans': {'width': (0.1, 0.2)}}, "unknown option of plans 'width'"),
        ({'plans': 0.5}, 'plans is 0.5; expected a dict of options, or StraightPlans'),
        ({'max_landing_error': 0}, 'max_landing_error is 0'), ({'max_landing_error': np.nan}, 'max_landing_error is nan'),
        ({'footstep_scale': -1}, 'footstep_scale is -1'),
        ({'footstep_scale': np.inf}, 'footstep_scale is inf'),
        ({'terrain_observation': 1}, 'terrain_observation is 1'), ({'start_phase': 1}, 'start_phase is 1'),
        ({'reference_observation': True}, "unknown option.*'reference_observation'"),
    )  # fmt: skip
    def test_options_out_of_range(self, options, message):
        with self.assertRaisesRegex(ValueError, message):
            suite.make(ID, options)

    def test_plans_as_objects(self):
        plans = StraightPlans(length=(0.3, 0.6))
        self.assertIs(started(plans=plans)[0].task.plans, plans)


if __name__ == '__main__':
    absltest.main()
