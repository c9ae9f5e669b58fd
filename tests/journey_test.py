"""Tests of direct navigation: observation, reward, goals, ball, the original."""

import dataclasses

import numpy as np
from absl.testing import absltest, parameterized
from helpers import build, height_map, velocity_map

from trl_suite import suite
from trl_suite.vector import VectorEnvironment

TRAIL, FOREST, BLOCKS, MOVERS, SOCCER = (
    f'PD_Biped3D_Terrain_{name}_Hard-v0'
    for name in ('Trail', 'Forest', 'Blocks', 'Dyanmics_Obs', 'Soccer')
)
WALK = 'PD_Biped3D_LLC_General_Step-v0'
GROUNDS = (TRAIL, FOREST, BLOCKS, MOVERS)
SIZES = {'terrain': 1024, 'pose': 57, 'velocity': 48, 'phase': 5, 'goal': 2}


def started(id_, **options):
    environment = suite.make(id_, {'random': 3, **options})
    return environment, environment.reset()


def sizes(environment):
    return {name: part.stop - part.start for name, part in environment.blocks.items()}


def root_of(environment):
    """Place (3,) m and heading (rad) of the root."""
    named, name = environment.physics.named.data, environment.task.character.spec.name
    ahead = named.xmat[f'{name}/root'].reshape(3, 3)[:, 0]
    return named.xpos[f'{name}/root'].copy(), np.arctan2(ahead[1], ahead[0])


def bearing_and_distance(way, heading):
    return (np.arctan2(way[1], way[0]) - heading + np.pi) % (2 * np.pi) - np.pi, np.hypot(*way[:2])


def set_goal(environment, ahead):
    """Puts the goal so far ahead of the root."""
    task = environment.task
    place, heading = root_of(environment)
    along = np.array([np.cos(heading), np.sin(heading)])
    task.goal[0] = [*(place[:2] + ahead * along), 0.0]
    task.observe()


def terms(environment):
    """Terms of the reward as they would be of the state of now, by name."""
    task = environment.task
    task.observe()
    return environment.info['reward_terms']


class ObservationTest(parameterized.TestCase):
    @parameterized.parameters(*GROUNDS)
    def test_goal(self, id_):
        environment, time_step = started(id_)
        place, heading = root_of(environment)
        expected = bearing_and_distance(environment.task.goal[0] - place, heading)
        np.testing.assert_allclose(time_step.observation['goal'], expected, atol=1e-9)

    def test_ball(self):
        environment, time_step = started(SOCCER)
        place, heading = root_of(environment)
        ball = environment.physics.named.data.xpos['ball'].copy()
        seen = time_step.observation['ball']
        np.testing.assert_allclose(seen[:2], bearing_and_distance(ball - place, heading), atol=1e-9)
        self.assertAlmostEqual(seen[2], 0.2)  # it lies on the ground
        np.testing.assert_allclose(seen[3:], 0, atol=1e-9)
        way = environment.task.goal[0] - ball
        expected = bearing_and_distance(way, heading)
        np.testing.assert_allclose(time_step.observation['goal'], expected, atol=1e-9)

    def test_the_map_is_of_the_ground(self):
        """In a forest some pillar rises at least 2 m within the map of most starts."""
        environments = VectorEnvironment(FOREST, 16, seed=0)
        maps = environments.reset()[:, environments.blocks['terrain']]
        self.assertGreater((maps.max(1) > 2).mean(), 0.9)
        # Clear of them where the walker stands: its own sample is at 0.
        self.assertEqual(np.abs(maps.reshape(16, 32, 32)[:, 15:17, 2:4]).max(), 0)

    @parameterized.parameters(
        (MOVERS, ('height', 'velocity')),
        (MOVERS, 'velocity'),
        (WALK, 'velocity', 'conveyor3d_wide'),
    )
    def test_velocities_of_the_ground(self, id_, maps, on=None):
        spec = suite.find(id_)
        spec = dataclasses.replace(spec, terrain=on or spec.terrain)
        environment = build(spec, {'terrain_observation': maps, 'random': 3})
        environment.reset()
        for _ in range(20):
            time_step = environment.step(np.zeros(len(environment.action_map)))
        place, heading = root_of(environment)
        around, shown = environment.task.arena.seen(), sizes(environment)
        at = around, place[None, :2], np.array([heading])
        self.assertEqual(
            (shown.get('terrain', 0), shown['surface']), (1024 * (maps != 'velocity'), 2048)
        )
        np.testing.assert_allclose(
            time_step.observation['surface'], velocity_map(*at)[0], atol=1e-9
        )
        self.assertGreater(np.abs(time_step.observation['surface']).max(), 0.1)
        if 'terrain' in shown:
            np.testing.assert_allclose(
                time_step.observation['terrain'], height_map(*at)[0], atol=1e-5
            )
        mirror, seen = environment.task.mirror, np.concatenate([*time_step.observation.values()])
        part = environment.blocks['surface']
        lines = seen[part].reshape(2, 32, 32)[:, ::-1] * np.reshape((1, -1), (2, 1, 1))
        np.testing.assert_array_equal(mirror.observation(seen[None])[0, part], lines.ravel())


