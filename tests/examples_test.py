"""Tests of the programs that train and compare: which runs there are, and in which order."""

import pathlib
import sys
from types import SimpleNamespace

import numpy as np
from absl.testing import absltest, parameterized

from trl_suite import characters, policies
from trl_suite.registry import catalogue
from trl_suite.vector import VectorEnvironment

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / 'examples'))
import compare_transfer
import evaluate_plans
import expert
import ppo
import ppo_settings
import train_all


class JobsTest(parameterized.TestCase):
    def test_every_environment_is_trained_but_for_most_gaits(self):
        ids = {id_ for id_, _ in train_all.jobs('*')}
        gaits = {id_ for id_, spec in catalogue.BY_ID.items() if spec.task_type == 'gait'}
        self.assertEqual(ids, set(catalogue.BY_ID) - gaits | set(train_all.GAITS))

    def test_actuation_models_are_compared_with_three_seeds(self):
        """Twelve cells: torque, velocity, position and muscle, of biped, dog and raptor."""
        again = {id_ for id_, seed in train_all.jobs('*') if seed == 3}
        self.assertLen(again, 12)
        self.assertLen([id_ for id_ in again if id_.startswith('MTU_')], 3)

    def test_what_a_run_begins_with_is_trained_before(self):
        seen = set()
        for id_, _ in train_all.jobs('*'):
            start = ppo_settings.settings_for(id_).start
            if start and start not in ppo.TEACHERS:
                self.assertIn(start, seen, id_)
            seen.add(id_)

    def test_starts_act_as_what_begins_with_them(self):
        """They drive the same joints in the same way; the limbs may differ in length."""
        for id_ in catalogue.BY_ID:
            start = ppo_settings.settings_for(id_).start
            if start in catalogue.BY_ID:
                own, other = (
                    (list(characters.CHARACTERS[spec.character].joints), spec.actuation)
                    for spec in (catalogue.BY_ID[id_], catalogue.BY_ID[start])
                )
                self.assertEqual(own, other, id_)


class TrimTest(absltest.TestCase):
    def test_only_what_was_always_0_is_left_out(self):
        rng = np.random.default_rng(0)
        policy = policies.Policy(
            id='PD_Biped2D_Flat-v0', blocks=(('a', 5),), actions=('x', 'y'), quantity='target angle',
            mean=[0, 0.5, 0, 0], std=[1, 0.01, 0.01, 2], clip=10, activation='tanh',
            columns=[4, 3, 1, 0], weights=[rng.normal(size=(4, 2))], biases=[[0, 0]],
            log_std=[0, 0],
        )  # fmt: skip
        trimmed = train_all.trimmed(policy)
        self.assertEqual(trimmed.columns.tolist(), [4, 3, 0])  # a constant counts
        observation = rng.normal(size=(9, 5)) / 10
        observation[:, 1] = 0.0
        np.testing.assert_allclose(trimmed(observation), policy(observation), atol=2e-3)  # halves
        self.assertFalse((trimmed.weights[0].view(np.int32) & 0x1FFF).any())  # 11 bits, kept by zip

    def test_inputs_of_convolutions_keep_their_places(self):
        rng = np.random.default_rng(0)
        line = policies.Convolution(
            line=4, strides=(2,), weights=[rng.normal(size=(2, 1, 3))], biases=[np.zeros(3)]
        )
        policy = policies.Policy(
            id='PD_Biped2D_Flat-v0', blocks=(('a', 5),), actions=('x', 'y'), quantity='target angle',
            mean=np.zeros(5), std=[1, 1, 1, 0.01, 1], clip=10, activation='relu',
            weights=[rng.normal(size=(7, 2))], biases=[[0, 0]], log_std=[0, 0], convolution=line,
        )  # fmt: skip
        trimmed = train_all.trimmed(policy)
        observation = rng.normal(size=(9, 5)) / 30
        np.testing.assert_allclose(trimmed(observation), policy(observation), atol=5e-3)
        for weights in (trimmed.weights[0], trimmed.convolution.weights[0]):
            self.assertFalse((weights.view(np.int32) & 0x1FFF).any())

    def test_the_program_of_each_environment(self):
        for id_, program in (
            ('PD_Biped2D_Flat-v0', 'ppo'),
            ('FSM_Hopper2D_Terrain_Gaps-v0', 'search_gaits'),
            ('FSM_Dog2D_Terrain_Mixed-v0', 'learn_gaits'),
        ):
            self.assertEqual(train_all.program(id_).__name__, program)
            self.assertIn('samples', train_all.settings(id_))


class TransferTest(parameterized.TestCase):
    def test_flat_ground_of_every_row(self):
        for spec in catalogue.SPECS:
            if spec.domain == 'plaid':
                flat = catalogue.BY_ID[compare_transfer.flat_ground(spec)]
                self.assertEqual(
                    (flat.terrain, flat.character, dict(flat.options)),
                    ('flat', spec.character, dict(spec.options)),
                )