class RewardTest(parameterized.TestCase):
    def test_weights(self):
        """0.5, 0.05, 0.15, 0.2, 0.1, 0.05 and 0.1 over 1.15."""
        expected = np.array([0.5, 0.05, 0.15, 0.2, 0.1, 0.05, 0.1]) / 1.15
        found = [term.weight for term in started(TRAIL)[0].task.terms]
        np.testing.assert_allclose(found, expected)
        found = [term.weight for term in started(SOCCER)[0].task.terms]
        np.testing.assert_allclose(found[:7], expected / 2)
        self.assertAlmostEqual(sum(found), 1)

    def test_reward_is_almost_full_for_a_start_towards_a_far_goal(self):
        """The clip's own pose and velocity, straight towards a goal 10 m ahead."""
        environment, _ = started(TRAIL)
        set_goal(environment, 10.0)
        found = terms(environment)
        for term in environment.task.terms:
            # Heading and path differ by the rotation of the pelvis in a step.
            least = 0.0 if term.name == 'proximity' else 0.95 * term.weight
            self.assertBetween(found[term.name], least, term.weight + 1e-12, term.name)
        proximity = 0.1 / 1.15 * np.exp(-100 / (0.25 * 9))
        self.assertAlmostEqual(found['proximity'], proximity, delta=1e-12)

    def test_walking_away_from_the_goal_lowers_the_reward(self):
        environment, _ = started(TRAIL)
        set_goal(environment, -10.0)
        found = terms(environment)
        # 1.3 m/s one way instead of the other: the error is 0.1 times 2.6 squared.
        weight = 0.2 / 1.15
        self.assertAlmostEqual(found['com'], weight * np.exp(-10 * 0.1 * 2.6**2), delta=1e-3)
        self.assertLess(found['heading'], 1e-6)

    @parameterized.parameters((2.9, True), (3.1, False))
    def test_speed_and_heading_have_no_effect_near_the_goal(self, distance, full):
        environment, _ = started(TRAIL)
        set_goal(environment, -distance)
        found = terms(environment)
        self.assertEqual(found['com'] == 0.2 / 1.15, full)
        self.assertEqual(found['heading'] == 0.05 / 1.15, full)
        expected = 0.1 / 1.15 * np.exp(-(distance**2) / (0.25 * 9))
        self.assertAlmostEqual(found['proximity'], expected, delta=1e-9)

    def test_a_ball_that_rolls_to_its_goal(self):
        """Half of the reward is for the ball: its speed towards the goal, from 0."""
        environment, _ = started(SOCCER)
        task = environment.task
        action = task.clip_action(0)
        for speed, dribble in ((1.2, 1.0), (-1.2, 0.0)):
            environment.reset()
            ball = environment.physics.named.data.xpos['ball'].copy()
            task.goal[0] = ball[0] + 8.0, ball[1], 0.0
            environment.physics.named.data.qvel['ball'][:3] = speed, 0, 0
            environment.step(action)
            found = environment.info['reward_terms']
            self.assertAlmostEqual(found['dribble'], dribble * 0.5 * 0.4 / 1.2, delta=2e-3)
            moved = environment.physics.named.data.xpos['ball'][0] - ball[0]
            self.assertAlmostEqual(environment.info['speed'], 30 * moved, delta=1e-6)


class GoalTest(parameterized.TestCase):
    @parameterized.parameters((0.7, 0, {}), (0.3, 1, {}), (0.7, 1, {'goal_reached': 1.0}))
    def test_goal_is_redrawn_within_half_a_metre(self, ahead, reached, options):
        environment, _ = started(TRAIL, **options)
        set_goal(environment, ahead)
        before = environment.task.goal[0].copy()
        environment.step(environment.task.clip_action(0))
        self.assertEqual(environment.info['goals_reached'], reached)
        self.assertEqual((environment.task.goal[0] != before).any(), bool(reached))

    def test_goal_on_a_trail_is_on_the_next_segment(self):
        environments = VectorEnvironment(TRAIL, 32, seed=0)
        environments.reset()
        task = environments.task
        way = task.goal[:, :2] - environments.task.world.xpos[:, task.body.links[0], :2]
        self.assertLess(np.hypot(*way.T).max(), 6)  # segments are 2 m long
        np.testing.assert_allclose(task.goal[:, 2], 0, atol=1e-6)  # the path is level

    def test_a_ball_at_its_goal_is_counted_and_stays_there(self):
        environment, _ = started(SOCCER)
        ball = environment.physics.named.data.xpos['ball'].copy()
        environment.task.goal[0] = ball
        environment.step(environment.task.clip_action(0))
        self.assertTrue(environment.info['at_goal'])
        self.assertEqual(environment.info['goals_reached'], 1)
        np.testing.assert_array_equal(environment.task.goal[0], ball)

    def test_the_path_is_recorded(self):
        environment, _ = started(TRAIL)
        for _ in range(12):
            environment.step(environment.task.clip_action(0))
        *trace, flag = environment.task.markers(0)
        self.assertLen(trace, 2)  # every 5 control steps
        self.assertEqual((flag.shape, {m.shape for m in trace}), ('cylinder', {'sphere'}))


class OriginalTest(parameterized.TestCase):
    def test_original_rewards_unobserved_footsteps_and_keeps_its_goal(self):
        environment, _ = started(FOREST, reward='original')
        self.assertEqual(sizes(environment), SIZES)
        self.assertEqual(
            [term.name for term in environment.task.terms],
            ['pose', 'velocity', 'end_effector', 'com', 'root', 'heading'],
        )
        self.assertAlmostEqual(environment.task.plans.length[0], 0.4)
        goal = environment.task.goal[0].copy()
        time_step = environment.step(np.zeros(environment.action_spec().shape))
        place, heading = root_of(environment)
        expected = bearing_and_distance(goal - place, heading)
        np.testing.assert_allclose(time_step.observation['goal'], expected, atol=1e-9)

    @parameterized.parameters(
        ({'reward': 'orignal'}, "'orignal'.*original"),
        ({'reward': 'original', 'goal_reached': 1.0}, 'goal_reached is an option'),
        ({'goal_reached': 0.0}, 'goal_reached is 0'),
        ({'goal_reach': 1.0}, 'goal_reached'),
    )
    def test_invalid_options_are_rejected(self, options, message):
        with self.assertRaisesRegex(ValueError, message):
            suite.make(FOREST, options)


class BuildTest(absltest.TestCase):
    def test_any_character_in_space_and_ground(self):
        environment = suite.build('biped3d', terrain='hills3d', task='direct_navigation')
        self.assertEqual(environment.reset().observation['goal'].shape, (2,))
        with self.assertRaisesRegex(ValueError, "'dog' is planar; the task 'direct_navigation'"):
            suite.build('dog', task='direct_navigation')