class PlansTest(absltest.TestCase):
    def test_what_is_measured(self):
        """Two episodes of a controller that walks nowhere: they end early, without a goal."""
        id_ = 'PD_Biped3D_HLC_PathFollowing-v0'

        def make(environments):
            return lambda observation: 0.0 * observation[:, :5] + 1.0  # too far for anybody

        found = evaluate_plans.run(id_, make, episodes=2, seed=0)
        self.assertEqual((found['survived'], found['survived_minute']), (0, 0))
        self.assertEqual(found['goals_per_minute'], 0)
        self.assertBetween(found['seconds'], 0.5, 20)
        self.assertLess(found['reward'], 0.05)
        self.assertGreater(found['falls_per_km'], 50)
        self.assertEqual(found['at_goal'], 0)

    def test_without_hierarchy(self):
        """A walker that always acts at its limits falls at once; a step lasts 1/30 s."""
        id_ = 'PD_Biped3D_Terrain_Soccer_Hard-v0'

        def make(environments):
            return lambda observation: np.ones((2, len(environments.action_map)))

        found = evaluate_plans.run(id_, make, episodes=2, seed=0)
        self.assertEqual(found['survived'], 0)
        self.assertBetween(found['seconds'], 0.1, 5)
        self.assertAlmostEqual(found['seconds'] * 60, round(found['seconds'] * 60), 6)
        self.assertLess(found['reward'], found['seconds'] / evaluate_plans.SECONDS)


class GuideTest(parameterized.TestCase):
    """Who shows policies how to plan footsteps."""

    def test_a_trail(self):
        trail = SimpleNamespace(
            start=np.array([[0.0, 0.0], [2.0, 0.0]]), end=np.array([[2.0, 0.0], [2.0, 2.0]])
        )
        for place, goal, ahead, expected in (
            ((0.5, 0.1), (1.9, 0.0), 1.0, (1.5, 0.0)),
            ((1.5, 0.1), (2.0, 1.9), 1.0, (2.0, 0.5)),  # around the corner
            ((2.1, 0.5), (1.0, 0.0), 1.0, (1.5, 0.0)),  # back
            ((1.5, 0.0), (1.7, 0.0), 1.0, (1.7, 0.0)),  # no farther than the goal
        ):
            aim = expert.on_trail(trail, np.array(place), np.array(goal), ahead)
            np.testing.assert_allclose(aim + place, expected, atol=1e-9)

    def test_a_way_on_a_map(self):
        map_ = expert.Map()
        x, y = map_.places.T
        np.testing.assert_allclose(map_.places[map_.middle], 0)
        self.assertEqual(np.abs(map_.places[map_.rim]).max(1).min(), expert.REACH)
        even = np.ones(len(x))
        for goal in ((3.0, 0.0), (0.0, -4.0), (-20.0, 0.0), (9.0, 4.0)):  # there is nothing
            aim = map_.aim(even, np.array(goal))
            np.testing.assert_allclose(aim, goal)
        # A wall ahead that reaches farther to the right than to the left.
        wall = (np.abs(x - 1) < 0.2) & (y < 1) & (y > -4)
        aim = map_.aim(even + expert.WALL * wall, np.array([3.0, 0.0]))
        self.assertGreater(aim[1], 0.6)
        self.assertLess(np.linalg.norm(aim), 2.0)

    @parameterized.parameters(
        ('PD_Biped3D_HLC_Soccer-v0', {}),
        ('PD_Biped3D_HLC_Forest-v0', {'interface': 'frame'}),
        ('PD_Biped2D_Flat-v0', {}),
    )
    def test_ways_that_it_does_not_know(self, id_, options):
        environments = VectorEnvironment(id_, 1, 1, seed=0, task_kwargs=options)
        with self.assertRaisesRegex(ValueError, 'the expert knows no way for the task'):
            expert.expert(environments)

    @parameterized.parameters('PathFollowing', 'LargeBlocks', 'DynamicsObstacles')
    def test_it_arrives_where_it_is_dangerous(self, name):
        """20 s of 8 episodes, towards goals at the least speed that is asked of who has learnt it."""
        environments = VectorEnvironment(
            f'PD_Biped3D_HLC_{name}-v0', 8, 0, seed=3, autoreset='disabled'
        )
        policy, observation = expert.expert(environments), environments.reset()
        fell, speed = 0, np.zeros(8)
        for _ in range(40):
            action = policy(observation)
            self.assertEqual(action.shape, (8, 5))
            step = environments.step(action)
            ended = step.terminated | step.truncated
            fell += ended.sum()
            speed += step.info['speed'] / 40
            observation = environments.reset(ended) if ended.any() else step.observation
        self.assertLessEqual(fell, 1)
        self.assertGreater(speed.mean(), 0.6)


if __name__ == '__main__':
    absltest.main()
